"""The native prover at its edges: no states, no signals, an interrupt; and its memory, under sanitizers."""

import os
import pathlib
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from mutants import killed_by

from diffabs.robust.reach.engine import FAILURES, Prover
from diffabs.robust.reach.equations import Equations, RealOperation

CELLS = np.array([[[0.3, 0.4]], [[-1.0, 2.0]]])
SCRIPT = pathlib.Path(__file__).parents[1] / "support" / "sanitized_prover.py"


def still(period: float | None = None) -> Equations:
    """x' = -x from 1, which no signal but `x` needs; the others depend on the parameter p alone, or on nothing."""
    operations = [
        RealOperation("param", (), 0), RealOperation("const", (), 5.0), RealOperation("const", (), 1.0),
        RealOperation("mul", (0, 0)), RealOperation("state", (), 0), RealOperation("neg", (4,)),
        RealOperation("state", (), 1), RealOperation("const", (), 0.0), RealOperation("inv", (0,)),
    ]  # fmt: skip
    signals = {"param": 0, "const": 1, "square": 3, "inverse": 8, "x": 4, "t": 6}
    return Equations(
        tuple(operations), ("p",), ("x", "t"), (2, 7), (5, 2), (4, 6) if period else (), period, signals, 2, (), -1, -1,
        1, False,
    )  # fmt: skip


@pytest.mark.usefixtures("native_prover")
@killed_by("robust.reach.engine", "if not self.persistent:", "if False:")
@pytest.mark.parametrize("period", [None, 0.1], ids=["continuous", "sampled"])
def test_signals_that_depend_on_no_state_are_bounded(period):
    prover = Prover(still(period), ("param", "const", "square", "inverse"), 1.0)
    assert prover.persistent == []
    prover.choose_weights(np.array([0.35]))
    found = prover.prove(CELLS, 1)
    assert found.status.tolist() == [2, 2]
    np.testing.assert_allclose(found.lower[0], [0.3, 5.0, 0.09, 2.5], rtol=1e-12)
    np.testing.assert_allclose(found.upper[0], [0.4, 5.0, 0.16, 1 / 0.3], rtol=1e-12)
    assert (found.lower[1] <= [-1.0, 5.0, 0.0, -np.inf]).all()
    assert (found.upper[1] >= [2.0, 5.0, 4.0, np.inf]).all()  # p may be 0, so 1/p has no value


@pytest.mark.usefixtures("native_prover")
@pytest.mark.parametrize("signals", [(), ("x",), ("t", "param")])
def test_any_signals_may_be_wanted(signals):
    found = Prover(still(), signals, 1.0).prove(CELLS, 2)
    assert found.status.tolist() == [2, 2]
    assert found.lower.shape == (2, len(signals))
    if signals == ("x",):
        assert found.lower[0, 0] <= np.exp(-1.0) < found.lower[0, 0] + 0.05


@pytest.mark.usefixtures("native_prover")
@killed_by("robust.reach.engine", "stop.value = 1", "stop.value = 0")
def test_an_interrupt_ends_native_calls():
    """A run of 1e9 s under short steps would take minutes. Without the stop its threads go on after the interrupt."""
    prover = Prover(still(), ("x", "t"), 1e9, longest=1e-4, tolerance=1e-14)
    before = threading.active_count()
    timer = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        prover.prove(np.repeat(CELLS, 4000, 0), 2)
    timer.join()
    for _ in range(50):
        if threading.active_count() <= before:
            break
        time.sleep(0.1)
    assert threading.active_count() <= before
    assert time.monotonic() - began < 10.0
    assert Prover(still(), ("x",), 1.0).prove(CELLS, 1).status.tolist() == [2, 2]  # the next call is not stopped
    assert FAILURES[0] == ""


def sanitizing_compiler() -> tuple[str, list[str]] | None:
    """A compiler of this machine with a shared address sanitizer, and what a process needs of it: also the library
    whose exceptions the sanitizer watches."""
    for name in filter(shutil.which, ("g++", "c++", "clang++")):
        told = {"capture_output": True, "text": True, "check": False}
        needed = [f"-print-file-name={library}" for library in ("libasan.so", "libstdc++.so.6")]
        libraries = [subprocess.run([name, asked], **told).stdout.strip() for asked in needed]
        if all(pathlib.Path(library).is_file() for library in libraries):
            return name, libraries
    return None


@pytest.mark.slow
def test_the_prover_is_clean_under_the_sanitizers():
    """Addresses, undefined behaviour and the bounds of vectors. The compiler of ziglang has no address sanitizer."""
    found = sanitizing_compiler()
    if found is None:
        pytest.skip("no compiler with a shared address sanitizer")
    name, libraries = found
    folders = [str(pathlib.Path(__file__).parent), str(SCRIPT.parent), os.environ.get("PYTHONPATH", "")]
    told = {
        "DIFFABS_KERNEL_COMPILER": name,
        "PYTHONPATH": os.pathsep.join(folders),
        "LD_PRELOAD": " ".join(libraries),
        "ASAN_OPTIONS": "detect_leaks=0",
        "JAX_PLATFORMS": "cpu",
    }
    done = subprocess.run(
        [sys.executable, SCRIPT], env={**os.environ, **told}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.splitlines()[-1] == "clean"
