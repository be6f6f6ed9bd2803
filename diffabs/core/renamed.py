"""Names of parameters and arguments that have changed, and the line that tells a user of the old name the new one."""

import functools
from collections.abc import Callable, Iterable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

TORQUE_LIMITS = {"torque_min": "low", "torque_max": "high"}
# The new name by the old one, for each class or function.
RENAMED = {
    "StateFeedback": TORQUE_LIMITS,
    "ProportionalFeedback": TORQUE_LIMITS,
    "ScheduledFeedback": TORQUE_LIMITS,
    "Relay": TORQUE_LIMITS,
    "BandLogic": {"torque_max": "high"},
    "VoltageLimit": {"voltage_max": "high"},
    "ObserverFeedback": {"voltage_max": "predicted_high"},
    "lqg": {"voltage_max": "predicted_high"},
    "polytope": {"most": "max_points"},
    "gaussian": {"known": "distributions"},
    "cover_box": {"known": "extremes"},
    "verify_box": {"known": "extremes"},
    "ExtremumSeeking": {
        **{"least_slip": "slip_low", "greatest_slip": "slip_high", "least_deceleration": "deceleration_floor"}
    },
}


def current_name(path: str, names: Iterable[str]) -> str | None:
    """Return the one of the `names` or dotted paths that a `path` with an old last word has now, or None."""
    start, dot, word = path.rpartition(".")
    paths = {f"{start}{dot}{renamed[word]}" for renamed in RENAMED.values() if word in renamed}
    return next((name for name in names if name in paths), None)


def refuse_old_names(call: Callable[P, R]) -> Callable[P, R]:
    """Return a function, or the `__init__` of a class, that names the new name of a renamed argument in its error."""
    owner = call.__qualname__.removesuffix(".__init__").rpartition(".")[2]
    renamed = RENAMED[owner]

    @functools.wraps(call)
    def call_or_refuse(*args: P.args, **kwargs: P.kwargs) -> R:
        for name in renamed.keys() & kwargs.keys():
            raise TypeError(f"{owner} has no {name}: it is now {renamed[name]}")
        return call(*args, **kwargs)

    return call_or_refuse
