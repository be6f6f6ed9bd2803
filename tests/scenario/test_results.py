"""Small parts of results: fields, levels and names in words."""

import pytest
from mutants import killed_by

from diffabs.output.export import make_identifier
from diffabs.scenario.proving import read_gain
from diffabs.scenario.scenario import ScenarioError, field_paths, load
from diffabs.uncertainty.reliability.subset_simulation import SubsetProgress, describe_levels
from diffabs.uncertainty.sweep import SweepProgress


def test_field_paths_are_in_the_order_of_the_file() -> None:
    paths = field_paths(load("slip-cured", integrated=False))
    assert paths[:2] == ["title", "description"]
    assert paths.index("plant.mass") < paths.index("solver.step")
    assert load("slip-cured", ["plant.mass=6"], integrated=False).loop.plant.mass == 6.0


@killed_by(
    "uncertainty.reliability.subset_simulation", "math.prod(level.share for level in levels)", "levels[-1].share"
)
def test_levels_so_far_have_the_product_of_their_shares() -> None:
    levels = [SubsetProgress(1, 1.0, 0.1, 100), SubsetProgress(2, 2.0, 0.2, 190, strict=True)]
    assert describe_levels(levels) == "> 2 has a probability of about 0.02, by 190 runs"
    assert describe_levels(levels[:1]) == ">= 1 has a probability of about 0.1, by 100 runs"


@killed_by("uncertainty.sweep.run", 'compiling" if self.samples < self.total else words', 'compiling"')
@killed_by("uncertainty.sweep.run", 'f"{words}, {self.refused:,} refused" if self.refused else', "")
def test_a_sweep_says_how_far_it_is() -> None:
    at = SweepProgress(2000, 4000, 1000, 2.0, 3, 1, tuple(range(10)), 5)
    assert at.describe_count() == "2,000 of 4,000: 500/s, 3 failed (1 diverged), 5 refused"
    assert at._replace(here=0).describe_count() == "2,000 of 4,000, compiling"
    assert at._replace(samples=4000, here=0).describe_count() == "4,000 of 4,000"
    assert at.describe_damage() == "damaged, computed again: chunks 0, 1, 2, 3, 4, 5, 6, 7 and 2 more"


@killed_by("output.export.c99", '.strip("_")', "")
def test_any_text_gives_an_identifier() -> None:
    assert [make_identifier(text) for text in ("slip-cured", "2nd try", "\xe4", "_a.b_")] == [
        *("slip_cured", "controller_2nd_try", "controller", "a_b")
    ]


def test_a_gain_has_a_number_for_each_state() -> None:
    assert read_gain("[-1.5, 2]", ("a", "b")).tolist() == [-1.5, 2.0]
    with pytest.raises(ScenarioError, match='gain "1" has 1 of 2 numbers, one for each of a, b'):
        read_gain("1", ("a", "b"), "gain")
