"""What a process takes over from others: compiled libraries, if they are of its own code; nothing across a fork."""

import json
import os
import subprocess
import sys

import pytest
from kernels import FOLDER

from diffabs.compiler.runtime import library_cache
from diffabs.engine.drive.engine import ENGINE_VARIABLE

pytestmark = pytest.mark.xdist_group("kernel")

# A user's script that replaces a method of a part, in ways that leave module, name and first line as they were. In one
# process JAX keeps what it has traced, until it is told that the code is another.
PATCHED = """
import functools, json, sys
from unittest import mock
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import diffabs as d
from diffabs import objectives, roads
from diffabs.compiler import pipeline
from diffabs.scenario import load

pipeline.VECTORS_PER_BLOCK = 1
Road, factor, kinds = roads.RationalCurve, float(sys.argv[1]), sys.argv[2:]
original, code = Road.friction, Road.friction.__code__

def scaled(self, slip, speed=0.0, distance=0.0, factor=factor):
    return factor * original(self, slip, speed, distance)

def replace_friction(kind):
    if kind == "default":
        Road.friction = scaled
    elif kind == "wraps":
        Road.friction = functools.wraps(original)(scaled)
    elif kind == "closure":
        Road.friction = lambda self, slip, speed=0.0, distance=0.0: factor * original(self, slip, speed, distance)
    elif kind == "text":
        exec(f"Road.friction = lambda self, slip, speed, distance: {factor} * original(self, slip)", globals())
    elif kind == "partialmethod":
        Road.friction = functools.partialmethod(scaled, factor=factor)
    elif kind == "mock":
        mock.patch.object(Road, "friction", autospec=True, side_effect=scaled).start()
    elif kind == "code":
        text = f"def friction(self, slip, speed=0.0, distance=0.0):\\n    return {factor} * odd(self._curve, slip)"
        program = compile("\\n" * (code.co_firstlineno - 1) + text, code.co_filename, "exec")
        exec(program, sys.modules[Road.__module__].__dict__, names := {})
        original.__code__ = names["friction"].__code__

loop = load("slip-lmi", integrated=False).loop
asked = loop, d.Batch({"initial.speed": np.array([8.0, 9.0])}), d.FixedStep(1e-3, 1.0), {"d": objectives.StopDistance()}
found = {}
for kind in kinds:
    replace_friction(kind)
    jax.clear_caches()
    runs = {engine: d.run_batch(*asked, engine=engine, accepted=True) for engine in ("kernel", "xla")}
    found[kind] = {engine: run.metrics["d"].tolist() for engine, run in runs.items()}
    Road.friction, original.__code__ = original, code
print(json.dumps(found))
"""


def distances(factor, kinds, folder):
    words = [sys.executable, "-c", PATCHED, str(factor), *kinds]
    quick = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    environment = os.environ | {library_cache.CACHE: FOLDER, "XDG_CACHE_HOME": str(folder), "XLA_FLAGS": quick}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kinds",
    [
        ["default"],
        pytest.param(
            ["wraps", "closure", "text", "partialmethod", "mock", "code"], marks=pytest.mark.slow, id="others"
        ),
    ],
)
def test_a_patched_part_gets_its_own_numbers(kinds, tmp_path):
    """The processes share their caches, and their code differs by what no name tells: a default, a closure, a body."""
    plain, scaled = (distances(factor, kinds, tmp_path) for factor in (1.0, 0.8))
    for kind in kinds:
        for found in (plain[kind], scaled[kind]):
            assert found["kernel"] == pytest.approx(found["xla"], rel=1e-9)
        assert scaled[kind]["xla"][0] > 1.1 * plain[kind]["xla"][0]


FORKED = """
import os
import diffabs as d
from diffabs import scenario
from diffabs.engine.drive import engine
from diffabs.loop import ensemble

def in_a_child(task):
    if child := os.fork():
        assert os.waitpid(child, 0)[1] == 0
        return
    try:
        task()
        print("runs", flush=True)
    except RuntimeError as error:
        print(error, flush=True)
    os._exit(0)

in_a_child(engine.check_process)
loop = scenario.load("slip-lmi").loop
lanes = d.Batch({"initial.speed": [8.0, 9.0]})
in_a_child(lambda: d.run_batch(loop, lanes, d.FixedStep(1e-3, 0.02), {}, engine="kernel"))
in_a_child(lambda: in_a_child(lambda: d.run_batch(loop, lanes, d.FixedStep(1e-3, 0.02), {}, engine="auto")))
in_a_child(lambda: ensemble.kernel_objection(loop, {"initial.speed": [8.0, 9.0]}, d.FixedStep(1e-3, 0.02), {}))
engine.check_process()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.slow
def test_a_kernel_in_a_forked_process_is_an_error():
    """XLA's threads stay in the parent, also where it has only read a scenario: the child would wait for ever."""
    words = [sys.executable, "-W", "ignore:os.fork", "-c", FORKED]
    users = {name: value for name, value in os.environ.items() if name != ENGINE_VARIABLE}
    done = subprocess.run(words, env=users, capture_output=True, text=True, check=True, timeout=60)
    refused = "no kernel runs after os.fork: XLA's threads stay in the parent; start processes by `spawn`"
    assert done.stdout.splitlines() == ["runs", refused, refused, "runs", refused]
