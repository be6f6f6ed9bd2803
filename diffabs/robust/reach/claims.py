"""Claims about all runs of a box by the names of the metrics: `max_slip`, `overshoot`, `stop_time`, `no_lock`, ..."""

import math
from collections.abc import Sequence

from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, unknown_name_error
from diffabs.loop.closed_loop import Loop
from diffabs.robust.reach.cover import RunClaim
from diffabs.robust.reach.equations import Equations

NO_LOCK, OVERSHOOT, TIMES = "no_lock", "overshoot", ("stop_time", "stop_distance")
END_WORDS = {"max": "greatest", "min": "least"}
SLIP_ROUNDING = 2.0**-50  # relative; the start slip and the target may be rounded decimals


def claimable_names(signals: Sequence[str]) -> list[str]:
    """Return the names of the claims about a loop whose plant shows these `signals`."""
    names = [*(f"{word}_{signal}" for signal in signals for word in END_WORDS), *TIMES]
    return names + ([OVERSHOOT, NO_LOCK] if "slip" in signals else [])


def read_claim(text: str, loop: Loop, equations: Equations, where: str = "claim") -> RunClaim:
    """Return the claim of a text `NAME=BOUND`, or `no_lock`. Raises ScenarioError, which begins with `where`."""
    name, equals, number = text.partition("=")
    names = claimable_names(loop.plant.shows._fields)
    if name not in names:
        raise unknown_name_error(f"{where} {name} is not a quantity of this loop", name, names)
    if name == NO_LOCK:
        if equals:
            raise ScenarioError(f"{where} no_lock has no bound: it says that the slip stays below 1")
        return no_lock_claim()
    try:
        bound = read_decimal(number)
    except ValueError:
        bound = math.nan
    if not math.isfinite(bound):
        raise ScenarioError(f"{where} {text} needs a finite number: {name}=BOUND")
    try:
        return named_claim(name, bound, equations)
    except ValueError as error:
        instead = f": {where} max_slip=BOUND" if bound >= 0 else ""
        raise ScenarioError(f"{where} {error}{instead}") from None


def no_lock_claim() -> RunClaim:
    """Return the claim that the slip stays below 1."""
    return RunClaim("greatest slip", math.nextafter(1.0, 0.0))


def named_claim(name: str, bound: float, equations: Equations) -> RunClaim:
    """Return the claim that a bound holds for the quantity of a name from `claimable_names`, except `no_lock`.

    Args:
        name: `max_SIGNAL`, `min_SIGNAL`, `stop_time` [s], `stop_distance` [m], or `overshoot`, a fraction of the step.
        bound: Bound in the quantity's unit.
        equations: Equations of the loop over the box, for the target of `overshoot`.

    Raises:
        ValueError: The overshoot has a negative bound, or the runs differ in their start slip or target.
    """
    if name == OVERSHOOT:
        return overshoot_claim(bound, equations)
    if name in TIMES:
        return RunClaim(name, bound)
    word, _, signal = name.partition("_")
    return RunClaim(f"{END_WORDS[word]} {signal}", bound)


def overshoot_claim(bound: float, equations: Equations) -> RunClaim:
    """Return the bound of the slip that bounds the metric `Overshoot`.

    Raises:
        ValueError: The bound is negative, or the step differs between the runs.
    """
    if bound < 0:  # the metric is 0 for every run below its target
        raise ValueError(f"{OVERSHOOT} = {bound:g} is outside [0, inf)")
    ends = [*(equations.start[i] for i in equations.nonnegative), equations.signals["setpoint"]]
    operations = [equations.operations[i] for i in ends]
    numbers = [operation.value for operation in operations if operation.name == "const"]
    if len(numbers) < 2:
        raise ValueError(
            f"{OVERSHOOT} needs one start slip and one target for all runs; here one of them changes in a run or over "
            "the box"
        )
    first, setpoint = numbers
    step = setpoint - first
    if step == 0:
        raise ValueError(f"{OVERSHOOT} needs a step; the runs start on their target")
    limit = setpoint + bound * step
    rounding = SLIP_ROUNDING * (abs(setpoint) + bound * abs(step))
    return RunClaim("greatest slip", limit - rounding) if step > 0 else RunClaim("least slip", limit + rounding)
