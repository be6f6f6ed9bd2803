"""Calls of the native prover that reach each of its paths, for a library that is compiled with sanitizers.

    DIFFABS_KERNEL_COMPILER=g++ LD_PRELOAD=libasan.so PYTHONPATH=tests/reach python tests/support/sanitized_prover.py

An error ends the process; otherwise the last line is `clean`. The values are checked elsewhere."""

import numpy as np
from test_native import CELLS, still

from diffabs.compiler.runtime import toolchain
from diffabs.robust.reach import RunClaim, cover_box, engine
from diffabs.robust.reach.engine import Prover, apply_operation
from diffabs.robust.reach.equations import derive_equations
from diffabs.scenario.scenario import load

LIMITED = ["controller.low=0", "controller.high=9.03"]


def prove_edges() -> None:
    """No states, no signals, one and many cells; with and without a clock; the trail and the scout."""
    for period in (None, 0.1):
        for signals in ((), ("param", "const"), ("square", "inverse"), ("x",), ("x", "t", "param")):
            prover = Prover(still(period), signals, 1.0)
            prover.choose_weights(np.array([0.35]))
            for count in (1, 2, 9):
                prover.prove(np.repeat(CELLS, count, 0)[:count], 2)
            prover.follow(CELLS[0])


def prove_loops() -> None:
    """A braked wheel with limits and a tail; the sampled one with a lag and a filter, with every signal."""
    box = {"plant.mass": (5.3, 5.32), "initial.speed": (6.0, 6.05)}
    for name, changes in (("slip-lmi", LIMITED), ("slip-cured", [])):
        loop = load(name, changes, integrated=False).loop
        cover_box(loop, box, [RunClaim("greatest slip", 0.3)], signals=("slip",), horizon=2.0, budget=20.0)
        equations = derive_equations(loop, box)
        prover = Prover(equations, tuple(equations.signals), 0.02)
        prover.choose_weights(np.array([5.3, 6.05]))
        prover.prove(np.array([[[5.3, 5.301], [6.0, 6.001]]]), 1)
        prover.prove(np.array([[[5.0, 6.5], [1.0, 20.0]]]), 1)  # too wide


def apply_all() -> None:
    """All operations on intervals, also on those without a value."""
    ends = np.array([[-1.0, 2.0], [0.0, 0.0], [1e-300, 1e300], [-np.inf, np.inf], [700.0, 800.0], [0.5, 0.5]])
    for name in ("add", "sub", "mul", "inv", "exp", "log", "sin", "cos", "atan", "power"):
        apply_operation(name, ends, np.abs(ends[:, ::-1]) + 0.5)


if __name__ == "__main__":
    engine.FLAGS += ("-O1", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-D_GLIBCXX_ASSERTIONS")
    toolchain.COMPILE_TIMEOUT_S = 3600  # sanitizers make it some minutes
    apply_all()
    prove_edges()
    prove_loops()
    print("clean")
