"""Boxes of parameters to polytopes: every system of the box is a convex combination of the vertices."""

import itertools

import jax
import numpy as np
import pytest
from mutants import killed_by
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError
from seams import replace_seam

from diffabs.core.pytree import param, pytree, replace
from diffabs.linear.linearization import StateSpace
from diffabs.linear.slip_model import Sampling, SlipModel
from diffabs.parts.actuators import Lag
from diffabs.parts.plants import MirroredRig
from diffabs.parts.roads import RIG, SPLINE_B, Scaled
from diffabs.robust.design.frozen import analyse_frozen_loops
from diffabs.robust.design.parameter_box import polytope, schedule
from diffabs.robust.design.parameter_grid import grid_polytope
from diffabs.robust.design.polytopes import Polytope, Schedule

K = 1 / 3.6
MASS, SPEED = (5.3, 6.2), (5 * K, 50 * K)
PAPER = {"plant.mass": MASS, "speed": SPEED}
RATES = {(m, v): (alpha, 133.472842636189) for m, alpha in zip(MASS, (83.8796606703, 84.6321445666), strict=True)
         for v in SPEED}  # fmt: skip


def distance(system, vertices):
    """How far a system is from the hull of the vertices, as a linear program: min |A, B - sum w_i (A_i, B_i)|_inf with
    weights w, each entry relative to its range among the vertices."""
    rows = np.concatenate([vertices.A.reshape(len(vertices.A), -1), vertices.B.reshape(len(vertices.B), -1)], axis=1)
    x = np.concatenate([np.ravel(system[0]), np.ravel(system[1])])
    scale = np.ptp(rows, axis=0)
    scale = np.where(scale > 1e-12 * np.abs(rows).max(axis=0), scale, np.maximum(np.abs(rows).max(axis=0), 1.0))
    v, x = (rows / scale).T, x / scale
    one = np.ones((len(x), 1))
    upper = np.block([[v, -one], [-v, -one]])
    cost = np.append(np.zeros(len(rows)), 1.0)
    equal = np.append(np.ones(len(rows)), 0.0)[None]
    return linprog(cost, upper, np.concatenate([x, -x]), equal, [1.0]).fun


def furthest(model, over, vertices, count=40):
    points = np.random.default_rng(7).uniform(*np.array(list(over.values())).T, (count, len(over)))
    systems = jax.jit(jax.vmap(lambda p: replace(model, dict(zip(over, p, strict=True))).matrices()))(points)
    return max(distance(s, vertices) for s in zip(*map(np.asarray, systems), strict=True))


