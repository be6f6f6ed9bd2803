"""What was traced and compiled once is there for the next process, and only if it would be the same."""

import dataclasses
import json
import os
import secrets
import shutil
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import FOLDER
from marks import cases

import diffabs as d
from diffabs import controllers, scenario, stops
from diffabs.core import fingerprint
from diffabs.core import kept as kept_files
from diffabs.core.fingerprint import Unknown
from diffabs.core.pytree import get, pytree
from diffabs.kernel import compilers, kept, launch, program
from diffabs.objectives import BRAKING
from diffabs.simulate import landing, native
from diffabs.sweep import runner

pytestmark = pytest.mark.xdist_group("kernel")

LOOP = scenario.load("slip-lmi").loop
SOLVER = d.FixedStep(1e-3, 0.02)
MEASURED = {"iae": BRAKING["iae"]}
SPEEDS = {"initial.speed": np.linspace(8.0, 9.0, 5)}


@pytest.fixture(autouse=True)
def folder(monkeypatch):
    """A new folder of programs, beside the libraries that are kept between tests."""
    monkeypatch.setenv(compilers.CACHE, FOLDER)
    monkeypatch.setattr(kept, "FOLDER", f"programs-{secrets.token_hex(4)}")
    monkeypatch.setattr(launch, "VECTORS", 1)
    monkeypatch.delenv(kept_files.OFF, raising=False)
    native._kept.forget()
    place = compilers.cache_folder() / kept.FOLDER
    yield place
    shutil.rmtree(place, ignore_errors=True)
    native._kept.forget()


def run(loop=LOOP, solver=SOLVER, measured=MEASURED, values=SPEEDS, keys=None):
    lanes = d.Batch(values, keys)
    return jax.device_get(d.run_batch(loop, lanes, solver, measured, accepted=True, together=False, engine="kernel"))


def again(**changed):
    """In what a new process has: nothing but files."""
    native._kept.forget()
    return run(**changed)


