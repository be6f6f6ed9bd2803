"""A balance's controller as static state feedback u = K x on its linear model about upright."""

import numpy as np

from diffabs.actuators import VoltageLimit
from diffabs.controllers import BalanceFeedback
from diffabs.controllers.sampled import Sampled, inner_controller
from diffabs.core.blocks import Direct
from diffabs.core.loop import Loop
from diffabs.core.validity import check_part
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.slip_model import Continuous, Sampling


def reduce_balance_loop(loop: Loop) -> tuple[BalanceModel, np.ndarray, bool, tuple[str, ...]]:
    """Return the linear model about upright, the gain (6,), whether they are exact, and the neglected parts.

    They are exact if the sensor passes the output unchanged. A voltage limit is neglected but does not count against
    it. The neglected parts are sentences.

    Args:
        loop: Closed loop of a balance.

    Raises:
        ValueError: A controller other than feedback of the whole state, an actuator other than none or a voltage limit,
            or a parameter out of its range.
    """
    sampled = loop.controller if isinstance(loop.controller, Sampled) else None
    controller = inner_controller(loop.controller)
    if not isinstance(controller, BalanceFeedback):
        raise ValueError(f"controller {type(controller).__name__} is not feedback of the whole state")
    if not isinstance(loop.actuator, Direct | VoltageLimit):
        raise ValueError(f"actuator {type(loop.actuator).__name__} is not known to a linear model of a balance")
    sampling = Sampling(period=float(sampled.period), delay=float(sampled.delay)) if sampled else Continuous()
    model = check_part(BalanceModel(plant=loop.plant, sampling=sampling))
    exact = isinstance(loop.sensor, Direct)
    neglected = [
        "Everything that is not linear: the proof is about small angles.",
        "What lies between the points of the grid: a balance is rational in its masses, its hull covers no box.",
    ]
    if isinstance(loop.actuator, VoltageLimit):
        neglected.append(f"The voltage limit of {float(loop.actuator.voltage_max):g} V.")
    if not exact:
        neglected.append(f"The sensor ({type(loop.sensor).__name__}).")
    return model, np.asarray(controller.gain, float), exact, tuple(neglected)
