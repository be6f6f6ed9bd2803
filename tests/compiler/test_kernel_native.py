"""Elementary functions of a kernel against 80-bit ones, and every rule against JAX's own operation."""

import platform

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src.lax import lax  # the comparisons in a total order are not public
from kernels import FOLDER, applied
from marks import cases
from mutants import killed_by
from seams import replace_seam

from diffabs.compiler.pipeline import run_lanes
from diffabs.compiler.runtime import library_cache, toolchain

pytestmark = pytest.mark.xdist_group("kernel")

REAL = ("exp", "expm1", "log", "log1p", "sin", "cos", "tanh", "arctan")
MOST = {
    **{("tanh", "float64"): 2.0, ("tanh", "float32"): 2.0},
    **{(name, "float32"): 1.1 for name in ("expm1", "sin", "cos")},
}  # units; else 1
EXACT = ("sqrt", "floor", "ceil", "rint", "abs", "sign")


PLAIN = [False, pytest.param(True, marks=pytest.mark.slow)]


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch):
    """And blocks of one vector, which are compiled in a fourth of the time."""
    monkeypatch.setenv(library_cache.CACHE, FOLDER)
    replace_seam(monkeypatch, "vectors_per_block", 1)


def _arguments(dtype):
    """All sizes that matter, both signs, near the places where a function changes its way."""
    rng = np.random.default_rng(3)
    tiny, most = np.finfo(dtype).tiny, np.finfo(dtype).max
    sizes = [np.exp(rng.uniform(np.log(low), np.log(high), 4000)) for low, high in ((1e-8, 1e2), (1e-2, 10.0))]
    wide = np.exp(rng.uniform(np.log(float(tiny) * 4), np.log(float(most) / 4), 2000))
    near = np.concatenate([p * (1 + 1e-3 * rng.standard_normal(300)) for p in np.pi / 2 * np.arange(1, 40, 3)])
    ones = 1 + np.exp(rng.uniform(-30, -1, 2000))
    x = np.concatenate([*sizes, wide, near, ones, 1 / ones, rng.uniform(0, 88, 2000)])
    return np.concatenate([x, -x]).astype(dtype)


def _ulps(found, expected, dtype):
    """How far numbers are off, in units of the last place of the exact ones."""
    least = np.finfo(dtype).tiny
    with np.errstate(all="ignore"):
        unit = np.spacing(np.maximum(np.abs(expected).astype(dtype), least)).astype(np.longdouble)
        off = np.abs(found.astype(np.longdouble) - expected) / unit
    inside = np.isfinite(expected) & (np.abs(expected) <= np.finfo(dtype).max) & (np.abs(expected) >= least)
    return off[inside], inside


@killed_by("compiler/native/functions.h", "0x1.a39ef35793c76p-33", "0x1.a39ff35793c76p-33", case="float64-")
@killed_by("compiler/native/functions.h", "0.05876946456", "0.05876946466", case="float64-")
@killed_by("compiler/native/functions.h", "0.14268306f", "0.14269306f", case="float32-")
@killed_by("compiler/native/functions.h", "0.19999312f", "0.19989312f", case="float32-")
@killed_by("compiler/native/functions.h", "(e*0x1.0bfbe8p-15f + error)", "(e*0x1.0bfbe8p-15f)", case="float32-")
@killed_by("compiler/native/functions.h", "n*0x1.0bfbe8p-15f;", "n*0x1.0bfce8p-15f;", case="float32-")
@pytest.mark.parametrize("plain", PLAIN, ids=["", "plain"])
@pytest.mark.parametrize("dtype", cases([np.float64, np.float32], np.float32))
def test_elementary_functions_are_right_to_one_ulp(dtype, plain, monkeypatch):
    if plain:
        replace_seam(monkeypatch, "cpp_flags", (*toolchain.CPP_FLAGS, "-DPLAIN"))
    x = _arguments(dtype)
    with jax.enable_x64(dtype is np.float64):
        found = applied({name: getattr(jnp, name) for name in (*REAL, *EXACT)}, jnp.asarray(x))
    for name in REAL:
        with np.errstate(all="ignore"):
            expected = getattr(np, name)(x.astype(np.longdouble))
        off, inside = _ulps(found[name], expected, dtype)
        assert inside.sum() > 8000, name
        assert off.max() <= MOST.get((name, np.dtype(dtype).name), 1.0), (name, off.max(), x[inside][off.argmax()])
    for name in EXACT:
        with np.errstate(invalid="ignore"):
            np.testing.assert_array_equal(found[name], getattr(np, name)(x), err_msg=name)


