"""The map of a proof: each cell where it is, in the colour of its bound."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PatchCollection
from mutants import killed_by

from diffabs.output.plot.proofs import ProofMap, draw_proof, map_proof
from diffabs.robust.reach.extremes import ExtremeRuns
from diffabs.scenario.parameter_paths import BoxSide

CELLS = np.array([[[0, 1], [0, 1]], [[1, 2], [0, 1]], [[0, 2], [1, 1.5]]], float)
LEFT, REFUTING = np.array([[[0, 1], [1.5, 2]]], float), np.array([[1, 2], [1.5, 2]], float)
MAP = ProofMap(
    labels=["plant.mass [kg]", "initial.speed [km/h]"],
    box=np.array([[0, 2], [0, 2]], float),
    cells=CELLS,
    bounds=np.array([0.1, 0.2, np.inf]),
    undecided=LEFT,
    refuting=REFUTING,
    worst=np.array([2.0, 2.0]),
    worst_value=0.3,
    quantity="proved upper bound of slip [1]",
    claimed=0.25,
    title="T",
)


def rectangles(collection: PatchCollection) -> np.ndarray:
    """Ends of each rectangle, shape (cells, 2, 2)."""
    return np.array(
        [[[p.vertices[:, i].min(), p.vertices[:, i].max()] for i in (0, 1)] for p in collection.get_paths()]
    )


@killed_by(
    "output.plot.proofs", "proved.set_array(shown.bounds[bounded])", "proved.set_array(np.arange(bounded.sum()))"
)
@killed_by("output.plot.proofs", "bounded = np.isfinite(shown.bounds)", "bounded = np.isfinite(shown.bounds) | True")
def test_two_parameters_are_a_map_of_rectangles() -> None:
    figure = draw_proof(MAP)
    ax, bar = figure.axes
    proved, unbounded, left = ax.collections
    np.testing.assert_array_equal(rectangles(proved), CELLS[:2])
    np.testing.assert_array_equal(proved.get_array(), [0.1, 0.2])
    np.testing.assert_array_equal(rectangles(unbounded), CELLS[2:])
    np.testing.assert_array_equal(rectangles(left), LEFT)
    assert left.get_hatch()
    assert (ax.get_xlabel(), ax.get_ylabel(), bar.get_ylabel()) == (*MAP.labels, MAP.quantity)
    (marked,) = ax.patches
    assert marked.get_bbox().extents.tolist() == [1, 1.5, 2, 2]
    cross, worst = ax.get_lines()
    np.testing.assert_array_equal([cross.get_xydata()[0], worst.get_xydata()[0]], [[1.5, 1.75], [2, 2]])
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["refutes the claim", "worst run found: 0.3", "not proved", "proved, but no bound of this"]


def test_one_parameter_is_a_line_of_intervals() -> None:
    one = MAP._replace(labels=MAP.labels[:1], box=MAP.box[:1], cells=CELLS[:2, :1], bounds=MAP.bounds[:2])
    figure = draw_proof(one._replace(undecided=LEFT[:, :1], refuting=None, worst=np.array([2.0])))
    (ax,) = figure.axes
    np.testing.assert_array_equal(ax.collections[0].get_segments(), [[[0, 0.1], [1, 0.1]], [[1, 0.2], [2, 0.2]]])
    claimed, worst = ax.get_lines()
    assert claimed.get_ydata()[0] == 0.25
    np.testing.assert_array_equal(worst.get_xydata(), [[2.0, 0.3]])
    assert (ax.get_xlabel(), ax.get_ylabel()) == (MAP.labels[0], MAP.quantity)


@pytest.mark.parametrize("parameters", [1, 2])
def test_a_proof_of_nothing_is_drawn(parameters: int) -> None:
    none = MAP._replace(labels=MAP.labels[:parameters], box=MAP.box[:parameters], cells=np.empty((0, parameters, 2)))
    none = none._replace(bounds=np.empty(0), undecided=MAP.box[None, :parameters], refuting=None, worst=None)
    figure = draw_proof(none)
    figure.draw_without_rendering()
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1:] == ["not proved"]


@killed_by("output.plot.proofs", "if is_wide(side.ends)]", "]")
@killed_by("output.plot.proofs", "if len(sides) not in (1, 2):", "if False:")
def test_a_map_has_the_parameters_that_vary() -> None:
    ends = {"plant.mass": (5.0, 6.0), "initial.speed": (3.0, 3.0), "reference.slip": (0.1, 0.2)}
    sides = [BoxSide(path, pair, f"{path} [SI]", 1.0) for path, pair in ends.items()]
    empty = np.zeros((0, 3, 2))
    proof: Any = SimpleNamespace(
        over=ends, claims=(), verdict="undecided", extremes=ExtremeRuns({}, {}), unit_of=lambda quantity: "1",
        cover=SimpleNamespace(rows=None, cells=empty, undecided=empty, refuting=None),
    )  # fmt: skip
    shown = map_proof(proof, sides, "T")
    assert shown.labels == ["plant.mass [SI]", "reference.slip [SI]"]
    assert shown.box.tolist() == [[5.0, 6.0], [0.1, 0.2]]
    with pytest.raises(ValueError, match="one or two parameters; 0 have more than one value"):
        map_proof(proof, sides[1:2], "T")
