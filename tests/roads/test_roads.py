"""Friction curves against published numbers, closed forms, NumPy and SciPy."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by
from parts import ROADS, differences, jacobian
from scipy.interpolate import BSpline, PchipInterpolator
from scipy.optimize import brentq

from diffabs.core.pytree import canonical_dtypes, param, pytree, replace
from diffabs.core.validity import check_part, find_problems
from diffabs.parts.roads import (
    DRY_ASPHALT,
    ICE,
    RIG,
    RIG_UNROUNDED,
    SNOW,
    SPLINE_B,
    WET_COBBLESTONE,
    Burckhardt,
    MagicFormula,
    Patches,
    PiecewiseLinear,
    RationalCurve,
    Scaled,
    ScaledAlong,
    Tabulated,
    peak,
)

GRID = np.linspace(-1.0, 1.0, 401)


@jax.jit
def curve(road, slips, speed=0.0, distance=0.0):
    return jax.vmap(lambda s: road.friction(s, speed, distance))(slips)


best = jax.jit(peak)


def found(road):
    """At 12 m/s, in the ramp of the roads that have patches."""
    return peak(road, 12.0, 10.01)


# The rig's curve, eq. (13)


def test_rig_numbers():
    mu, slope = jax.jit(jax.value_and_grad(RIG.friction))(0.2)
    np.testing.assert_allclose(mu, 0.39575220833898, rtol=1e-13, atol=0)
    np.testing.assert_allclose(slope, -0.00641755652574, rtol=1e-10, atol=0)  # twelve printed digits
    np.testing.assert_allclose(RIG.friction(1.0), 0.399595428169, rtol=1e-11, atol=0)


def test_rig_peaks_before_its_target():
    """Not at 0.2, and lower than a locked wheel's friction: two errors of the paper."""
    slip, mu = best(canonical_dtypes(RIG))
    np.testing.assert_allclose((slip, mu), (0.187542005875, 0.395794085737), rtol=1e-10, atol=0)
    assert mu < RIG.friction(1.0)


@pytest.mark.parametrize("road", [RIG, RIG_UNROUNDED], ids=["rounded", "unrounded"])
def test_rational_formula(road):
    s = np.abs(GRID)
    mu = road.w4 * s**road.q / (road.a + s**road.q) + np.polyval([road.w3, road.w2, road.w1, 0.0], s)
    np.testing.assert_allclose(curve(road, GRID), np.sign(GRID) * mu, rtol=1e-12, atol=1e-15)


# Burckhardt

TABLE = {  # Kiencke and Nielsen, ch. 8
    "DRY_ASPHALT": (1.2801, 23.99, 0.52),
    "WET_ASPHALT": (0.857, 33.822, 0.347),
    "DRY_CONCRETE": (1.1973, 25.168, 0.5373),
    "DRY_COBBLESTONE": (1.3713, 6.4565, 0.6691),
    "WET_COBBLESTONE": (0.4004, 33.7080, 0.1204),
    "SNOW": (0.1946, 94.129, 0.0646),
    "ICE": (0.05, 306.39, 0.0),
}