@pytest.mark.slow
def test_paper():
    """Four vertices, each a pair: alpha(m)/omega with the beta/omega of the same omega. Eq. (22) leaves that open."""
    p = polytope(SlipModel(), PAPER)
    assert p.vertices == 4
    assert p.states == ("integral of slip error", "slip error")
    assert p.coverage.spread == 1
    assert abs(p.coverage.furthest - 1) < 1e-9
    assert p.coverage.checked > 4000
    for a, b, corner in zip(p.A, p.B, p.corners, strict=True):
        alpha, beta = RATES[corner["plant.mass"], corner["speed"]]
        omega = corner["speed"] / 0.099
        np.testing.assert_allclose(a, [[0, 1], [0, alpha / omega]], rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(b, [[0], [beta / omega]], rtol=1e-10)
    assert furthest(SlipModel(), PAPER, p) < 1e-9


SAMPLED = SlipModel(sampling=Sampling(period=2e-3, delay=1e-3))
BOXES = {
    "peak": (SlipModel(), {**PAPER, "plant.road.w4": (0.9 * 0.407, 1.1 * 0.407)}, 4),
    "scale": (
        SlipModel(plant=MirroredRig(road=Scaled(road=RIG))),
        {**PAPER, "plant.road.scale": (0.5, 1.1)},
        None,
    ),
    "sampled": (SAMPLED, PAPER, 8),
    "lag": (SlipModel(actuator=Lag()), {"speed": SPEED, "actuator.time_constant": (0.005, 0.05)}, None),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOXES)
def test_random_points_are_covered(name):
    model, over, count = BOXES[name]
    p = polytope(model, over)
    assert p.vertices == (count or p.vertices)
    assert p.coverage.furthest <= 1 + 1e-9
    assert p.period == model.period
    assert furthest(model, over, p) < 1e-8


@pytree
class Made:
    """x' = p x + f(p, q) u, and what else a test needs."""

    p: float = param(default=0.5, unit="1", low=-2.0, high=2.0)
    q: float = param(default=0.5, unit="1", low=-2.0, high=2.0)
    rows: object = param(default=(1.0, 2.0), unit="1")

    states, period = ("x",), None

    def matrices(self):
        return self.system(self.p, self.q)


def made(function):
    """A model with A = function(p, q)[0], B = function(p, q)[1], both of one row."""
    return pytree(type("Model", (Made,), {"system": staticmethod(function), "__annotations__": {}}))()


def scalars(a, b):
    return StateSpace(jax.numpy.stack([a])[None], jax.numpy.stack([b])[None])


UNIT = {"p": (0.0, 1.0), "q": (0.0, 1.0)}


def test_corners_are_spread():
    """The map (p, q) -> (p, q + 0.4 p (1 - p)) bulges out of the square of its corners by 0.1."""
    model = made(lambda p, q: scalars(p, q + 0.4 * p * (1 - p)))
    p = polytope(model, UNIT)
    np.testing.assert_allclose(p.coverage.spread, 1.2, rtol=1e-6)
    assert len(p.corners) == p.vertices == 4
    np.testing.assert_allclose(np.ptp(p.A), 1.2, rtol=1e-6)
    assert furthest(model, UNIT, p) < 1e-12


BENT = np.random.default_rng(0).normal(size=(6, 6, 6))


@pytree
class Cube:
    """(A, B) are the six parameters, bent by 1e-14, and A[0, 1] bulges by 0.1 between the ends of the first."""

    a: float = param(default=0.5, unit="1")
    b: float = param(default=0.5, unit="1")
    c: float = param(default=0.5, unit="1")
    d: float = param(default=0.5, unit="1")
    e: float = param(default=0.5, unit="1")
    f: float = param(default=0.5, unit="1")

    states, period = ("x", "y"), None

    def matrices(self):
        x = jax.numpy.stack([self.a, self.b, self.c, self.d, self.e, self.f])
        y = x + 1e-14 * jax.numpy.einsum("kij,i,j->k", BENT, x, x)
        y = y.at[1].add(0.4 * x[0] * (1 - x[0]))
        return StateSpace(y[:4].reshape(2, 2), y[4:].reshape(2, 1))


@pytest.mark.slow
def test_merged_facets_are_decided_by_linear_programs():
    """The facets of a cube in six dimensions are flat to rounding: Qhull gives up on its 64 corners."""
    over = dict.fromkeys("abcdef", (0.0, 1.0))
    ends = np.array(list(itertools.product((0.0, 1.0), repeat=6)))
    with pytest.raises(QhullError):
        ConvexHull(ends + 1e-14 * np.einsum("kij,ni,nj->nk", BENT, ends, ends))
    p = polytope(Cube(), over, grid=3)
    assert p.vertices == 64
    assert (
        p.coverage.checked < 1000
    )  # systems, by a linear program each: of facets all are looked at, tens of thousands
    np.testing.assert_allclose(p.coverage.spread, 1.2, rtol=1e-6)
    assert furthest(Cube(), over, p) < 1e-9


def test_bulge_between_grid_points():
    """A narrow bulge that the first grid of 3 points misses is found by the looks that follow."""
    model = made(lambda p, q: scalars(p, q + 0.2 * jax.numpy.exp(-(((p - 0.3) / 0.05) ** 2))))
    p = polytope(model, UNIT, grid=3)
    assert p.coverage.spread > 1.35  # the peak itself, between the points of any grid, needs 1.4


def test_curve_gets_a_box():
    """One parameter, a parabola: two corners are a chord. The box lies along the principal directions."""
    model = made(lambda p, q: scalars(p, p**2))
    p = polytope(model, {"p": (-1.0, 1.0)})
    assert p.vertices == 4
    assert p.corners == ()
    assert p.coverage.spread == np.inf
    np.testing.assert_allclose(sorted(p.B[:, 0, 0]), [0, 0, 1, 1], atol=0.1)
    assert furthest(model, {"p": (-1.0, 1.0)}, p) < 1e-12


def test_redundant_corners_are_dropped():
    """p + q: the corners (0, 1) and (1, 0) lie between the others; and a parameter without effect leaves one vertex."""
    p = polytope(made(lambda p, q: scalars(p + q, 1.0 + 0 * p)), UNIT)
    assert [dict(c) for c in p.corners] == [{"p": 0.0, "q": 0.0}, {"p": 1.0, "q": 1.0}]
    assert p.A.ravel().tolist() == [0.0, 2.0]
    assert polytope(made(lambda p, q: scalars(1.0 + 0 * p, 1.0 + 0 * p)), UNIT).vertices == 1


@pytest.mark.slow
def test_many_dimensions_by_linear_programs():
    """Seven entries that depend on seven parameters: a cube, beyond the facets; and with a bulge, spread."""

    def cube(bulge):
        fields = {f"p{i}": param(default=0.5, unit="1", low=0.0, high=1.0) for i in range(7)}

        def matrices(self):
            v = jax.numpy.stack([getattr(self, name) for name in fields])
            v = v.at[0].add(bulge * v[1] * (1 - v[1]))
            a = jax.numpy.zeros((3, 3)).at[:2].set(v[:6].reshape(2, 3))
            return StateSpace(a, v[6] * jax.numpy.ones((3, 1)))

        names = {"matrices": matrices, "states": tuple("abc"), "period": None, "__annotations__": dict.fromkeys(fields)}
        return pytree(type("Cube", (), {**fields, **names}))(), dict.fromkeys(fields, (0.0, 1.0))

    model, over = cube(0.0)
    p = polytope(model, over, grid=2, max_points=200)
    assert p.vertices == 128
    assert p.coverage.spread == 1
    assert p.coverage.checked < 300
    bulged = polytope(cube(0.4)[0], over, grid=3, max_points=3**7)
    np.testing.assert_allclose(bulged.coverage.spread, 1.2, rtol=0.02)


def test_no_parameter_and_equal_ends():
    p = polytope(SlipModel(), {})
    assert (p.vertices, p.corners, p.coverage.checked) == (1, ({},), 1)
    fixed = polytope(SlipModel(), {"plant.mass": (6.0, 6.0), "speed": SPEED})
    assert fixed.vertices == 2
    assert [c["plant.mass"] for c in fixed.corners] == [6.0, 6.0]
    single = polytope(SlipModel(), {"plant.mass": (6.2, 6.2), "speed": (5 * K, 5 * K)})
    np.testing.assert_allclose(single.A[0, 1, 1], 84.6321445666 / (5 * K / 0.099), rtol=1e-10)


@killed_by("robust.design.parameter_grid", "data, labels, model", "data, labels, _")
@killed_by("robust.design.frozen", "data, labels, model", "data, labels, _")
@pytest.mark.slow
def test_a_period_fixed_by_the_box_is_that_of_the_systems():
    over = {"sampling.period": (4e-3, 4e-3)}
    slower = replace(SAMPLED, {"sampling.period": 4e-3})
    a, b = (np.asarray(matrix, float) for matrix in slower.matrices())
    gain = np.array([[-1.0, -300.0, 0.0]])
    rate = -np.log(np.abs(np.linalg.eigvals(a + b @ gain)).max()) / 4e-3
    assert polytope(SAMPLED, over).period == grid_polytope(SAMPLED, over).period == 4e-3
    np.testing.assert_allclose(analyse_frozen_loops(gain, SAMPLED, over).slowest, rate, rtol=1e-4)


def test_schedule():
    chain = schedule(SlipModel(), PAPER, "speed", 4)
    assert chain.parameter == "speed"
    np.testing.assert_allclose(chain.nodes, np.geomspace(*SPEED, 5), rtol=1e-14)
    for low, high, cell in zip(chain.nodes[:-1], chain.nodes[1:], chain.cells, strict=True):
        assert {c["speed"] for c in cell.corners} == {low, high}
        assert cell.vertices == 4
    assert len(schedule(SlipModel(), PAPER, "speed", np.int64(2), grid=2).cells) == 2
    given = schedule(SlipModel(), PAPER, "speed", [SPEED[0], 3.0, SPEED[1]], grid=3)
    assert given.nodes.tolist() == [SPEED[0], 3.0, SPEED[1]]
    linear = schedule(made(lambda p, q: scalars(p, q)), UNIT, "p", 2, grid=3)
    assert linear.nodes.tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("along", "nodes", "message"),
    [
        ("plant.mas", 3, "along = 'plant.mas' is not a parameter of the box; there is plant.mass, speed"),
        ("speed", 0, "nodes = 0 cells; it needs at least 1"),
        ("speed", [2.0, 3.0], r"nodes = \[2.0, 3.0\] do not increase from 1.38889 to 13.8889, the ends of speed"),
        ("speed", [SPEED[0], 9.0, 8.0, SPEED[1]], "do not increase from"),
        ("speed", True, "nodes = True do not increase from"),
    ],
)
def test_schedule_errors(along, nodes, message):
    with pytest.raises(ValueError, match=message):
        schedule(SlipModel(), PAPER, along, nodes)


