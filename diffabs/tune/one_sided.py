"""Points at which a derivative by a parameter is that of one side alone (`docs/gradients.md` says of which)."""

import warnings
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from diffabs.core.loop import Loop


def one_sided(loop: Loop) -> Iterator[tuple[str, str]]:
    """Yield the path of each parameter at whose value a derivative is one-sided, and why."""
    sampled: Any = loop.controller
    inner: Any = getattr(sampled, "controller", sampled)
    prefix = "controller." if inner is sampled else "controller.controller."
    if inner is not sampled and hasattr(sampled, "delay"):
        period = getattr(sampled, "period", getattr(sampled, "sampling_period", None))
        for value, name in ((0.0, "zero"), (period, "the period")):
            if _same(sampled.delay, value):
                yield "controller.delay", f"it is {name}"
    for name, sign, limit in (("torque_max", 1, "high"), ("torque_min", -1, "low")):
        name = name if hasattr(inner, name) else limit  # a relay names its two torques otherwise
        if hasattr(inner, "boundary") and _same(sign * inner.gain, getattr(inner, name)):
            yield from ((f"{prefix}{one}", f"gain and {name} are equal in size") for one in ("gain", name))
        for path, actuator in _actuators(loop.actuator):
            if (
                hasattr(inner, name)
                and hasattr(actuator, limit)
                and _same(getattr(inner, name), getattr(actuator, limit))
            ):
                text = f"{prefix}{name} and {path}.{limit} are equal"
                yield from ((one, text) for one in (f"{prefix}{name}", f"{path}.{limit}"))


def warn(loop: Loop, free: Iterable[str], where: str) -> None:
    """Warn of the free parameters at which a derivative is one-sided."""
    free = set(free)
    for path, why in one_sided(loop):
        if path in free:
            warnings.warn(f"{where}: the derivative by {path} is that of one side, since {why}", stacklevel=3)


def _actuators(actuator: Any) -> Iterator[tuple[str, Any]]:
    """An actuator, or those of a series, by path."""
    series = getattr(actuator, "blocks", None)
    if isinstance(series, tuple):
        yield from ((f"actuator.blocks.{i}", one) for i, one in enumerate(series))
    else:
        yield "actuator", actuator


def _same(x: Any, y: Any) -> bool:
    """Whether two numbers are equal to rounding, and finite."""
    return y is not None and bool(np.all(np.isfinite(y)) and np.allclose(x, y, rtol=1e-12, atol=0.0))
