"""The programs of a loop's kernel: that of its metrics, and that of their derivatives by some parameters."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.compiler.listing import count_by_level
from diffabs.compiler.lower.rules import Unsupported
from diffabs.compiler.passes import LaneCall, find_lane_calls, list_pass
from diffabs.compiler.runtime.toolchain import NoCompiler
from diffabs.core.protocols import Objective
from diffabs.core.pytree import ParameterSpec, get, parameters
from diffabs.core.types import AnyArray, Array
from diffabs.engine.drive.engine import EngineError
from diffabs.engine.solvers import Solver
from diffabs.loop.batch import Batch
from diffabs.loop.closed_loop import Loop
from diffabs.loop.ensemble import run_batch


class KernelPrograms(NamedTuple):
    """The calls of a loop's kernel for one run.

    Attributes:
        values: Call for the metrics.
        derivative: Call for their derivatives.
    """

    values: LaneCall
    derivative: LaneCall

    def text(self, name: str, *, tangents: bool) -> str:
        """Return the program after the pass `name` of `compiler.passes.PASSES`; only "jvp" always has tangents."""
        return list_pass(self.derivative if tangents or name == "jvp" else self.values, name)

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the number of operations by pass and level: once a launch, once a run, and in each step."""
        values, derivative = self.values, self.derivative
        programs = {
            "lower": values.lanes.derivative(None).program,
            "eliminate": values.program(),
            "lower, for derivatives": derivative.lanes.derivative(None).program,
            "jvp": derivative.lanes.derivative(derivative.seeds).program,
            "eliminate, with tangents": derivative.program(),
        }
        return {name: count_by_level(program) for name, program in programs.items()}


def tunable_numbers(loop: Loop) -> dict[str, ParameterSpec]:
    """Return the parameters by path that are single numbers and by which a kernel can be differentiated."""
    specs = ((path, spec) for path, spec, value in parameters(loop) if spec.tunable and not np.ndim(np.asarray(value)))
    return dict(specs)


def trace_kernel(
    loop: Loop, solver: Solver, objectives: Mapping[str, Objective], paths: Sequence[str]
) -> KernelPrograms:
    """Return the programs of a loop's kernel, with derivatives by the parameters of `paths`. It compiles nothing.

    Raises:
        ValueError: A kernel cannot make the runs; the message says why.
    """

    def run(x: Array) -> dict[str, AnyArray]:
        lanes = Batch({path: x[i][None] for i, path in enumerate(paths)}, jnp.zeros(1, int))
        return run_batch(loop, lanes, solver, objectives, together=False, engine="kernel").metrics

    x = jnp.asarray([float(get(loop, path)) for path in paths])
    try:
        jaxprs = [jax.make_jaxpr(function)(x) for function in (run, jax.jacfwd(run))]
        return KernelPrograms(*(next(find_lane_calls(jaxpr)) for jaxpr in jaxprs))
    except (EngineError, NoCompiler, Unsupported) as error:
        raise ValueError(str(error)) from None