MANY = pytree(
    type(
        "Many",
        (),
        {
            **{f"p{i}": param(default=0.0, unit="1") for i in range(13)},
            "__annotations__": {f"p{i}": float for i in range(13)},
            "states": ("x",),
            "period": None,
        },
    )
)()


@pytest.mark.parametrize(
    ("model", "over", "message"),
    [
        (SlipModel(), {"plant.mas": MASS}, "over: the model has no parameter 'plant.mas'; there is plant.mass"),
        (SlipModel(), {"plant": MASS}, "over: the model has no parameter 'plant'"),
        (SlipModel(), {"integral": (0, 1)}, "over: the model has no parameter 'integral'"),
        (SlipModel(), {"speed": (9.0, 3.0)}, r"over: speed = \(9, 3\) is inverted"),
        (SlipModel(), {"speed": 3.0}, r"over: speed = 3.0 is not an interval \(low, high\)"),
        (SlipModel(), {"speed": (np.nan, 3.0)}, r"over: speed = nan is outside \(0, 200\] m/s"),
        (SlipModel(), {"speed": (3.0, np.inf)}, r"over: speed = inf is outside \(0, 200\] m/s"),
        (SlipModel(), {"plant.mass": (0.0, 3.0)}, r"over: plant.mass = 0 is outside \(0, inf\) kg"),
        (SlipModel(), {"slip": (0.1, 1.0)}, r"over: slip = 1 is outside \(0, 1\)"),
        (SAMPLED, {"sampling.period": (1e-3, 2e-3)}, "over: the sampling period cannot vary within a polytope"),
        (SAMPLED, {"sampling.delay": (0.0, 4e-3)}, "delay = 0.004 s exceeds the period of 0.002 s"),
        (
            SlipModel(plant=MirroredRig(road=SPLINE_B)),
            {"plant.road.mu": (0.0, 1.0)},
            r"over: plant.road.mu is an array of shape \(\d+,\), not a number",
        ),
        (MANY, {f"p{i}": (0.0, 1.0) for i in range(13)}, "a box of 13 parameters has 8192 corners, more than 4096"),
    ],
)
def test_errors(model, over, message):
    with pytest.raises(ValueError, match=message):
        polytope(model, over)


