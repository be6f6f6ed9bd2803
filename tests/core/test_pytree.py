"""How parts are made, checked, read and replaced."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mutants import killed_by

import diffabs
from diffabs.core.arrays import as_array
from diffabs.core.pytree import (
    arrays,
    canonical_dtypes,
    get,
    param,
    parameters,
    part,
    parts,
    prepare_parts,
    pytree,
    replace,
    static,
)
from diffabs.core.validity import check_part, find_misshapen, find_problems
from diffabs.parts.controllers import StateFeedback
from diffabs.parts.objectives import IAE
from diffabs.parts.plants import MirroredRig
from diffabs.parts.roads import DRY_ASPHALT, SPLINE_B, MagicFormula, Patches, Scaled
from diffabs.parts.sensors import PlayedWheelNoise
from diffabs.parts.stops import SpeedReached


@pytree
class Spring:
    stiffness: float = param(default=2.0, unit="N/m", above=0.0)
    damping: float = param(default=0.5, unit="1", low=0.0, below=1.0)
    rest: float = param(default=(0.0, 1.0), unit="m")
    turns: int = static(default=3)

    def problems(self):
        if self.rest[0] == self.rest[1]:
            yield "rest has two equal lengths"


@pytree
class Pair:
    springs: tuple = part(default=(Spring(), Spring(stiffness=5.0)))
    limit: float = param(default=np.inf, unit="N", infinite=True)


def test_refuses_post_init():
    with pytest.raises(TypeError, match=r"Bad: no __post_init__.*rules\(self\)"):

        @pytree
        class Bad:
            x: float = param(default=1.0, unit="1")

            def __post_init__(self):
                raise AssertionError


def test_refuses_undeclared_fields():
    with pytest.raises(TypeError, match=r"Bad: declare y, z with param, part or static"):

        @pytree
        class Bad:
            x: float = param(default=1.0, unit="1")
            y: float = 2.0
            z: float = dataclasses.field(default=3.0)


def test_parts_are_frozen_and_keyword_only():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Spring().stiffness = 3.0  # pyright: ignore
    with pytest.raises(TypeError, match="positional"):
        Spring(3.0)  # pyright: ignore


def test_static_fields_are_no_leaves():
    assert jax.tree.leaves(Spring())[:2] == [2.0, 0.5]
    assert len(jax.tree.leaves(Spring())) == 3


def test_static_field_compiles_again_and_a_value_does_not():
    traces = []

    @jax.jit
    def double(spring):
        traces.append(spring.turns)
        return 2 * spring.stiffness

    assert double(canonical_dtypes(Spring())) == 4.0
    assert double(canonical_dtypes(Spring(stiffness=3.0))) == 6.0
    assert double(canonical_dtypes(Spring(turns=4))) == 4.0
    assert traces == [3, 4]


def test_check_names_every_offender_with_value_range_and_unit():
    bad = Pair(springs=(Spring(stiffness=0.0), Spring(damping=1.0)), limit=np.nan)
    with pytest.raises(ValueError, match="outside") as error:
        check_part(bad, "pair.")
    assert str(error.value).split("; ") == [
        "pair.springs.0.stiffness = 0 is outside (0, inf) N/m",
        "pair.springs.1.damping = 1 is outside [0, 1)",
        "pair.limit = nan is outside (-inf, inf) N",
    ]


@killed_by("core.pytree", " & ((abs(x) < math.inf) | self.infinite)", "")
def test_check_returns_the_part_and_allows_declared_infinities():
    pair = Pair()
    assert check_part(pair) is pair
    assert list(find_problems(Pair(limit=-np.inf))) == []
    assert list(find_problems(Spring(stiffness=np.inf))) == ["stiffness = inf is outside (0, inf) N/m"]


def test_check_sees_one_bad_element_of_an_array():
    with pytest.raises(ValueError, match=r"rest = \[ ?0\. nan\] is outside \(-inf, inf\) m"):
        check_part(Spring(rest=np.array([0.0, np.nan])))


@killed_by("core.validity", "suppress(jax.errors.JAXTypeError)", "suppress()")
def test_own_problems_of_traced_numbers():
    """Compiled, two lengths cannot be compared; a shape is known, and so is a number under `grad`."""
    said = []

    def look(rest):
        said.extend((list(find_misshapen(Spring(rest=rest))), list(find_misshapen(PlayedWheelNoise(noise=rest[:0])))))
        return rest.sum()

    empty = ["noise has shape (0,); it needs (n,), n at least 1"]
    jax.jit(look)(np.ones(2))
    jax.grad(look)(np.ones(2))
    assert said == [[], empty, ["rest has two equal lengths"], empty]


def test_own_problems_have_the_path_and_wait_for_the_ranges():
    same = np.array([1.0, 1.0])
    assert list(find_problems(Pair(springs=(Spring(rest=same),)))) == ["springs.0.rest has two equal lengths"]
    assert list(find_problems(Spring(rest=same, damping=2.0))) == ["damping = 2 is outside [0, 1)"]


@killed_by("core.pytree", "tuple | list):\n        for", "tuple):\n        for", case="list")
@killed_by("core.pytree", "isinstance(value, tuple | list) else", "isinstance(value, tuple) else", case="list")
@pytest.mark.parametrize("kind", [tuple, list])
def test_parameters_in_order_of_declaration(kind):
    pair = Pair(springs=kind(Pair().springs))
    assert len(list(parts(pair))) == 2
    paths = [path for path, _, _ in parameters(pair)]
    names = ("stiffness", "damping", "rest")
    assert paths == [f"springs.{i}.{name}" for i in range(2) for name in names] + ["limit"]
    assert [spec.unit for _, spec, _ in parameters(Spring())] == ["N/m", "1", "m"]


def test_get_and_replace_by_dotted_path():
    pair = replace(Pair(), {"springs.1.stiffness": 7.0, "limit": 4.0})
    assert get(pair, "springs.1.stiffness") == 7.0
    assert (get(pair, "springs.0.stiffness"), get(pair, "limit")) == (2.0, 4.0)
    assert get(Pair(), "springs.1.stiffness") == 5.0  # the original is untouched
    assert diffabs.replace(pair, {"springs.0": Spring(turns=9)}).springs[0].turns == 9
    assert get(replace(diffabs.braking(), {"plant.road": MagicFormula(D=0.5)}), "plant.road.D") == 0.5


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("spring.0.damping", "no 'spring' in spring.0.damping; there is springs, limit"),
        ("springs.2.damping", "no '2' in springs.2.damping; there is 0, 1"),
        ("springs.0.dampin", "no 'dampin' in springs.0.dampin; there is stiffness, damping, rest"),
        ("limit.x", "no 'x' in limit.x; there is nothing"),
    ],
)
def test_wrong_path_says_what_is_there(path, message):
    for use in (lambda: get(Pair(), path), lambda: replace(Pair(), {path: 1.0})):
        with pytest.raises(KeyError) as error:
            use()
        assert error.value.args[0] == message


@killed_by("core.pytree", "jnp.result_type(part, 0.0)", "jnp.result_type(part)", case="array0")
@killed_by("core.pytree", "isinstance(part, tuple | list) or", "isinstance(part, tuple) or", case="list")
@killed_by("core.pytree", "isinstance(part, tuple) or dataclasses.is_dataclass(part[i])", "True", case="array0")
@pytest.mark.parametrize("kind", [tuple, list, np.array, jnp.array])
def test_a_number_replaces_one_of_several_integers(kind):
    for use in (lambda function: function, jax.jit):
        found = use(lambda spring, x: replace(spring, {"rest.0": x}).rest)(Spring(rest=kind([10, 20])), 12.5)
        np.testing.assert_array_equal(found, [12.5, 20.0])
        assert isinstance(found, tuple if kind is tuple else jax.Array)


def test_replace_under_grad_and_vmap():
    def force(k):
        spring = replace(Pair(), {"springs.1.stiffness": k}).springs[1]
        return spring.stiffness**2 * spring.damping

    np.testing.assert_allclose(jax.grad(force)(3.0), 3.0, rtol=1e-15, atol=0)
    np.testing.assert_allclose(jax.vmap(force)(jnp.array([1.0, 2.0])), [0.5, 2.0], rtol=1e-15, atol=0)


def test_strong_makes_one_dtype():
    """That of the JAX arrays among the leaves; JAX's default for Python numbers and NumPy arrays alone."""
    for tree, dtype in (
        ({"a": 1.0, "b": np.float32(2.0), "c": 3}, jnp.float64),
        ({"a": 1.0, "b": jnp.float32(2.0)}, jnp.float32),
        ({"a": jnp.ones(2, jnp.float32), "b": jnp.float64(2.0)}, jnp.float64),
        ({"a": 1.0, "k": jnp.arange(3)}, jnp.float64),
    ):
        leaves = jax.tree.leaves(canonical_dtypes(tree))
        assert [x.dtype for x in leaves] == [dtype] * len(leaves)
        assert not any(x.weak_type for x in leaves)


