"""A loop's controller as static state feedback u = K x on a linear model, the form that a certificate needs.

    StateFeedback   K = (k1, k2)
    BalanceFeedback K unchanged, on the model of a balance
    any other       around a plant that is no brake: on the states of the loop at rest (`operating_point`)
    PID             K = (-ki, -(kp + kd wc), ..., kd wc), with the slip error behind the filter wc as the last state

The signs follow from e = target - slip = -x2, and from d = -x_f in Aoki and Nakamura's eq. (13). `Sampled` makes the
model a discrete one. Gains of zero leave out the integral and the filter.
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.blocks import Direct, Series
from diffabs.core.channels import need_single_control
from diffabs.core.types import AnyArray, Part, PyTree
from diffabs.core.units import insert_unit, units_of
from diffabs.core.validity import check_part
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.operating_point import OperatingPoint, loop_gain, operating_point
from diffabs.linear.slip_model import Continuous, LowPass, Sampling, SlipModel
from diffabs.loop.closed_loop import Loop
from diffabs.parts.actuators import Delay, Lag, Limits, RateLimit, VoltageLimit
from diffabs.parts.controllers import (
    PID,
    BalanceFeedback,
    HoldingInput,
    NoAntiWindup,
    ProportionalFeedback,
    StateFeedback,
)
from diffabs.parts.controllers.sampled import Sampled, inner_controller
from diffabs.parts.references import FixedSlip
from diffabs.parts.sensors import Bias, Noise


class ReducedLoop(NamedTuple):
    """State feedback u = gain x on `model`.

    Attributes:
        model: Linear model of the plant, the actuator and the filter.
        gain: Gain K, shape (n,), at the speed of the model.
        exact: Whether the model with this gain is the loop's own linearisation near the target, at a frozen speed.
            Limits do not count against it, because they are inactive there. A delay does, and so does a sensor with
            dynamics or rounding.
        neglected: Neglected parts of the loop, in sentences; an exact loop may have some.
    """

    model: SlipModel | BalanceModel | OperatingPoint
    gain: np.ndarray
    exact: bool
    neglected: tuple[str, ...]


def reduce_loop(loop: Loop) -> ReducedLoop:
    """Return the loop as state feedback, linearised at its initial speed and its setpoint at t = 0.

    The actuator may have limits, one lag and a delay. A balance, or a plant that is no brake, is linearised at rest.
    """
    check_part(loop)
    need_single_control(loop.plant, "a proof by state feedback")
    if isinstance(inner_controller(loop.controller), BalanceFeedback):
        return reduce_balance_loop(loop)
    if not hasattr(loop.plant, "frozen"):
        return _reduce_at_rest(loop)
    controller = inner_controller(loop.controller)
    integral, _, derivative, cutoff = map(float, _gains(controller))
    actuator, by_actuator, exact = _actuator(loop.actuator)
    # The model of a loop with a moving reference holds at its setpoint at the start.
    setpoint = jax.jit(lambda loop: loop.reference.setpoint(loop.start().reference))(loop)
    model = SlipModel(
        plant=loop.plant,
        slip=float(setpoint),
        speed=float(loop.initial.speed),
        actuator=actuator,
        sampling=_read_sampling(loop.controller),
        filter=LowPass(cutoff=cutoff) if derivative else Direct(),
        # Without integral action its state would be a pole at 0, and no proof of stability would succeed.
        integral=integral != 0,
    )
    gain = np.asarray(feedback_gain(loop, check_part(model).states), float)
    if isinstance(controller, ProportionalFeedback):
        gain = gain * (model.speed / float(controller.reference_speed))
    units = units_of(loop.plant)
    left_out = (*_controller_omissions(controller), *by_actuator, *_loop_omissions(loop))
    neglected = tuple(insert_unit(line, units) for line in left_out)
    return ReducedLoop(model, gain, exact and isinstance(loop.sensor, Direct | Noise | Bias), neglected)


def reduce_balance_loop(loop: Loop) -> ReducedLoop:
    """Return a balance's loop as state feedback on its linear model about upright.

    It is exact if the sensor passes the output unchanged. A voltage limit is neglected but does not count against it.
    """
    controller = inner_controller(loop.controller)
    if not isinstance(controller, BalanceFeedback):
        raise ValueError(f"controller {type(controller).__name__} is not feedback of the whole state")
    if not isinstance(loop.actuator, Direct | VoltageLimit):
        raise ValueError(f"actuator {type(loop.actuator).__name__} is not known to a linear model of a balance")
    model = check_part(BalanceModel(plant=loop.plant, sampling=_read_sampling(loop.controller)))
    exact = isinstance(loop.sensor, Direct)
    neglected = [
        "Everything that is not linear: the proof is about small angles.",
        "What lies between the points of the grid: a balance is rational in its masses, its hull covers no box.",
    ]
    if isinstance(loop.actuator, VoltageLimit):
        neglected.append(f"The voltage limit of {float(loop.actuator.high):g} V.")
    if not exact:
        neglected.append(f"The sensor ({type(loop.sensor).__name__}).")
    return ReducedLoop(model, np.asarray(controller.gain, float), exact, tuple(neglected))


def _read_sampling(controller: object) -> Sampling | Continuous:
    if isinstance(controller, Sampled):
        return Sampling(period=float(controller.period), delay=float(controller.delay))
    return Continuous()


def feedback_gain(loop: Loop, states: Sequence[str]) -> AnyArray:
    """Return K (n,) of a loop's controller on the named states, differentiable in its parameters; 0 for unused states.

    K of a `ProportionalFeedback` holds at its reference speed. A `BalanceFeedback` has K whole, whatever the names.
    """
    need_single_control(loop.plant, "a constraint on poles or decay")
    controller = inner_controller(loop.controller)
    if isinstance(controller, BalanceFeedback):
        return jnp.asarray(controller.gain, float)
    if not hasattr(loop.plant, "frozen"):
        return loop_gain(loop, tuple(states))
    integral, proportional, derivative, _ = _gains(controller)
    gains = {
        "integral of slip error": integral,
        # The derivative acts on slip error minus filtered slip error: its gain enters both states with opposite signs.
        "slip error": proportional + derivative,
        "filtered slip error": -derivative,
    }
    return jnp.stack([jnp.asarray(gains.get(name, 0.0), float) for name in states])


def _reduce_at_rest(loop: Loop) -> ReducedLoop:
    """Return a loop around another plant, at rest on its setpoint; noise and bias of the sensor are disturbances."""
    disturbed = isinstance(loop.sensor, Noise | Bias)
    model = operating_point(dataclasses.replace(loop, sensor=Direct()) if disturbed else loop)
    neglected = ["Everything that is not linear: the proof is about the neighbourhood of rest on the setpoint, inside"
                 " all limits; the gain is the controller's with the parameters of the scenario."]  # fmt: skip
    if disturbed:
        neglected.append(f"The sensor's {_part_name(loop.sensor)}, a disturbance.")
    return ReducedLoop(model, np.asarray(model.gain(), float), True, tuple(neglected))


def _gains(controller: object) -> tuple[PyTree, PyTree, PyTree, PyTree]:
    """Return the gains on integral, slip error, and slip error minus filtered slip error, and the filter's cutoff."""
    if isinstance(controller, StateFeedback | ProportionalFeedback):
        return controller.gain[0], controller.gain[1], 0.0, 0.0
    if isinstance(controller, PID):
        wc = controller.cutoff
        return -controller.ki, -controller.kp, -controller.kd * wc, wc
    raise ValueError(f"controller {_part_name(controller)} is not linear: it cannot be brought to state feedback")


