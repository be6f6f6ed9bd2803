"""The programs of a kernel: the values of its functions, and derivatives on demand."""

import functools
from collections.abc import Callable, Hashable

from diffabs.compiler.autodiff.jvp import (
    INPUT_LEVELS,
    ArrayKey,
    DerivativeProgram,
    arrange_arrays,
    differentiate_functions,
    replicate_tangents,
)
from diffabs.compiler.autodiff.transpose import (
    Sweeps,
    changed_arrays,
    lower_transpose,
    pair_sweeps,
    trace_transpose,
)
from diffabs.compiler.ir import UpdateLevel
from diffabs.compiler.program import ScalarProgram, keep_read, lower_functions
from diffabs.compiler.trace import TracedFunction, TracedFunctions
from diffabs.core.types import Any, PyTree

# The arrays with initial tangents, as (level, index); None for values alone.
Seeds = tuple[tuple[UpdateLevel, int], ...] | None


class LanePrograms:
    """The functions of a kernel with their program without tangents and, on demand, programs with tangents.

    An object equals only itself.

    Attributes:
        functions: The traced functions of one lane.
        launch: Function (program, arrays before the carry, carry) -> carry that builds and runs a program.
        tangents_read: Indices of the carry's arrays whose tangents matter at the end, None for all.
        read: Indices of the carry's arrays whose values matter at the end, None for all.
        replay: Function that repeats the part of the last step that has derivatives, and the index of the carry's array
            that says if the last step has this part; None without reverse mode.
    """

    def __init__(
        self,
        functions: TracedFunctions,
        launch: Callable[[ScalarProgram | Sweeps, list[PyTree], list[PyTree]], list[PyTree]],
        tangents_read: tuple[int, ...] | None = None,
        read: tuple[int, ...] | None = None,
        replay: tuple[TracedFunction, int] | None = None,
    ):
        """Store the functions and lower them to the program without tangents, so that an error appears at once."""
        self.functions = functions
        self.launch = launch
        self.tangents_read = tangents_read
        self.read = read
        self.replay = replay
        self._programs: dict[Hashable, Any] = {}
        self.derivative(None)

    def derivative(self, seeds: Seeds) -> DerivativeProgram:
        """Return the program with one tangent direction, or the program without tangents for `seeds` = None.

        `seeds` lists as (level, index) the arrays whose initial tangents are given; all other initial tangents are 0.
        The result is kept for the next call.
        """
        moving = {level: tuple(i for seed_level, i in seeds or () if seed_level == level) for level in INPUT_LEVELS}

        def make() -> DerivativeProgram:
            if seeds is None:
                return DerivativeProgram(lower_functions(self.functions), moving, moving)
            return differentiate_functions(self.functions, moving, self.tangents_read)

        return self._once(seeds, make)

    def _once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        if key not in self._programs:
            self._programs[key] = make()
        return self._programs[key]

    def program(self, seeds: Seeds, many: int, as_lanes: frozenset[int]) -> ScalarProgram:
        """Return the program to launch, with `many` tangent directions and without updates that nothing reads.

        `seeds` is as in `derivative`. `as_lanes` holds the indices of the uniform arrays that vmap has given a value
        per lane.
        """
        derivative = self.derivative(seeds)
        whole = derivative.program
        if seeds is not None or as_lanes:
            whole = replicate_tangents(self.functions, derivative, many, as_lanes)
        if self.read is None:
            return whole
        order = arrange_arrays(self.functions, derivative.moved_arrays, as_lanes)[UpdateLevel.STEP]
        return keep_read(whole, [i for i, key in enumerate(order) if key.tangent or key.number in self.read])

    def sweeps(self, seeds: Seeds, as_lanes: frozenset[int]) -> Sweeps:
        """Return the programs to launch in reverse mode; the arguments are those of `program`. They are kept, too."""
        assert self.replay is not None
        (function, flag), moved = self.replay, self.derivative(seeds).moved_arrays

        def make() -> Sweeps:
            traced = self._once((seeds, "traced"), lambda: trace_transpose(self.functions, function, moved))
            back = lower_transpose(self.functions, traced, moved, as_lanes)
            values = self.derivative(None)
            ahead = replicate_tangents(self.functions, values, 0, as_lanes) if as_lanes else values.program
            return pair_sweeps(ahead, back, flag, changed_arrays(self.functions, function))

        return self._once((seeds, as_lanes), make)

    @functools.cached_property
    def value_keys(self) -> list[ArrayKey]:
        """Keys of the values among the primitive's arguments, in their order: uniform, lane, carry."""
        return [ArrayKey(level, i, False) for level in INPUT_LEVELS for i in range(len(self.functions.types[level]))]

    def seed_keys(self, seeds: Seeds) -> list[ArrayKey]:
        """Return the keys of the initial tangents of the arrays in `seeds`; as arguments they follow the values."""
        return [ArrayKey(level, i, True) for level, i in seeds or ()]

    def result_keys(self, seeds: Seeds) -> list[ArrayKey]:
        """Return the keys of the primitive's results for the initial tangents in `seeds`, in their order.

        These are all arrays of the carry, and then the tangents that can be nonzero and influence a wanted array.
        """
        carry = range(len(self.functions.types[UpdateLevel.STEP]))
        moved = self.derivative(seeds).moved_arrays[UpdateLevel.STEP]
        return [
            *(ArrayKey(UpdateLevel.STEP, i, False) for i in carry),
            *(ArrayKey(UpdateLevel.STEP, i, True) for i in moved),
        ]