@pytest.mark.parametrize("plain", PLAIN, ids=["", "plain"])
def test_ends_of_functions(plain, monkeypatch):
    """Infinite, NaN, zeros of either sign, and what flows over."""
    if plain:
        replace_seam(monkeypatch, "cpp_flags", (*toolchain.CPP_FLAGS, "-DPLAIN"))
    x = np.array([np.inf, -np.inf, np.nan, 0.0, -0.0, 1.0, -1.0, 710.0, -746.0, 1e300, -1e300, 1e6, -3e5])
    found = applied({name: getattr(jnp, name) for name in (*REAL, *EXACT)}, x)
    with np.errstate(all="ignore"):
        for name in (*REAL, *EXACT):
            expected = getattr(jnp if name == "sign" else np, name)(x)  # a zero is its own sign
            np.testing.assert_allclose(found[name], expected, rtol=1e-15, atol=0, err_msg=name)
            zeros = expected == 0
            np.testing.assert_array_equal(np.signbit(found[name][zeros]), np.signbit(expected[zeros]), err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", cases([np.float64, np.float32], np.float32))
def test_hyperbolic_functions_up_to_their_overflow(dtype):
    """The exponential overflows before them, at 709.78; their halves do at 710.47, in single precision at 89.41."""
    most = {np.float64: 710.475, np.float32: 89.415}[dtype]
    x = np.concatenate([np.linspace(0.98 * most, most, 50), [-most, 1.001 * most, -1.001 * most, 0.5, -1e-9]]).astype(
        dtype
    )
    with jax.enable_x64(dtype is np.float64):
        functions = {"sinh": jnp.sinh, "cosh": jnp.cosh, "slope": jax.grad(jnp.sinh), "bend": jax.grad(jnp.cosh)}
        found = applied({name: lambda x, f=f: f(x) for name, f in functions.items()}, jnp.asarray(x))
    with np.errstate(over="ignore"):
        sinh, cosh = np.sinh(x.astype(np.longdouble)).astype(dtype), np.cosh(x.astype(np.longdouble)).astype(dtype)
    rtol = 4 * np.finfo(dtype).eps
    for name, expected in {"sinh": sinh, "cosh": cosh, "slope": cosh, "bend": sinh}.items():
        np.testing.assert_allclose(found[name], expected, rtol=rtol, err_msg=name)


KEY, LEAST = jax.random.key(3), np.int32(-(2**31))
TABLE, PLACE = jnp.array([3.0, 1.0, 4.0, 1.5, 9.0]), jnp.asarray(2)
KNOTS = jnp.array([-2.0, -0.5, 0.0, 1.0, 2.5])


def _table(x):
    return jnp.array([3.0, 1.0, 4.0, 1.5, 9.0])[jnp.clip((3 * x).astype(int), 0, 4)]


RULES = {
    "compared": lambda x, y, k: jnp.stack([x < y, x <= y, x > y, x >= y, x == y, x != y]),
    "truths": lambda x, y, k: jnp.stack([(x < y) & (y > 0), (x < y) | (y > 0), (x < 0) ^ (y < 0), ~(x < y)]),
    "chosen": lambda x, y, k: jnp.where(jnp.isfinite(x), jnp.where(x > y, x, 2.0), y),
    "chosen truths": lambda x, y, k: jnp.where(x > y, y > 0, k > 2),
    "extremes": lambda x, y, k: jnp.stack([jnp.maximum(x, y), jnp.minimum(x, y)]),
    "whole powers": lambda x, y, k: jnp.abs(x) ** k,
    "powers": lambda x, y, k: jnp.stack([x**2, x**3, x**-2, jnp.square(y)]),
    "rests": lambda x, y, k: jnp.stack([jnp.fmod(x, 0.7), jnp.remainder(y, 0.7)]),
    "whole rests": lambda x, y, k: jnp.stack([k % 5, -k % 7, k // 3, -k // 4, k // (k - 3), k % (k - 3)]),
    "rests of the least": lambda x, y, k: jnp.stack(
        [jax.lax.rem(jnp.where(k < 99, jnp.iinfo(k.dtype).min, k), jnp.where(k < by, -1, k)) for by in (-99, 99)]
    ),
    "least rest of -1": lambda x, y, k: jax.lax.rem(jnp.where(k < 99, jnp.iinfo(k.dtype).min, k), jnp.full_like(k, -1)),
    "rounded": lambda x, y, k: jnp.stack([jax.lax.round(x), jnp.round(x), jnp.trunc(y)]),
    "bits that are set": lambda x, y, k: jax.lax.population_count(jnp.uint32(k) * jnp.uint32(2654435761)),
    "converted": lambda x, y, k: jnp.stack([(100 * x).astype(int), k + (x > y), x.astype(bool) + k]),
    "single": lambda x, y, k: (x.astype(np.float32) * np.float32(1.7)).astype(float),
    "bits": lambda x, y, k: jax.lax.bitcast_convert_type(x, jnp.uint64) >> jnp.uint64(3),
    "shifts": lambda x, y, k: jnp.stack(
        [jnp.uint32(k) << (k % 40).astype(jnp.uint32), jnp.uint32(77) >> jnp.uint32(k)]
    ),
    "sums": lambda x, y, k: jnp.stack([jnp.sum(x * jnp.arange(5.0)), jnp.prod(y + jnp.arange(3.0))]),
    "extremes of several": lambda x, y, k: jnp.stack([jnp.max(jnp.stack([x, y, x * y])), jnp.min(jnp.stack([x, -y]))]),
    "first of equal": lambda x, y, k: jnp.stack([jnp.argmin(jnp.stack([x, y, x])), jnp.argmax(jnp.stack([y, x, y]))]),
    "any": lambda x, y, k: jnp.stack([jnp.any(jnp.stack([x > 1, y > 1])), jnp.all(jnp.stack([x > 1, y > 1]))]),
    "summed up": lambda x, y, k: jnp.cumsum(x * jnp.arange(4.0)),
    "products": lambda x, y, k: (x * jnp.arange(6.0).reshape(2, 3)) @ jnp.arange(3.0) + jnp.ones(2) @ jnp.ones((2, 2)),
    "moved": lambda x, y, k: jnp.concatenate([jnp.flip(x * jnp.arange(3.0)), jnp.stack([y])])[1:4:2],
    "padded": lambda x, y, k: jax.lax.pad(x * jnp.arange(1.0, 7.0).reshape(2, 3), y, [(1, 0, 2), (-1, 2, 0)]),
    "cropped": lambda x, y, k: jnp.concatenate(
        [jax.lax.pad(x * jnp.arange(1.0, 4.0), y, [(low, high, 0)]) for low, high in ((-4, 2), (2, -4), (-1, -1))]
    ),
    "diagonal": lambda x, y, k: jnp.diag(jnp.stack([x, y])),
    "turned": lambda x, y, k: (x * jnp.arange(6.0).reshape(2, 3)).T.reshape(2, 3),
    "table": lambda x, y, k: _table(x),
    "searches": lambda x, y, k: jnp.stack(
        [jnp.searchsorted(KNOTS, x), jnp.searchsorted(KNOTS, y, side="right"), jnp.digitize(x, KNOTS[::-1])]
    ),
    "all compared": lambda x, y, k: jnp.searchsorted(KNOTS.astype(np.float32), y, method="compare_all"),
    "interpolated": lambda x, y, k: jnp.stack([jnp.interp(x, KNOTS, TABLE), jnp.interp(y, x + KNOTS, y * TABLE)]),
    "total order": lambda x, y, k: jnp.stack([lax.lt_to_p.bind(x, y), lax.le_to_p.bind(-x, y), lax.lt_to_p.bind(k, k)]),
    "uniform table": lambda x, y, k: TABLE[PLACE] * x,
    "folded": lambda x, y, k: jnp.stack(
        [
            jax.jit(jax.lax.div)(LEAST, np.int32(2)),
            *(jax.jit(lambda v: v.astype(np.int32))(v) for v in (1e20, -1e20, 7.9)),
        ]
    ),
    "own table": lambda x, y, k: jnp.stack([x, y, x + y])[jnp.clip(k, 0, 2)],
    "part": lambda x, y, k: jax.lax.dynamic_slice(x * jnp.arange(5.0), (k,), (2,)),
    "written": lambda x, y, k: jnp.zeros(4).at[k].set(x),
    "rows written": lambda x, y, k: jnp.zeros((3, 2)).at[k].set(jnp.stack([x, y])),
    "added": lambda x, y, k: (jnp.arange(4.0) * y).at[k].add(x),
    "part written": lambda x, y, k: jax.lax.dynamic_update_slice(jnp.zeros(5), jnp.stack([x, y]), (k,)),
    "either way": lambda x, y, k: jax.lax.cond(x > y, lambda: jnp.sin(x) + y, lambda: x * y),
    "one of three": lambda x, y, k: jax.lax.switch(k, [lambda: x, lambda: y, lambda: x * y]),
    "scanned twice": lambda x, y, k: jax.lax.fori_loop(0, 3, lambda i, a: (a[0] * y + i, a[1] + a[0]), (x, y))[1],
    "scanned": lambda x, y, k: jax.lax.scan(lambda a, b: (a * y + b, a), x, jnp.arange(3.0), reverse=True)[1],
    "draws": lambda x, y, k: jax.random.normal(jax.random.fold_in(KEY, k), (3,)),
    "draws, 32 bits": lambda x, y, k: jax.random.bits(jax.random.fold_in(KEY, k), (), np.uint32),
    "arc": lambda x, y, k: jnp.stack([jnp.arctan2(x, y), jnp.tan(x), jnp.sinh(x / 40), jnp.cosh(y / 40)]),
    "logistic": lambda x, y, k: jnp.stack([jax.nn.sigmoid(x), jax.lax.rsqrt(jnp.abs(y))]),
}


@pytest.mark.slow
@killed_by("compiler/native/lanes.h", "REALLY(mask_max)(x, R_MASK(cmpeq)(x, x), x, y)", "REALLY(max)(x, y)")
@killed_by(
    "compiler.operations", 'NEGATED = {"eq": "ne", "ne": "eq"}', 'NEGATED = {"eq": "ne", "ne": "eq", "lt": "le"}'
)
@killed_by("compiler.lower.elementwise", '"TO_NEAREST_EVEN"', '"NEVER"')
@killed_by(
    "compiler.lower.elementwise", "graph.const(0, integer)), bits, reverse)", "graph.const(0, integer)), bits, bits)"
)
@killed_by(
    "compiler.lower.arrays",
    'better = graph.op("or", graph.op(beyond, x, best), nan)',
    'better = graph.op("not", graph.op(beyond, best, x))',
)
@killed_by("compiler.lower.random", "for i in range(5):", "for i in range(4):")
@killed_by("compiler.emit.cpp", "yield from self._fill_column(item, indent)", "pass")
@killed_by("compiler.ir", "if value <= ends.min", "if value < -1e30")
@killed_by("compiler.operations", "return x // y + ((x % y != 0)", "return x // y + ((x % y == 0)")
@killed_by("compiler.lower.arrays", "padded[first : max(first, last)]", "padded[first:]")
@killed_by("compiler.lower.elementwise", "x, 0, 0x33333333", "x, 0, 0x13333333")
def test_rules_are_those_of_jax():
    """Every rule in one kernel, NaN and infinite arguments among them."""
    rng = np.random.default_rng(5)
    x, y = rng.normal(0, 2, (2, 40))
    x[:6], y[4:8] = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0], [0.5, np.nan, 2.0, -np.inf]
    x[8], y[9] = 2.5, x[9]
    k = np.arange(-3, 37) % 9
    found = applied(RULES, x, y, k)
    expected = jax.device_get(jax.jit(lambda *at: {name: jax.vmap(rule)(*at) for name, rule in RULES.items()})(x, y, k))
    for name in RULES:
        np.testing.assert_allclose(found[name], expected[name], rtol=4e-15, atol=1e-14, err_msg=name)
    np.testing.assert_array_equal(found["draws, 32 bits"], expected["draws, 32 bits"])


@killed_by("compiler/native/lanes.h", "0x4530000080000000ull", "0x4530000000000000ull")
@pytest.mark.slow
def test_whole_numbers_of_64_bits_are_rounded_once(monkeypatch):
    """On a processor without AVX-512 the conversion is ours."""
    if platform.machine() == "x86_64":
        replace_seam(monkeypatch, "cpp_flags", (*toolchain.CPP_FLAGS, "-mno-avx512f"))
    rng, most = np.random.default_rng(7), np.iinfo(np.int64).max
    near = [s * (1 << e) + d for e in range(64) for d in (-1025, -513, -1, 0, 1, 511, 1023) for s in (1, -1)]
    ends = np.array([k for k in near if -most - 1 <= k <= most], np.int64)
    k = np.concatenate([ends, rng.integers(-most - 1, most, 4000, endpoint=True)])
    found = applied({"real": lambda x, y, k: k.astype(float)}, np.zeros(len(k)), np.zeros(len(k)), k)
    np.testing.assert_array_equal(found["real"], k.astype(np.float64))


def _long(x):
    """A function of so many operations that a conditional around it becomes a jump."""
    for k in range(30):
        x = x * (1 + 1e-3 * k) + jnp.sin(x)
    return x


@pytest.mark.slow
@killed_by("compiler.emit.cpp", "and x is not branch.condition\n", "\n")
@killed_by("compiler.emit.cpp", "self.rare: RareNumbers = RareNumbers({}, {})", "_ = 0")
def test_a_conditional_may_ask_a_parameter_or_a_carried_truth():
    """The condition is known before a run, or the step reads it for nothing else."""
    x, flag, which = np.linspace(0.1, 0.9, 7), np.arange(7) % 2 == 0, np.arange(7) % 3.0

    def run(x, flag, which):
        def step(lane, carry):
            flag, x, _ = carry
            asked = jax.lax.cond(lane > 0.5, lambda: _long(lane), lambda: lane)
            return flag, jax.lax.cond(flag, lambda: _long(x), lambda: x), asked

        same, over = (lambda lane, carry: carry), (lambda lane, carry: jnp.asarray(False))
        return run_lanes(same, step, over, which, (flag, x, x), steps=1, rounds=1)

    _, found, asked = jax.device_get(jax.jit(run)(x, flag, which))
    np.testing.assert_allclose(found, np.where(flag, jax.vmap(_long)(x), x), rtol=1e-14)
    np.testing.assert_allclose(asked, np.where(which > 0.5, jax.vmap(_long)(which), which), rtol=1e-14)
