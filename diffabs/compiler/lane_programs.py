"""The programs of some functions of one lane: their values, and derivatives on demand."""

import functools
from collections.abc import Callable

from diffabs.compiler.autodiff.jvp import (
    INPUT_LEVELS,
    ArrayKey,
    DerivativeProgram,
    arrange_arrays,
    differentiate_functions,
    lower_without_tangents,
    replicate_tangents,
)
from diffabs.compiler.ir import UpdateLevel
from diffabs.compiler.program import ScalarProgram, keep_read
from diffabs.compiler.trace import TracedFunctions
from diffabs.core.types import PyTree


class LanePrograms:
    """Some functions of one lane with their plain program and, on demand, derivatives. Compares equal only to itself.

    Attributes:
        functions: The traced functions of one lane.
        launch: Function (program, arrays before the carry, carry) -> carry that runs a program.
        wanted: Indices of the carry's arrays whose tangents matter at the end, None for all.
        read: Indices of the carry's arrays whose values matter at the end, None for all.
    """

    def __init__(
        self,
        functions: TracedFunctions,
        launch: Callable[[ScalarProgram, list[PyTree], list[PyTree]], list[PyTree]],
        wanted: tuple[int, ...] | None = None,
        read: tuple[int, ...] | None = None,
    ):
        """Store the functions and lower them to the plain program, so that an error appears at once.

        Args:
            functions: The traced functions of one lane.
            launch: Function (program, arrays before the carry, carry) -> carry that runs a program.
            wanted: Indices of the carry's arrays whose tangents matter at the end, None for all.
            read: Indices of the carry's arrays whose values matter at the end, None for all.

        Raises:
            Unsupported: As in `lower_functions`.
        """
        self.functions, self.launch, self.wanted, self.read = functions, launch, wanted, read
        self._derivatives: dict[PyTree, PyTree] = {}
        self.derivative(None)

    def derivative(self, begins: tuple[tuple[UpdateLevel, int], ...] | None) -> DerivativeProgram:
        """Return the program with one tangent direction, for tangents that start in the seeded arrays.

        `begins` lists the seeded arrays as (level, index); None means the plain program without tangents. The result is
        kept for the next call.

        Raises:
            Unsupported: As in `lower_functions`, for the derivative.
        """
        if begins not in self._derivatives:
            moving = {level: tuple(i for one, i in begins or () if one == level) for level in INPUT_LEVELS}
            plain = begins is None
            self._derivatives[begins] = (
                lower_without_tangents(self.functions)
                if plain
                else differentiate_functions(self.functions, moving, self.wanted)
            )
        return self._derivatives[begins]

    def program(self, begins: PyTree, many: int, as_lanes: frozenset[int]) -> ScalarProgram:
        """Return the program with `many` tangent directions, for tangents that start in the arrays in `begins`.

        `begins` is as in `derivative`. `as_lanes` holds the indices of the uniform arrays that vmap has given a value
        per lane.

        Raises:
            Unsupported: As in `lower_functions`.
        """
        one = self.derivative(begins)
        whole = one.program
        if begins is not None or as_lanes:
            whole = replicate_tangents(self.functions, one, many, as_lanes)
        if self.read is None:
            return whole
        order = arrange_arrays(self.functions, one.moved_arrays, as_lanes)[UpdateLevel.STEP]
        return keep_read(whole, [i for i, key in enumerate(order) if key.tangent or key.number in self.read])

    @functools.cached_property
    def keys(self) -> list[ArrayKey]:
        """Keys of the arrays without tangents, in the order of the primitive's arguments."""
        return [ArrayKey(level, i, False) for level in INPUT_LEVELS for i in range(len(self.functions.types[level]))]

    def slopes(self, begins: PyTree) -> list[ArrayKey]:
        """Return the keys of the seed tangents of the arrays in `begins`; as arguments they follow the values."""
        return [ArrayKey(level, i, True) for level, i in begins or ()]

    def ends(self, begins: PyTree) -> list[ArrayKey]:
        """Return the keys of the results for the seeds in `begins`.

        These are all arrays of the carry, and then the tangents that may differ from 0 and influence a wanted array.
        """
        carry = range(len(self.functions.types[UpdateLevel.STEP]))
        do = self.derivative(begins).moved_arrays[UpdateLevel.STEP]
        return [
            *(ArrayKey(UpdateLevel.STEP, i, False) for i in carry),
            *(ArrayKey(UpdateLevel.STEP, i, True) for i in do),
        ]
