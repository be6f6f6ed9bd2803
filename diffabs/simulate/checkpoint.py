"""Repeat a step many times with little memory for reverse mode."""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax

X = TypeVar("X")
SLOTS = 1800  # carries that reverse mode keeps in one scan: some 0.2 MB for each lane of a batch


def repeated(step: Callable[[X], X], carry: X, count: int, on: Callable[[X], Any]) -> X:
    """step(step(... carry)), at least `count` times, in nested scans that are skipped where `on(carry)` is False.

    Reverse mode keeps the carries of one scan at each level, and runs every step once more for each level.
    """
    lengths = levels(count)

    def nested(carry: X, level: int) -> X:
        if level == len(lengths):
            return step(carry)

        def body(carry: X, _: Any) -> tuple[X, None]:
            return nested(carry, level + 1), None

        def scan(carry: X) -> X:
            return jax.lax.scan(forgetful(body), carry, length=lengths[level])[0]

        return jax.lax.cond(on(carry), scan, lambda carry: carry, carry)

    return nested(carry, 0)


def levels(count: int) -> list[int]:
    """Lengths of the nested scans that make `count` steps: one scan, or two where one would keep more than SLOTS
    carries. From SLOTS/2 steps to SLOTS^2/2 they keep between SLOTS/2 and 3/2 SLOTS, whatever the number of steps."""
    inner = math.ceil(count / SLOTS)
    return [count] if inner == 1 else [math.ceil(count / inner), inner]


def forgetful(body: Any) -> Any:
    """Reverse mode keeps the arguments of `body` and works everything else out again."""
    return jax.checkpoint(body, policy=jax.checkpoint_policies.nothing_saveable, prevent_cse=False)