def _actuator(actuator: object) -> tuple[Direct | Lag, tuple[str, ...], bool]:
    """Return the linear actuator, its neglected parts, and whether it is exact near the target."""
    blocks = actuator.blocks if isinstance(actuator, Series) else (actuator,)
    lags, neglected, exact = [], [], True
    for block in blocks:
        match block:
            case Direct():
                pass
            case Lag():
                lags.append(block)
            case RateLimit():
                lags.append(Lag(time_constant=block.time_constant))
                neglected.append(f"The actuator's rate limit of {float(block.rate):g} {{control}}/s.")
            case Limits():
                neglected.append(
                    f"The actuator's limits of {float(block.low):g} and {float(block.high):g} {{control}}."
                )
            # Limits are inactive near the target, a delay is not: the model is then inexact even for small errors.
            case Delay():
                exact = False
                neglected.append(f"The actuator's delay of {float(block.time):g} s, which can destabilise.")
            case _:
                raise ValueError(
                    f"actuator {_part_name(block)} is not known to be linear: it cannot be brought to state feedback"
                )
    if len(lags) > 1:
        raise ValueError("actuator: a linear slip model has room for one lag, not for several in series")
    return (lags[0] if lags else Direct()), tuple(neglected), exact


def _controller_omissions(controller: Part) -> Iterator[str]:
    low, high = map(float, controller.limits())
    if np.isfinite([low, high]).any():
        yield f"The controller's torque limits of {low:g} and {high:g} {{control}}."
        if not isinstance(controller.antiwindup, NoAntiWindup):
            yield "Anti-windup, which acts at the torque limits only."


def _loop_omissions(loop: Loop) -> Iterator[str]:
    """Yield the neglected parts of the sensor, the reference and the feed-forward."""
    yield "The fall of the speed: it is frozen."
    if isinstance(loop.sensor, Noise | Bias):
        yield f"The sensor's {_part_name(loop.sensor)}, a disturbance."
    elif not isinstance(loop.sensor, Direct):
        yield f"The sensor, {_part_name(loop.sensor)}: its dynamics, rounding or error."
    if not isinstance(loop.reference, FixedSlip):
        reference = _part_name(loop.reference)
        yield f"The motion of the target ({reference}), a disturbance; the model is taken at its setpoint."
    if not isinstance(loop.feedforward, HoldingInput):
        yield f"The error of the feed-forward ({_part_name(loop.feedforward)}), a disturbance."


def _part_name(part: object) -> str:
    """Return the name of a part in words: `sliding mode` for SlidingMode."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(part).__name__).lower()