@killed_by("core.pytree", "{path: as_rule_array(value)", "{path: jnp.asarray(value)")
def test_every_parameter_becomes_an_array_of_one_type():
    """Also a list and an integer; what is static stays, and so does the precision of an array among them."""
    made = arrays(Pair(springs=(Spring(stiffness=3, rest=[0.0, 2.0], turns=9), Spring(damping=jnp.float32(0.25)))))
    leaves = jax.tree.leaves(made)
    assert [type(x) for x in leaves] == [type(jnp.ones(()))] * 7
    assert {x.dtype.name for x in leaves} == {"float32"}
    assert (made.springs[0].turns, made.springs[0].rest.shape, made.limit) == (9, (2,), np.inf)
    slope = jax.grad(lambda k: arrays(Spring(stiffness=k)).stiffness ** 2)(3.0)
    np.testing.assert_allclose(slope, 6.0, rtol=1e-15, atol=0)


@pytest.mark.slow
@killed_by("core.pytree", "return canonical_dtypes(stack_lists(part))", "return stack_lists(part)")
def test_equinox_differentiates_every_parameter():
    """The reverse pass of `jax.grad`, but for what Equinox counts as differentiable: one leaf of this rig's floats."""
    filter_grad = pytest.importorskip("equinox", reason="equinox is in the group `ecosystem`").filter_grad
    rig = diffabs.braking(
        plant=MirroredRig(),
        controller=StateFeedback(),
        initial=diffabs.BrakeStart(speed=5.0),
        stop=SpeedReached(speed=4.0),
    )

    def iae(loop):
        return diffabs.measure(loop, diffabs.FixedStep(1e-3, 0.5), {"iae": IAE()}).metrics["iae"]

    found, want = filter_grad(iae)(diffabs.arrays(rig)), jax.grad(iae)(rig)
    count = len(jax.tree.leaves(rig))
    assert (len(jax.tree.leaves(filter_grad(iae)(rig))), len(jax.tree.leaves(found))) == (1, count)
    assert sum(bool(np.any(leaf)) for leaf in jax.tree.leaves(found)) > count // 2
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)  # the same program