@pytest.mark.parametrize("name", TABLE)
@pytest.mark.parametrize("speed", [0.0, 30.0])
def test_burckhardt_formula(name, speed):
    c1, c2, c3 = TABLE[name]
    s = np.abs(GRID)
    mu = np.sign(GRID) * (c1 * (1 - np.exp(-c2 * s)) - c3 * s) * np.exp(-0.03 * s * speed)
    np.testing.assert_allclose(curve(ROADS[name], GRID, speed), mu, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", [n for n in TABLE if n != "ICE"])
def test_burckhardt_peak(name):
    """Without c4 the slope c1 c2 exp(-c2 s) - c3 vanishes at s = ln(c1 c2/c3)/c2."""
    road = replace(ROADS[name], {"c4": 0.0})
    c1, c2, c3 = TABLE[name]
    s = np.log(c1 * c2 / c3) / c2
    slip, mu = best(canonical_dtypes(road), 12.0)
    np.testing.assert_allclose(slip, s, rtol=1e-12, atol=0)
    np.testing.assert_allclose(mu, c1 - c3 / c2 - c3 * s, rtol=1e-12, atol=0)


def test_gradient_of_burckhardt_peak():
    """d/dc1 = 1/(c1 c2), d/dc2 = (1/c2 - s)/c2, d/dc3 = -1/(c2 c3); of mu at its peak: the partial derivatives."""
    c1, c2, c3 = TABLE["WET_ASPHALT"]
    s = np.log(c1 * c2 / c3) / c2
    g = jacobian(found, Burckhardt(c1=c1, c2=c2, c3=c3, c4=0.0))[:3]
    np.testing.assert_allclose(g[:, 0], [1 / (c1 * c2), (1 / c2 - s) / c2, -1 / (c2 * c3)], rtol=1e-9, atol=0)
    np.testing.assert_allclose(g[:, 1], [1 - c3 / (c1 * c2), c1 * s * c3 / (c1 * c2), -s], rtol=1e-9, atol=0)


def test_peak_falls_with_speed():
    slips, mus = jax.jit(jax.vmap(lambda v: peak(DRY_ASPHALT, v)))(jnp.array([0.0, 15.0, 30.0]))
    assert np.all(np.diff(slips) < 0)
    assert np.all(np.diff(mus) < 0)


# Magic formula


def test_magic_formula():
    b, c, d, e = 10.0, 1.65, 0.9, 0.97
    x = b * GRID
    mu = d * np.sin(c * np.arctan((1 - e) * x + e * np.arctan(x)))
    np.testing.assert_allclose(curve(MagicFormula(B=b, C=c, D=d, E=e), GRID), mu, rtol=1e-13, atol=1e-15)


def test_magic_peak():
    """The greatest mu is D, where C arctan(...) = pi/2."""
    road = MagicFormula()
    slip, mu = best(canonical_dtypes(road))
    place = brentq(
        lambda s: road.B * s * (1 - road.E) + road.E * np.arctan(road.B * s) - np.tan(np.pi / 2 / road.C),
        0,
        1,
        xtol=1e-15,
    )
    np.testing.assert_allclose(slip, place, rtol=1e-10, atol=0)
    np.testing.assert_allclose(mu, road.D, rtol=1e-14, atol=0)


# Tabulated


def knots(seed, monotone):
    rng = np.random.default_rng(seed)
    slip = np.concatenate([[0.0], (np.arange(1, 10) + rng.uniform(-0.4, 0.4, 9)) / 10, [1.0]])
    mu = rng.uniform(0.1, 1.0, 10)
    return slip, np.concatenate([[0.0], np.sort(mu) if monotone else mu])


FLAT = (np.array([0.0, 0.1, 0.2, 0.4, 0.7, 1.0]), np.array([0.0, 0.5, 0.5, 0.8, 0.8, 0.8]))
STEEP_ENDS = (np.array([0.0, 0.3, 0.35, 0.4, 0.45, 1.0]), np.array([0.0, 0.05, 0.01, 0.8, 0.2, 0.3]))


@killed_by("parts.roads.tabulated", "w0 * m[1:] + w1 * m[:-1]", "w1 * m[1:] + w0 * m[:-1]")
@killed_by("parts.roads.tabulated", "jnp.where(steep, 3 * m0, d)", "d")
@pytest.mark.parametrize(
    ("slip", "mu"),
    [knots(seed, monotone) for seed in range(8) for monotone in (True, False)]
    + [FLAT, STEEP_ENDS, (SPLINE_B.slip, SPLINE_B.mu)],
)
def test_tabulated_is_pchip(slip, mu):
    road = check_part(Tabulated(slip=slip, mu=mu))
    s = np.linspace(0.0, 1.0, 401)
    oracle = PchipInterpolator(slip, mu)
    np.testing.assert_allclose(curve(road, s), oracle(s), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(curve(road, -s), -oracle(s), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(curve(road, slip), mu, rtol=1e-15, atol=1e-15)


@killed_by("parts.roads.piecewise_linear", "jnp.diff(y) / jnp.diff(x)", "jnp.diff(y)")
def test_piecewise_linear_is_numpys_interpolation():
    """Odd, exact at the knots, and constant beyond the last one."""
    slip, mu = np.array([0.0, 0.07, 0.12, 0.15, 1.0]), np.array([0.0, 0.7, 0.85, 0.88, 0.6675])
    road = check_part(PiecewiseLinear(slip=slip, mu=mu))
    s = np.linspace(0.0, 1.2, 481)
    np.testing.assert_allclose(curve(road, s), np.interp(s, slip, mu), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(curve(road, -s), -np.interp(s, slip, mu), rtol=1e-12, atol=1e-14)


@killed_by("parts.roads.along", "4 + 3 * t * t * (t - 2)", "4 + 3 * t * t * (t - 1)")
@killed_by("parts.roads.along", "c[-1] * ends", "0.0 * ends")
@pytest.mark.slow
def test_a_factor_along_the_road_is_a_b_spline():
    """SciPy's, the first and the last factor going on; within the factors, and no steeper than they are."""
    factors, d = np.random.default_rng(5).uniform(0.5, 1.5, 9), 0.7
    road = check_part(ScaledAlong(road=RIG, factors=factors, spacing=d))
    known = BSpline(d * np.arange(-5, 9 + 5.0), np.concatenate([3 * [factors[0]], factors, 3 * [factors[-1]]]), 3)
    x = np.linspace(-2.0 * d, 10.0 * d, 401)
    found = np.array([float(road.friction(0.13, 8.0, at)) for at in x]) / float(RIG.friction(0.13))
    np.testing.assert_allclose(found, known(x), rtol=1e-12)
    slopes = np.array([float(jax.grad(road.factor)(at)) for at in x])
    np.testing.assert_allclose(slopes, known(x, 1), rtol=1e-9, atol=1e-12)
    assert found.min() >= factors.min()
    assert found.max() <= factors.max()
    assert np.abs(slopes).max() <= np.abs(np.diff(factors)).max() / d
    for at, end in ((-50.0, factors[0]), (50.0, factors[-1])):
        np.testing.assert_allclose(road.factor(at), end, rtol=1e-15)


@pytest.mark.parametrize("seed", [3, 4])
def test_tabulated_gradient(seed):
    """In every knot, slip and mu, against differences of SciPy's interpolant."""
    slip, mu = knots(seed, monotone=False)
    s = np.random.default_rng(9).uniform(0.0, 1.0, 40)
    rows = []
    for column in (0, 1):
        for i in range(len(slip)):
            values = []
            for step in (1e-6, -1e-6):
                table = [slip.copy(), mu.copy()]
                table[column][i] += step
                values.append(PchipInterpolator(*table, extrapolate=True)(s))
            rows.append((values[0] - values[1]) / 2e-6)
    exact = jacobian(lambda road: curve(road, s), Tabulated(slip=slip, mu=mu))
    np.testing.assert_allclose(exact, rows, rtol=1e-6, atol=1e-8)


def test_spline_b_knots():
    """The published identification, knot by knot, and its peak: a knot, where the slope of the cubic is zero."""
    text = """
    0 .02108 .04215 .06323 .08431 .09696 .10539 .12039 .14539 .17539 .19039 .20539 .23539 .28539 .40539 .60539 1
    0 .51493 .72745 .86912 .96331 .98097 .99064 .98201 .95733 .92939 .91484 .90622 .88005 .85317 .81806 .79436 .75761"""
    slip, mu = (np.array(line.split(), float) for line in text.strip().splitlines())
    np.testing.assert_allclose(SPLINE_B.slip, slip, rtol=0, atol=0)
    np.testing.assert_allclose(SPLINE_B.mu, mu, rtol=0, atol=0)
    np.testing.assert_allclose(best(canonical_dtypes(SPLINE_B)), (0.10539, 0.99064), rtol=1e-9, atol=0)


def test_tabulated_objects_to_bad_tables():
    x, y = np.array([0.0, 0.5, 1.0]), np.array([0.0, 0.8, 0.7])
    for slip, mu, message in (
        (x, y[:2], "same length of at least 3"),
        (x[[0, 2, 1]], y, "not increasing"),
        (x * 0.9, y, r"slip 0.9; they must run"),
        (x, y + 0.1, r"from \(0, 0.1\)"),
    ):
        with pytest.raises(ValueError, match=message):
            check_part(Tabulated(slip=slip, mu=mu))


# Compound roads


def test_scaled():
    np.testing.assert_allclose(curve(Scaled(road=RIG, scale=0.3), GRID), 0.3 * curve(RIG, GRID), rtol=1e-15, atol=0)


def along(road, distance):
    return jax.jit(jax.vmap(lambda x: road.friction(0.1, 10.0, x)))(jnp.asarray(distance))


def test_patches_on_either_side_and_between():
    a, b, c = (float(r.friction(0.1, 10.0, 0.0)) for r in (DRY_ASPHALT, SNOW, ICE))
    road = Patches(roads=(DRY_ASPHALT, SNOW, ICE), edges=np.array([10.0, 20.0]), width=2.0)
    mu = along(road, [0.0, 9.0, 9.5, 10.0, 11.0, 15.0, 20.0, 21.0, 99.0])
    quarter = a + (3 / 16 - 2 / 64) * (b - a)  # y = 1/4 of 3 y^2 - 2 y^3
    np.testing.assert_allclose(mu, [a, a, quarter, (a + b) / 2, b, b, (b + c) / 2, c, c], rtol=1e-14, atol=0)


@killed_by("parts.roads.patches", "edges = jnp.asarray(self.edges)", "edges = np.asarray(self.edges)")
def test_traced_edges_may_be_a_tuple_or_a_list():
    for edges in ((5.0,), [5.0]):
        np.testing.assert_allclose(curve(Patches(edges=edges), GRID, 0.0, 9.0), curve(SNOW, GRID), rtol=1e-12)


@killed_by("parts.roads.patches", "y * y * (3 - 2 * y)", "y")
def test_patches_are_c1():
    """Slope zero at both ends of the ramp, 3/2 (after - before)/width in its middle."""
    road = Patches(width=2.0)
    jump = float(SNOW.friction(0.1, 10.0) - DRY_ASPHALT.friction(0.1, 10.0))
    slope = jax.jit(jax.vmap(jax.grad(lambda x: road.friction(0.1, 10.0, x))))
    np.testing.assert_allclose(
        slope(jnp.array([9 + 1e-9, 10.0, 11 - 1e-9])), [0, 0.75 * jump, 0], rtol=1e-12, atol=1e-8
    )


def test_sharp_patches():
    a, b = (float(r.friction(0.1, 10.0, 0.0)) for r in (DRY_ASPHALT, SNOW))
    mu = along(Patches(width=0.0), [10 - 1e-9, 10.0, 10 + 1e-9])
    np.testing.assert_allclose(mu, [a, b, b], rtol=1e-14, atol=0)


def test_patches_object_to_bad_edges():
    assert list(find_problems(Patches(edges=np.array([1.0, 2.0])))) == ["edges has shape (2,); 2 roads need (1,)"]
    road = Patches(roads=(ICE, SNOW, ICE), edges=np.array([2.0, 1.0]))
    assert list(find_problems(road)) == ["edges = [2.0, 1.0] m is not increasing"]


# The best slip


def test_monotone_curve_is_best_locked():
    ice = replace(ICE, {"c4": 0.0})
    np.testing.assert_allclose(best(canonical_dtypes(ice)), (1.0, 0.05), rtol=1e-12, atol=0)
    slope = jacobian(found, ice)
    assert np.all(np.isfinite(slope))
    np.testing.assert_allclose(slope[:, 0], 0.0, rtol=0, atol=0)


@killed_by("parts.roads.optimum", "jnp.isnan(values[1:]).any()", "False")
@pytest.mark.slow
def test_a_road_of_nan_has_no_best_slip():
    assert np.isnan(peak(replace(ICE, {"c1": np.nan})).slip)


@killed_by("parts.roads.optimum", "values[1:]).any()", "values).any()")
def test_a_road_of_nan_at_slip_0_is_best_locked():
    """A user's formula, 0/0 at slip 0."""
    rising = types.SimpleNamespace(friction=lambda slip, speed, distance: slip * slip / slip)
    assert peak(rising) == (1.0, 1.0)


@killed_by("parts.roads.optimum", " & (values[:-1] > 0)", "")
@pytest.mark.parametrize("a", [0.001, 0.01, 0.1])
def test_a_dip_below_zero_is_no_peak(a):
    """The rational curve dips below 0 next to slip 0. Against the first maximum of a fine grid in NumPy, from there."""
    road = RationalCurve(a=a)
    s = np.linspace(0.02, 1.0, 98001)
    mu = road.w4 * s**road.q / (a + s**road.q) + np.polyval([road.w3, road.w2, road.w1, 0.0], s)
    falls = np.flatnonzero(np.diff(mu) < 0)
    first = falls[0] if len(falls) else -1
    np.testing.assert_allclose(best(canonical_dtypes(road)), (s[first], mu[first]), rtol=0, atol=1e-5)


LINE_SLIPS = np.array([0.0, 0.07, 0.12, 0.151, 1.0])


@killed_by("parts.roads.optimum", "gap - jax.lax.stop_gradient(gap)", "0.0 * gap")
def test_peak_of_straight_lines_moves_with_its_knot():
    """At a knot, where the slope jumps: slip and mu are those of the knot."""
    road = PiecewiseLinear(slip=LINE_SLIPS, mu=np.array([0.0, 0.7, 0.85, 0.88, 0.66]))
    np.testing.assert_allclose(best(canonical_dtypes(road)), (0.151, 0.88), rtol=1e-12)
    expected = np.zeros((10, 2))
    expected[3, 0] = expected[5 + 3, 1] = 1.0
    np.testing.assert_allclose(jacobian(found, road), expected, rtol=1e-9, atol=1e-12)


@killed_by("parts.roads.optimum", "jnp.abs(slope(s0)) < ", "jnp.abs(curvature) > 0.0 * ")
@pytest.mark.slow
def test_peak_at_a_kink_beside_a_curve():
    """Half a table, which peaks at its knot, and half a smooth curve past its peak: slip and mu move with the knot."""
    table = PiecewiseLinear(slip=np.array([0.0, 0.1, 0.2, 1.0]), mu=np.array([0.0, 0.8, 1.0, 0.7]))
    road = Patches(roads=(table, DRY_ASPHALT), edges=(10.0,))
    c1, c2, c3 = TABLE["DRY_ASPHALT"]
    mu, slope = c1 * (1 - np.exp(-c2 * 0.2)) - c3 * 0.2, c1 * c2 * np.exp(-c2 * 0.2) - c3
    np.testing.assert_allclose(best(canonical_dtypes(road), 0.0, 10.0), (0.2, 0.5 * (1.0 + mu)), rtol=1e-12)
    expected = np.zeros((8, 2))
    expected[2] = 1.0, 0.5 * slope
    expected[4 + 2, 1] = 0.5
    moved = jacobian(lambda t: peak(replace(road, {"roads.0": t}), 0.0, 10.0), table)
    np.testing.assert_allclose(moved, expected, rtol=1e-9, atol=1e-12)


@pytree
class Crossing:
    """The lower one of a s + s^2 and exp(-2 s)."""

    a: float = param(default=3.0, unit="1")

    def friction(self, slip, speed, distance):
        del speed, distance
        rising, falling = self.a * slip + slip**2, jnp.exp(-2 * slip)
        return jnp.where(rising < falling, rising, falling)


@killed_by("parts.roads.optimum", "mu(end + (s - s0))", "mu(end) + slope(end) * (s - s0)")
@pytest.mark.slow
def test_two_derivatives_of_a_peak_where_curves_cross():
    """Against differences of the crossing that SciPy finds."""

    def cross(a):
        return brentq(lambda s: a * s + s * s - np.exp(-2 * s), 0.0, 1.0, xtol=1e-16)

    def slip(a):
        return peak(Crossing(a=a)).slip

    h = 1e-3
    known = (
        cross(3.0),
        (cross(3.0 + h) - cross(3.0 - h)) / (2 * h),
        (cross(3 + h) - 2 * cross(3.0) + cross(3 - h)) / h**2,
    )
    both = jax.jit(lambda a: (slip(a), jax.grad(slip)(a), jax.grad(jax.grad(slip))(a)))(3.0)
    np.testing.assert_allclose(both, known, rtol=1e-6)


@killed_by("parts.roads.optimum", "jnp.where(at[1] == 0, jnp.nan, at[1])", "jnp.where(at[1] == 0, 1.0, at[1])")
def test_peak_on_a_plateau_has_no_derivative():
    """Any slip from 0.07 to 0.151 is best."""
    road = PiecewiseLinear(slip=LINE_SLIPS, mu=np.array([0.0, 0.88, 0.88, 0.88, 0.66]))
    slip, mu = best(canonical_dtypes(road))
    assert 0.07 <= slip <= 0.151
    np.testing.assert_allclose(mu, 0.88, rtol=1e-12)
    assert np.all(np.isnan(jacobian(found, road)[:, 0]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["DRY_ASPHALT", "SNOW", "RIG", "RIG_UNROUNDED", "magic", "patches, three"])
def test_peak_is_differentiable_in_every_parameter(name):
    """Where patches meet. A root is found to 1e-16 of mu' over mu'', here 1 to 200, and differences divide it by
    1e-5."""
    road = ROADS[name]
    np.testing.assert_allclose(jacobian(found, road), differences(found, road), rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_peak_of_a_table_moves_with_its_knot():
    """Spline B peaks at its seventh knot and stays there: slip and mu are those of the knot."""
    expected = np.zeros((34, 2))
    expected[6, 0] = expected[17 + 6, 1] = 1.0
    np.testing.assert_allclose(jacobian(found, SPLINE_B), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("road", "where"),
    [
        (Burckhardt(c1=0.0), "friction = -0.52 at slip 1 "),
        (Burckhardt(c2=1e-300), "friction = -0.52 at slip 1 "),
        (Burckhardt(c3=1.29), "friction = -0.0099 at slip 1 "),
        (RationalCurve(w4=1e-9), "at slip 0.65 "),
        (RationalCurve(a=1e300), "at slip 0.65 "),
        (RationalCurve(w3=-0.37), "at slip 1 "),
        (Scaled(road=Burckhardt(c1=0.0)), "road.friction = -0.52 "),
        (Patches(roads=(ICE, Burckhardt(c1=0.0))), "roads.1.friction = -0.52 "),
    ],
)
def test_a_road_that_drives_is_refused(road, where):
    with pytest.raises(ValueError, match=f"{where}.*is negative: such a road drives"):
        check_part(road)


@pytest.mark.parametrize("road", [DRY_ASPHALT, SNOW, ICE, WET_COBBLESTONE, RIG, RIG_UNROUNDED, Burckhardt(c3=1.28)])
def test_a_road_that_only_brakes_is_accepted(road):
    """The rig's published polynomial dips to -3e-6 below slip 7e-5, which is forgiven."""
    assert check_part(road) is road


def test_roads_are_checked_in_single_precision_too():
    """A library user who leaves JAX's default alone; here, beside programs compiled in double precision."""
    check_part(RIG)
    with jax.enable_x64(False):
        assert check_part(RIG) is RIG
        assert check_part(Scaled(road=SNOW, scale=2.0)).scale == 2.0
        with pytest.raises(ValueError, match="such a road drives"):
            check_part(Burckhardt(c1=0.0))