def same_bits(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture
def traced(monkeypatch):
    """How often a loop was translated."""
    count = []
    trace = program.traced
    monkeypatch.setattr(program, "traced", lambda *args: (count.append(1), trace(*args))[1])
    return count


class TestPrograms:
    def test_are_not_traced_again_and_make_the_same_bits(self, traced, folder):
        """Other numbers are no other program; the results have their names and kinds."""
        first = run()
        assert len(traced) == 1
        same_bits(again(), first)
        heavier = again(loop=d.replace(LOOP, {"plant.mass": 6.0}))
        assert len(traced) == 1
        assert not np.any(heavier.metrics["iae"] == first.metrics["iae"])
        assert len([*folder.glob("*.program")]) == 1

    def test_are_those_of_a_trace(self, monkeypatch):
        run()
        found = again()
        monkeypatch.setenv(kept_files.OFF, "1")
        same_bits(again(), found)

    def test_are_whole_though_jax_has_a_cache_of_its_own(self, folder):
        """What JAX reads back from there cannot be written again."""
        least = "jax_persistent_cache_min_compile_time_secs"
        before = jax.config.values[least]
        jax.config.update(least, 0.0)
        try:
            self._made_twice(folder)
        finally:
            jax.config.update(least, before)

    def _made_twice(self, folder):
        first = run()
        (path,) = folder.glob("*.program")
        path.unlink()
        same_bits(again(), first)
        same_bits(again(), first)

    @pytest.mark.parametrize(
        "changed",
        [
            {"measured": {"other": BRAKING["iae"]}},
            {"loop": dataclasses.replace(LOOP, controller=controllers.PID(kp=1.0, ki=0.0, kd=0.0))},
            {"values": {"initial.speed": SPEEDS["initial.speed"][:4]}},
        ],
        ids=["name", "part", "lanes"],
    )
    def test_of_another_structure_are_others(self, changed, traced):
        run()
        again(**changed)
        assert len(traced) == 2

    def test_of_other_constants_are_others(self):
        for factor in (2.0, 3.0):
            program = kept.Kept(jax.jit(lambda x, factor=factor: {"y": factor * x}), (native._run, np.asarray(factor)))
            assert program(jnp.ones(2))["y"].tolist() == [factor, factor]

    @pytest.mark.parametrize("how", cases(["damaged", "half", "no library", "no program"], "half", "no program"))
    def test_that_are_not_whole_are_made_anew(self, how, traced, folder, monkeypatch):
        first = run()
        (path,) = folder.glob("*.program")
        data = path.read_bytes()
        head, _, body = data.partition(b"\n")
        if how == "no library":
            head = json.dumps(json.loads(head) | {"libraries": ["none.so"]}).encode()
        ends = {
            "damaged": data[:-9000] + bytes(9000),
            "half": data[: len(data) // 2],
            "no library": head + b"\n" + body,
        }
        path.write_bytes(ends.get(how, b"{}\n"))
        same_bits(again(), first)
        assert len(traced) == 2
        same_bits(again(), first)
        assert len(traced) == 2

    def test_in_a_folder_that_cannot_be_written(self, folder, traced):
        folder.parent.mkdir(exist_ok=True)
        folder.write_text("")
        try:
            same_bits(run(), again())
            assert len(traced) == 2
        finally:
            folder.unlink()

    def test_have_so_much_room(self, folder, monkeypatch):
        folder.mkdir(parents=True, exist_ok=True)
        for i in range(4):
            path = folder / f"{i}.program"
            path.write_bytes(bytes(10))
            os.utime(path, (i, i))
        monkeypatch.setattr(kept_files, "ROOM", 39)
        run()
        assert {"2.program", "3.program"} < {path.name for path in folder.iterdir()}
        assert not (folder / "1.program").exists()

    def test_under_jit_are_traced(self, traced):
        found = jax.jit(lambda mass: run_live(d.replace(LOOP, {"plant.mass": mass})))(6.0)
        assert len(traced) == 1
        assert np.isfinite(found).all()


def run_live(loop):
    return d.run_batch(loop, d.Batch(SPEEDS), SOLVER, MEASURED, accepted=True, together=False, engine="kernel").metrics[
        "iae"
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario.names())
def test_of_a_scenario(name, traced):
    one = scenario.load(name)
    path = {"arm-balance": "initial.theta", "arm-hanging": "initial.theta"}.get(name, "initial.speed")
    values = {path: np.linspace(0.98, 1.0, 4) * float(get(one.loop, path))}
    whole = {"loop": one.loop, "solver": one.solver, "measured": dict(one.objectives)}
    whole |= {"values": values, "keys": np.arange(4)}
    same_bits(run(**whole), again(**whole))
    assert len(traced) == 1


@pytree
class Outside(stops.SpeedReached):
    """A part that is not of the package."""


class TestWhatNobodyCanTell:
    def test_a_part_from_outside(self, traced, folder):
        loop = dataclasses.replace(LOOP, stop=Outside(speed=LOOP.stop.speed))
        same_bits(run(loop=loop), again(loop=loop))
        assert len(traced) == 2
        assert not [*folder.glob("*.program")]

    @pytest.mark.parametrize(
        "thing",
        [object(), lambda x: x, np.array([None]), jnp.sin],
        ids=["an object", "a function", "an array of objects", "a compiled function"],
    )
    def test_other_things(self, thing):
        with pytest.raises(Unknown):
            fingerprint.digest(thing, None)

    def test_a_part_that_holds_more_than_its_fields(self):
        part = stops.SpeedReached(speed=1.0)
        object.__setattr__(part, "more", 1)
        with pytest.raises(Unknown, match=r"SpeedReached\.more"):
            fingerprint.digest(part, None)

    def test_a_file_that_is_newer_than_what_was_loaded(self, monkeypatch):
        fingerprint._sources.cache_clear()
        monkeypatch.setattr(fingerprint, "BEGAN", 0.0)
        with pytest.raises(Unknown, match="is newer than what runs"):
            fingerprint.surroundings()


class TestSurroundings:
    def test_are_the_same_twice(self):
        assert fingerprint.surroundings() == fingerprint.surroundings()

    def test_differ_for_what_was_put_into_a_module(self, monkeypatch):
        """A constant, a function, a method of a class."""
        found = [fingerprint.surroundings()]
        for owner, name in ((launch, "LINES"), (landing, "seek"), (controllers.PID, "flow")):
            with monkeypatch.context() as patch:
                patch.setattr(owner, name, 7 if name == "LINES" else lambda *args: None)
                found.append(fingerprint.surroundings())
        assert len(set(found)) == 4

    def test_differ_for_settings(self, monkeypatch):
        found = [fingerprint.surroundings()]
        with jax.enable_x64(False):
            found.append(fingerprint.surroundings())
        monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        found.append(fingerprint.surroundings())
        assert len(set(found)) == 3

    def test_differ_for_the_files(self, tmp_path, monkeypatch):
        found = [fingerprint.surroundings()]
        monkeypatch.setattr(fingerprint, "PACKAGE", tmp_path / "diffabs")
        (tmp_path / "diffabs").mkdir()
        (tmp_path / "diffabs" / "one.py").write_text("")
        monkeypatch.setattr(fingerprint, "BEGAN", time.time() + 1)
        fingerprint._sources.cache_clear()
        found.append(fingerprint.surroundings())
        fingerprint._sources.cache_clear()
        assert len(set(found)) == 2


class TestDigest:
    def test_of_what_is_given_is_that_of_types_and_shapes(self):
        one, other = (stops.SpeedReached(speed=jnp.asarray(x, np.float64)) for x in (1.0, 2.0))
        assert fingerprint.digest(one, None) == fingerprint.digest(other, None)
        assert fingerprint.digest(None, one) != fingerprint.digest(None, other)
        single = stops.SpeedReached(speed=jnp.asarray(1.0, np.float32))
        assert fingerprint.digest(one, None) != fingerprint.digest(single, None)

    def test_of_functions_is_that_of_their_names(self):
        assert fingerprint.digest(None, runner._block) != fingerprint.digest(None, native._run)
