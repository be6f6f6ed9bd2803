"""The coefficient of adhesion as a test house measures it: by braking one axle at a time (Appendix 2, 1.1 and 1.2).

    z = 0.566/t                                      from 40 to 20 km/h in t seconds (20/3.6/9.81 = 0.566)
    k_f = (z P g - c F_r)/(F_f + (h/E) z P g)        front axle braked;  c = 0.015 for a driven axle, else 0.010
    k_r = (z P g - c F_f)/(F_r - (h/E) z P g)        rear axle braked
    k_M = (k_f F_fdyn + k_r F_rdyn)/(P g)            with the dynamic loads at the braking rate of the anti-lock brakes

P is the mass, E the wheelbase, h the height of the centre of gravity, F_f and F_r are static axle loads. The regulation
raises a constant brake force step by step to the greatest one without a locked wheel. Here a PI holds the slip of the
braked wheels at the peak of the surface's curve, which is the limit of ever smaller steps. The formulas of k_f and k_M
are pictures in the text that was read; these follow from its definitions (1.1.1, 1.1.4, 1.1.5, 1.2.3). For a wheelbase
below 3.8 m and h/E > 0.25 it leaves the rear axle out: k_M = k_f (1.5). Rounding k to three decimals is left out.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from diffabs.assess.program import StopProgram
from diffabs.assess.runs import HIGH, LOW, NO_EDGE, ONE_KMH, Population, RuleStop, run_stops
from diffabs.assess.surfaces import make_surface, peak_slip
from diffabs.core.blocks import Direct, NoFeedforward
from diffabs.core.pytree import get
from diffabs.core.types import Array, Part
from diffabs.engine.solvers import Solver
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import PID, NoAntiWindup, PerChannel
from diffabs.parts.objectives import TimeBetweenSpeeds
from diffabs.parts.plants import GRAVITY
from diffabs.parts.references import FixedSlip, PerTarget

AXLE_RATE = 20 * ONE_KMH / GRAVITY  # s, braking rate times the time from 40 to 20 km/h
RESISTANCE = {True: 0.015, False: 0.010}  # of an unbraked axle, driven or not, per load (1.1.4)
LONGEST_WHEELBASE, LEAST_HEIGHT = 3.8, 0.25  # m; of the wheelbase: below and above these the rear axle counts not (1.5)
AXLES = ("front", "rear")
GAIN, RATE_OF_INTEGRAL = 5.0, 15.0  # kp in units of m g r for a slip of 1, and ki/kp [1/s]


class AxleAdhesion(NamedTuple):
    """Coefficients of adhesion of each axle, and the shape of the car, for each car.

    Attributes:
        front: k_f, shape (cars, loads, roads): unladen and laden, good and slippery; NaN where a run did not end.
        rear: k_r, of the same shape.
        front_share: Static load of the front axle over the weight, shape (cars, 1).
        height: Height of the centre of gravity over the wheelbase, shape (cars, 1).
        wheelbase: Wheelbase [m], shape (cars, 1).
    """

    front: Array
    rear: Array
    front_share: Array
    height: Array
    wheelbase: Array

    def mean_adhesion(self, rate: Array, stops: list[RuleStop]) -> Array:
        """Return k_M for the braking rates of stops with anti-lock brakes [1], both of shape (cars, stops).

        It is the mean of both axles, weighted by their loads at these rates; k_f where the rear axle does not count.
        """
        loads = jnp.asarray([int(stop.laden) for stop in stops])
        roads = jnp.asarray([int(stop.left_side[0]) for stop in stops])
        front, rear = (k[:, loads, roads] for k in (self.front, self.rear))
        on_front = self.front_share + self.height * rate
        alone = (self.wheelbase < LONGEST_WHEELBASE) & (self.height > LEAST_HEIGHT)
        return jnp.where(alone, front, front * on_front + rear * (1 - on_front))


def measure_adhesion(
    loop: Loop, solver: Solver, program: StopProgram, population: Population | None = None, engine: str = "auto"
) -> AxleAdhesion:
    """Return the coefficients of adhesion of both axles on both roads; also for a traced loop.

    The arguments are those of `run_stops`. Of the loop only the plant and the initial state count.
    """
    population = population or {}
    cars = next((len(column) for column in population.values()), 1)
    tests = [
        (RuleStop("axle", 50.0, laden, road, road, NO_EDGE), axle)
        for laden in (False, True)
        for road in (HIGH, LOW)
        for axle in AXLES
    ]
    stops = [stop for stop, _ in tests]
    wheels, peaks = loop.plant.shows.tracked, {}
    for slippery, adhesion in ((False, program.high), (True, program.low)):
        peaks[slippery] = peak_slip(make_surface(adhesion, slippery))
    gain = GAIN * get(loop, "plant.mass") * GRAVITY * get(loop, "plant.radius") * len(AXLES) / len(wheels)
    columns = {}
    for wheel in wheels:
        braked = jnp.asarray([gain if wheel.startswith(axle) else 0.0 * gain for _, axle in tests])
        brake = f"controller.{wheel.removesuffix('_slip')}_brake"
        columns |= {f"{brake}.kp": braked, f"{brake}.ki": RATE_OF_INTEGRAL * braked}
        columns[f"reference.{wheel}.slip"] = jnp.stack([jnp.asarray(peaks[stop.left_side[0]]) for stop in stops])
    measured = {"axle_time": TimeBetweenSpeeds(fast=40 * ONE_KMH, slow=20 * ONE_KMH)}
    runs = run_stops(_brake_one_axle(loop), solver, stops, program, population, measured, engine, columns)
    locked = [values for name, values in runs.metrics.items() if name.startswith("locked_")]
    valid = jnp.asarray(runs.stopped) & ~jnp.asarray(runs.diverged) & (jnp.max(jnp.stack(locked), axis=0) == 0)
    rates = jnp.where(valid, AXLE_RATE / runs.metrics["axle_time"], jnp.nan)
    return find_axle_adhesion(jnp.reshape(rates, (cars, 2, 2, 2)), loop.plant, program, population)


def find_axle_adhesion(rates: Array, plant: Part, program: StopProgram, population: Population) -> AxleAdhesion:
    """Return the coefficients from the braking rates of a car with one braked axle.

    Args:
        rates: Braking rate [1] with the front and with the rear axle braked, shape (cars, loads, roads, 2).
        plant: Plant with `to_front`, `to_rear` and `height`.
        program: Its `driven` axle counts.
        population: Parameters of several cars by path, shape (cars,).
    """

    def of_cars(name: str) -> Array:
        return jnp.reshape(jnp.asarray(population.get(f"plant.{name}", get(plant, name)), float), (-1, 1))

    wheelbase = of_cars("to_front") + of_cars("to_rear")
    front_share, height = of_cars("to_rear") / wheelbase, of_cars("height") / wheelbase
    share, lever = front_share[:, :, None], height[:, :, None]
    front_rate, rear_rate = rates[..., 0], rates[..., 1]
    of_front, of_rear = (RESISTANCE[program.driven in (axle, "both")] for axle in AXLES)
    return AxleAdhesion(
        (front_rate - of_rear * (1 - share)) / (share + lever * front_rate),
        (rear_rate - of_front * share) / (1 - share - lever * rear_rate),
        front_share,
        height,
        wheelbase,
    )


def _brake_one_axle(loop: Loop) -> Loop:
    """Return the loop of a test house: exact sensors and brakes, and a PI on the slip of each wheel."""
    wheels = loop.plant.shows.tracked
    control = PID(kp=1.0, ki=1.0, antiwindup=NoAntiWindup())
    channels = {f"{wheel.removesuffix('_slip')}_brake": wheel for wheel in wheels}
    parts: dict[str, Any] = {
        "sensor": Direct(),
        "reference": PerTarget(reference=dict.fromkeys(wheels, FixedSlip())),
        "feedforward": NoFeedforward(),
        "controller": PerChannel(dict.fromkeys(channels, control), channels),
        "actuator": Direct(),
    }
    return Loop(plant=loop.plant, initial=loop.initial, stop=loop.stop, **parts)