@killed_by("robust.design.polytopes", "not 0 < self.period < math.inf", "not self.period < math.inf", case="-1.0")
@pytest.mark.parametrize("period", [-1.0, 0.0, np.nan, np.inf])
def test_a_period_that_is_not_positive_is_refused(period):
    with pytest.raises(ValueError, match=rf"period = {period:g} is outside \(0, inf\) s"):
        Polytope([[[0.5]]], [[[1.0]]], period)


def test_nodes_are_finite_and_a_period_is_a_number():
    cell = Polytope([[[-1.0]]], [[[1.0]]])
    with pytest.raises(ValueError, match=r"needs one node more, increasing: .*inf"):
        Schedule("v", [0.0, np.inf], (cell,))
    with pytest.raises(ValueError, match="period = True is a truth value"):
        Polytope([[[0.5]]], [[[1.0]]], True)


def test_a_check_has_a_point():
    with pytest.raises(ValueError, match=r"max_points = 0 is outside \[1, inf\)"):
        polytope(SlipModel(), PAPER, max_points=0)


def test_matrices_that_are_not_finite():
    with pytest.raises(ValueError, match="the model's matrices are not finite at p = 0, q = 0"):
        polytope(made(lambda p, q: scalars(1 / p, q)), UNIT)


def test_box_of_too_many_vertices(monkeypatch):
    replace_seam(monkeypatch, "max_vertices", 2)
    with pytest.raises(ValueError, match="the box needs 4 vertices, more than 2: vary fewer parameters, or by less"):
        polytope(made(lambda p, q: scalars(p, p**2)), {"p": (-1.0, 1.0)})


def test_without_scipy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "scipy.optimize", None)
    with pytest.raises(ModuleNotFoundError, match=r'a polytope needs SciPy: pip install "\.\[design\]"'):
        polytope(SlipModel(), PAPER)
