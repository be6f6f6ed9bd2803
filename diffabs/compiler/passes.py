"""Texts of a kernel's program after each pass of the compiler, for `diffabs compile`."""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

from diffabs.compiler.autodiff.jvp import arrange_arrays
from diffabs.compiler.emit.cpp import emit_cpp
from diffabs.compiler.ir import UpdateLevel
from diffabs.compiler.lane_programs import LanePrograms, Seeds
from diffabs.compiler.listing import ArrayPaths, list_program, list_schedule
from diffabs.compiler.program import ScalarProgram
from diffabs.compiler.runtime.jax_primitive import run_lanes_primitive
from diffabs.compiler.trace import TracedFunctions

PASSES = ("trace", "lower", "jvp", "eliminate", "schedule", "c")


class LaneCall(NamedTuple):
    """A call of the primitive `run_lanes` in a jaxpr: which programs it launches, and with which tangents.

    Attributes:
        lanes: The functions and their programs.
        seeds: Arrays that have a tangent as argument, as (level, index); None for a call without tangents.
        many: Number of tangent directions.
        as_lanes: Indices of the uniform arrays that vmap has given a value per lane.
    """

    lanes: LanePrograms
    seeds: Seeds
    many: int
    as_lanes: frozenset[int]

    def program(self) -> ScalarProgram:
        """Return the program that is launched: the one after the pass "eliminate"."""
        return self.lanes.program(self.seeds, self.many, self.as_lanes)

    def paths(self) -> ArrayPaths:
        """Return the names of the launched program's arrays; a tangent has the name of its array after "d "."""
        functions, derivative = self.lanes.functions, self.lanes.derivative(self.seeds)
        keys = arrange_arrays(functions, derivative.moved_arrays, self.as_lanes)
        return {level: [_path(functions, *key) for key in some] for level, some in keys.items()}


def _path(functions: TracedFunctions, level: UpdateLevel, number: int, tangent: bool) -> str:
    return ("d " if tangent else "") + functions.names[level][number]


def find_lane_calls(jaxpr: Any) -> Iterator[LaneCall]:
    """Yield the calls of `run_lanes` in a jaxpr and in the jaxprs of its equations, except branches of conditionals."""
    for eqn in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        if eqn.primitive is run_lanes_primitive:
            yield LaneCall(**eqn.params)
        for inner in eqn.params.values():
            if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                yield from find_lane_calls(inner)


def list_pass(call: LaneCall, name: str) -> str:
    """Return the text of a program after a pass.

        trace      the jaxprs of renew, step and running
        lower      operations on single numbers, of values only
        jvp        the same with one tangent direction
        eliminate  the program that is launched: all tangent directions, without updates that nothing reads
        schedule   its operations of level step, inside the conditionals that need them
        c          its C++

    A call without tangents has no pass "jvp", and its pass "eliminate" only leaves out updates that nothing reads.
    """
    match name:
        case "trace":
            return "".join(f"{key}:\n{function.jaxpr}\n" for key, function in call.lanes.functions.each.items())
        case "lower":
            return list_program(call.lanes.derivative(None).program, call.lanes.functions.names)
        case "jvp":
            if call.seeds is None:
                raise ValueError("a program without tangents has no pass jvp")
            derivative, functions = call.lanes.derivative(call.seeds), call.lanes.functions
            paths = {
                level: names + [f"d {names[i]}" for i in derivative.differentiable[level]]
                for level, names in functions.names.items()
            }
            return list_program(derivative.program, paths)
        case "eliminate":
            return list_program(call.program(), call.paths())
        case "schedule":
            return list_schedule(call.program(), call.paths())
    assert isinstance(call.lanes.launch, functools.partial)
    return emit_cpp(call.program(), call.lanes.launch.keywords["shape"])