def test_strong_saves_a_compilation():
    """A Python float and an array are two types to jit. With `strong` they are one."""
    for prepare, count in ((lambda tree: tree, 2), (canonical_dtypes, 1)):
        double = jax.jit(lambda spring: 2 * spring.stiffness)
        double(prepare(Spring()))
        double(prepare(Spring(stiffness=jnp.asarray(3.0))))
        assert double._cache_size() == count


@killed_by("core.pytree", "tuple | list):\n        return tuple", "tuple):\n        return tuple", case="list")
@pytest.mark.parametrize("kind", [tuple, list])
def test_prepared_reaches_nested_parts_and_keeps_the_rest(kind):
    roads = kind([Scaled(road=SPLINE_B, scale=0.7), DRY_ASPHALT])
    road = prepare_parts(replace(diffabs.braking(), {"plant.road": Patches(roads=roads)}))
    inner = road.plant.road.roads[0]
    assert type(inner.road).__name__ == "PiecewiseCubic"
    assert inner.scale == 0.7
    assert road.plant.road.roads[1].c1 == DRY_ASPHALT.c1
    assert prepare_parts(()) == ()


def test_prepared_is_differentiable():
    """mu at a knot is the knot's value, so the derivative with respect to it is one."""

    def mu(value):
        road = dataclasses.replace(SPLINE_B, mu=jnp.asarray(SPLINE_B.mu).at[4].set(value))
        return prepare_parts(road).friction(SPLINE_B.slip[4])

    np.testing.assert_allclose(jax.jit(jax.grad(mu))(0.96331), 1.0, rtol=1e-12, atol=0)


@killed_by(
    "core.pytree",
    "    _register(new, [f.name for f in fields if f.name not in meta], meta)\n",
    "    jax.tree_util.register_dataclass(new, [f.name for f in fields if f.name not in meta], meta)\n",
)
def test_structures_of_different_classes_differ():
    """Else jit may run for one class what it compiled for another: `jax.tree_util.register_dataclass` of JAX 0.10
    compares neither classes nor names of fields."""

    @pytree
    class Twin:
        stiffness: float = param(default=2.0, unit="N/m", above=0.0)
        damping: float = param(default=0.5, unit="1", low=0.0, below=1.0)
        rest: float = param(default=(0.0, 1.0), unit="m")
        turns: int = static(default=3)

    assert jax.tree.structure(Twin()) != jax.tree.structure(Spring())
    assert jax.tree.structure(Spring(turns=4)) != jax.tree.structure(Spring())
    assert jax.tree.structure(Spring(damping=0.1)) == jax.tree.structure(Spring())


def test_leaves_have_the_names_of_the_fields():
    keys = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(Pair())]
    assert keys[:2] == [".springs[0].stiffness", ".springs[0].damping"]


@killed_by("core.arrays", "_number(float(x), math.copysign(1.0, x), ", "_number(float(x), 1.0, ")
def test_an_array_is_made_once_of_each_number():
    """Of each type, and of 0 and -0, which are equal; within jit none is kept."""
    first, second = (canonical_dtypes([0.0, -0.0, 1.5]) for _ in range(2))
    assert all(a is b for a, b in zip(first, second, strict=True))
    assert np.signbit(first).tolist() == [False, True, False]
    assert canonical_dtypes([1.5, jnp.float32(2.0)])[0].dtype == np.float32
    jax.jit(lambda: canonical_dtypes([7.25]))()
    assert not isinstance(canonical_dtypes([7.25])[0], jax.core.Tracer)


def test_an_array_of_a_number_has_the_precision_of_now():
    with jax.enable_x64(False):
        assert as_array(2.7, np.float64).dtype == np.float32
    assert as_array(2.7, np.float64).dtype == np.float64
