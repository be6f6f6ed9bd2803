"""What slides: one line about a run that stays on a switching surface, with the comparison and what to do."""

import linecache
import pathlib
import re
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax._src.source_info_util import summarize  # JAX has no public function that names the line of an operation

from diffabs.core import numerics
from diffabs.core.protocols import Clock, Objective
from diffabs.core.types import Source
from diffabs.engine.solvers import Adaptive, Solver
from diffabs.engine.step.attempt import start_state
from diffabs.engine.step.comparisons import SwitchedProgram
from diffabs.engine.step.system import split_flow_and_held, trace_program
from diffabs.loop.arguments import prepare_arguments
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run

FRAMES_OF_A_COMPARISON = 6  # calls that are read to find the line that compares, from the innermost one on
SLIDE_ADVICE = (
    "give the solver follow_slides=True, make the jump continuous over a small band (jnp.tanh(x / band)), give the"
    " switch a hysteresis by an event, or use Clamping or BackCalculation for an integral at a limit"
)


def describe_slide(loop: Loop, solver: Solver, objectives: Mapping[str, Objective], run: Run) -> str:
    """Return one line about the first slide of a run, or of the first sliding run of a batch; "" without a slide.

    The line has the time, the comparison with its file and line, and what to do.
    """
    if run.slide is None or not np.any(run.slid):
        return ""
    numbers, times, slid = (np.atleast_1d(np.asarray(x)).ravel() for x in (run.slide.comparison, run.slide.t, run.slid))
    first = int(np.flatnonzero(slid)[0])
    subject = f"{int(slid.sum())} of {len(slid)} runs slide, run {first}" if np.ndim(run.slid) else "the run slides"
    place = _describe_comparison(_trace_program(loop, solver, objectives), int(numbers[first]))
    effect = "it has no metrics with adaptive steps" if isinstance(solver, Adaptive) else "its derivatives are NaN"
    return (
        f"{subject} from t = {times[first]:.4g} s along {place}: both sides push onto it, so {effect}; {SLIDE_ADVICE}"
    )


def _trace_program(loop: Loop, solver: Solver, objectives: Mapping[str, Objective]) -> SwitchedProgram:
    # Not the program of the run: what JAX traces while it evaluates a primitive has the line of the primitive.
    loop, objectives, method = prepare_arguments(loop, solver, objectives)
    loop, audit = loop.prepare_run()
    measured, zero = dict(objectives) | audit, jnp.zeros_like(method.h)
    state, accumulators = start_state(loop, measured, Clock(zero, method.h, jnp.asarray(0), None))
    flow, held = split_flow_and_held(state, accumulators)
    return trace_program((zero, *flow), (held, loop, measured))


def _describe_comparison(program: SwitchedProgram, number: int) -> str:
    """Return the text, file and line of the comparison with this bit."""
    for (first, shape), op in zip(program.places, program.origins, strict=True):
        if first <= number < first + int(np.prod(shape)):
            return _describe_line(op.source, op.name)
    return "a switching surface"


def _describe_line(source: Source, name: str) -> str:
    # Innermost first. The line of a helper, such as `clamp`, says less than that of its caller.
    for frame in reversed(summarize(source, FRAMES_OF_A_COMPARISON).splitlines()):
        match = re.match(r"(?P<file>.*?):(?P<line>\d+)(:\d+)? \((?P<function>.*)\)$", frame)
        if match and match["file"] != numerics.__file__:
            text = linecache.getline(match["file"], int(match["line"])).strip()
            where = f"{pathlib.PurePath(match['file']).name}:{match['line']}, in {match['function']}"
            return f"the comparison `{text or name}` ({where})"
    return f"the comparison '{name}'"
