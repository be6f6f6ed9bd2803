"""Programs that a command keeps make the bits of those that are traced, and are taken only where they would be the
same. What decides a program is tested in `test_kernel_start`, too."""

import dataclasses
import platform

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffabs as d
from diffabs import roads, scenario, stops
from diffabs.core import provenance
from diffabs.core.compiling import SAME, compile_once, shelf
from diffabs.core.pytree import pytree, strong
from diffabs.linear import care, dare
from diffabs.linear.riccati import _solved
from diffabs.objectives import BRAKING
from diffabs.roads.sign import _along
from diffabs.simulate.refusals import _margin
from diffabs.simulate.run import _run

LOOP = scenario.load("slip-lmi").loop
SOLVER = d.FixedStep(1e-3, 0.02)
MEASURED = {"iae": BRAKING["iae"]}


@pytest.fixture
def folder(tmp_path):
    """What programs are kept in; nobody has asked for one yet."""
    forget()
    shelf.put(tmp_path)
    yield tmp_path
    shelf.put(None)
    forget()


def forget():
    """As a new process, which has nothing but files."""
    for function in (_along, _margin, _run, _solved):
        function._programs.forget()


def programs(folder):
    return sorted(folder.glob("*.program"))


@pytest.fixture
def traced(monkeypatch):
    """How often the margin of a stop was traced, or a run."""
    count = []
    for function in (_margin, _run):
        trace = function._programs.function
        spy = lambda *args, trace=trace, **more: (count.append(1), trace(*args, **more))[1]  # noqa: E731
        monkeypatch.setattr(function._programs, "function", spy)
    return count


def margin(loop=LOOP):
    forget()
    return np.asarray(_margin(*strong((loop.plant, loop.initial, loop.stop))))


def test_a_run_has_the_bits_of_a_trace(folder, traced):
    """Other numbers are no other program, nor is another duration; the results have their names and kinds."""
    heavier = d.replace(LOOP, {"plant.mass": 6.0})
    asked = [(LOOP, SOLVER), (LOOP, SOLVER), (heavier, SOLVER), (LOOP, d.FixedStep(1e-3, 0.03))]
    found = []
    for loop, solver in asked:
        forget()
        found.append(jax.device_get(d.measure(loop, solver, MEASURED)))
    assert len(traced) == len(programs(folder)) == 1
    shelf.put(None)
    for run, (loop, solver) in zip(found, asked, strict=True):
        wanted = jax.device_get(d.measure(loop, solver, MEASURED))
        assert jax.tree.structure(run) == jax.tree.structure(wanted)
        for x, y in zip(jax.tree.leaves(run), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_array_equal(x, y, strict=True)
    assert len({float(run.metrics["iae"]) for run in found}) == 3


class TestPrograms:
    def test_of_another_part_are_others(self, folder, traced):
        assert margin() == margin() == LOOP.initial.speed - LOOP.stop.speed
        assert margin(dataclasses.replace(LOOP, stop=stops.Standstill(speed=1.0))) == LOOP.initial.speed - 1.0
        assert len(traced) == len(programs(folder)) == 2

    def test_of_another_precision_are_others(self, folder, traced):
        margin()
        assert margin(jax.tree.map(jnp.float32, LOOP)).dtype == np.float32
        assert len(traced) == len(programs(folder)) == 2

    def test_of_another_method_are_others(self, folder, monkeypatch):
        margin()
        monkeypatch.setattr(stops.SpeedReached, "margin", lambda self, output: 2 * (output.speed - self.speed))
        margin()
        assert len(programs(folder)) == 2

    def test_of_another_processor_are_others(self, folder, traced, monkeypatch):
        margin()
        provenance.processor.cache_clear()
        monkeypatch.setattr(platform, "processor", lambda: "another")
        margin()
        provenance.processor.cache_clear()
        assert len(traced) == len(programs(folder)) == 2

    def test_of_other_options_are_others(self, folder, traced, monkeypatch):
        margin()
        monkeypatch.setattr(_margin._programs, "_options", SAME)
        margin()
        assert len(traced) == len(programs(folder)) == 2

    @pytest.mark.parametrize("how", ["damaged", "half", "no program"])
    def test_that_are_not_whole_are_made_anew(self, how, folder, traced):
        first = margin()
        (path,) = programs(folder)
        data = path.read_bytes()
        path.write_bytes({"damaged": data[:-900] + bytes(900), "half": data[: len(data) // 2]}.get(how, b"{}\n"))
        assert margin() == margin() == first
        assert len(traced) == 2
        assert path.read_bytes().partition(b"\n")[0] != b"{}"

    def test_of_a_part_from_outside_are_not_kept(self, folder, traced):
        @pytree
        class Outside(stops.SpeedReached):
            pass

        assert margin(dataclasses.replace(LOOP, stop=Outside(speed=LOOP.stop.speed))) == margin()
        assert len(traced) == len(programs(folder)) == 1

    def test_under_a_trace_are_traced(self, folder):
        speed = jax.jit(lambda speed: margin_at(speed))(9.0)
        assert speed == pytest.approx(9.0 - LOOP.stop.speed, rel=1e-15, abs=0)
        assert not programs(folder)

    def test_where_nothing_is_to_be_kept(self, folder, monkeypatch):
        monkeypatch.setenv("DIFFABS_NO_CACHE", "1")
        margin()
        assert not programs(folder)


def margin_at(speed):
    return _margin(*strong((LOOP.plant, dataclasses.replace(LOOP.initial, speed=speed), LOOP.stop)))


class TestArguments:
    def test_static_ones_are_part_of_a_program(self, folder):
        """The same matrices, another equation."""
        one = jnp.eye(1)
        for solve, a, wanted in ((care, 0.0, 1.0), (dare, 1.0, (1 + 5**0.5) / 2)):
            np.testing.assert_allclose(solve(a * one, one, one, one).P, [[wanted]], rtol=1e-12)
        assert len(programs(folder)) == 2

    def test_plain_numbers_are_not(self, folder):
        for w4 in (0.35, 0.4):
            forget()
            (rule,) = roads.RationalCurve(w4=w4).rules()
            assert rule.holds
        assert len(programs(folder)) == 1


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1, 2**40])
def test_the_key_of_a_run_is_that_of_jax(seed):
    found, wanted = scenario.Scenario("mine", seed=seed).key(), jax.random.key(seed)
    assert found.dtype == wanted.dtype
    np.testing.assert_array_equal(jax.random.key_data(found), jax.random.key_data(wanted))


def test_what_has_the_name_of_another_function_is_refused():
    with pytest.raises(TypeError, match="that of another"):
        compile_once(options=SAME)(jax.vmap(jnp.sin))
