"""Half car: a car that brakes on a straight line, with two axles and the load transfer between them.

    m v' = -X - c v^2,   X = F1 + F2 + f m g,   J1 w1' = r F1 - u1,   J2 w2' = r F2 - u2,   x' = v
    Fz1 = (m g b + h X)/(a + b),   Fz2 = (m g a - h X)/(a + b)

On an incline the loads have g cos(incline) in place of g, and v' falls by g sin(incline).

X is the road's whole force against the motion. It acts at the ground and the air drag at the centre of gravity, so X
alone shifts the load. Forces depend on loads and loads on forces. For tyres with F = Fz mu(slip) the loop is linear in
X; one Newton step from X = 0 is its solution. Other tyres need two further steps for all digits.

Both axles keep contact while X < m g a/h. The suspension has no dynamics: loads follow at once.

Source: U. Kiencke and L. Nielsen, Automotive Control Systems, 2nd ed., sec. 8.2 and 9.1; axis, loads and velocities are
named as in ISO 8855:2011. The default numbers are vehicle 2 (BMW 320i) of M. Althoff and G. Wuersching, CommonRoad:
Vehicle Models, 2020.
"""

from collections import namedtuple
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp

from diffabs.core.channels import put_first
from diffabs.core.numerics import quotient
from diffabs.core.protocols import BrakeOutput, Contact, Objective, Pads, Tyre
from diffabs.core.pytree import param, part, pytree, static
from diffabs.core.types import Any, PyTree, Scalar
from diffabs.parts.controllers import PID, Clamping, NoFeedforward, PerChannel
from diffabs.parts.objectives import BRAKING, InChannel, StopDistance, StopTime
from diffabs.parts.plants.pads import ConstantPads
from diffabs.parts.plants.wheel import (
    GRAVITY,
    BrakeStart,
    SlipProbes,
    contact_rate,
    forward_speed,
    halt_at_zero,
    least_contact,
    settled_contact,
    slip_ratio,
)
from diffabs.parts.references import FilteredSlip, PerTarget
from diffabs.parts.roads import RoadTyre
from diffabs.parts.stops import Standstill

LOAD_STEPS = 3  # of tyres whose friction depends on the load
CHANNELS = {"front_brake": "front_slip", "rear_brake": "rear_slip"}


class HalfCarState(NamedTuple):
    """Speed [m/s], angular speeds of the axles [rad/s], distance of the front axle [m], contacts of relaxed tyres, and
    temperatures of the discs [K].
    """

    speed: Scalar
    front_spin: Scalar
    rear_spin: Scalar
    distance: Scalar
    contacts: tuple[PyTree, ...] = ((), ())
    temperatures: tuple[Scalar, ...] = ()


class HalfCarSignals(NamedTuple):
    """The fields of a `HalfCarOutput`."""

    front_slip: Scalar  # [1] (v - r w1)/v
    rear_slip: Scalar  # [1]
    speed: Scalar  # [m/s] of the vehicle
    front_wheel_speed: Scalar  # [m/s] r w1
    rear_wheel_speed: Scalar  # [m/s]
    deceleration: Scalar  # [m/s^2] of the vehicle, positive in braking
    front_load: Scalar  # [N] vertical force of the front axle
    rear_load: Scalar  # [N]
    distance: Scalar  # [m] travelled by the front axle


class HalfCarOutput(HalfCarSignals):
    """The outputs of a half car; both slips have targets."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({
        **{"front_slip": "1", "rear_slip": "1", "speed": "m/s", "front_wheel_speed": "m/s", "rear_wheel_speed": "m/s"},
        **{"deceleration": "m/s^2", "front_load": "N", "rear_load": "N", "distance": "m"},
    })  # fmt: skip
    tracked: ClassVar[tuple[str, ...]] = ("front_slip", "rear_slip")
    highest: ClassVar[float] = 1.0

    def channel(self, name: str) -> Any:
        """Return the outputs of one axle as those of a braked wheel, for `front_slip` and `rear_slip`."""
        if name not in type(self).tracked:
            return put_first(self, name)
        axle = name.removesuffix("_slip")
        wheel_speed = getattr(self, f"{axle}_wheel_speed")
        return BrakeOutput(getattr(self, name), self.speed, wheel_speed, self.deceleration, self.distance)

    def with_channel(self, name: str, output: Any) -> Self:
        """Return the outputs with slip and wheel speed of one axle, or another output, as a sensor changed them."""
        if name not in type(self).tracked:
            return self._replace(**{name: output[0]})
        axle = name.removesuffix("_slip")
        return self._replace(**{name: output.slip, f"{axle}_wheel_speed": output.wheel_speed})


AXLE_TEMPERATURES = ("front_brake_temperature", "rear_brake_temperature")


class HeatedHalfCarOutput(namedtuple("HeatedHalfCarSignals", (*HalfCarOutput._fields, *AXLE_TEMPERATURES))):
    """The outputs of a half car with heated discs."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType(
        {**HalfCarOutput.units, **dict.fromkeys(AXLE_TEMPERATURES, "K")}
    )
    tracked, highest = HalfCarOutput.tracked, HalfCarOutput.highest
    channel, with_channel = HalfCarOutput.channel, HalfCarOutput.with_channel


class AxleBrakeSignals(NamedTuple):
    """The fields of `AxleBrakes`."""

    front_brake: Scalar  # [N m] of both front wheels
    rear_brake: Scalar  # [N m]


class AxleBrakes(AxleBrakeSignals):
    """The controls of a half car: the brake torque of each axle."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({"front_brake": "N m", "rear_brake": "N m"})


class Axles(NamedTuple):
    """A quantity of each axle."""

    front: Scalar
    rear: Scalar


@pytree
class HalfCar(SlipProbes):
    """Two braked axles on a straight road, with load transfer by the real deceleration.

    See also:
        `plants.QuarterCar`: One wheel, with the equations that follow for a height of 0 and two equal axles.
        `roads.RoadTyre`, `roads.PacejkaTyre`: Tyres of the axles.

    Notes:
        The outputs count the distance at the front axle; the rear axle is on the same road one wheelbase behind. With
        `commanded` the loads of the equations of motion follow the deceleration (u1 + u2)/(m r) that the brakes demand,
        as in CommonRoad's single-track model. The outputs show the real loads and deceleration in both cases.

    Examples:
        >>> from diffabs.parts.plants import HalfCar
        >>> car = HalfCar()
        >>> front, rear = car.loads(0.0)
        >>> print(f"{front:.2f} {rear:.2f} N")
        5916.82 4808.41 N
    """

    mass: Scalar = param(default=1093.2952334674046, unit="kg", above=0.0)
    """Mass m of the car."""
    to_front: Scalar = param(default=1.1561957064, unit="m", above=0.0)
    """Distance a from the centre of gravity to the front axle."""
    to_rear: Scalar = param(default=1.4227170936, unit="m", above=0.0)
    """Distance b from the centre of gravity to the rear axle; the wheelbase is a + b."""
    height: Scalar = param(default=0.5748689544, unit="m", low=0.0)
    """Height h of the centre of gravity."""
    radius: Scalar = param(default=0.344, unit="m", above=0.0)
    """Radius r of the wheels."""
    front_inertia: Scalar = param(default=1.7, unit="kg m^2", above=0.0)
    """Inertia J1 of the front axle with both wheels."""
    rear_inertia: Scalar = param(default=1.7, unit="kg m^2", above=0.0)
    """Inertia J2 of the rear axle with both wheels."""
    drag: Scalar = param(default=0.0, unit="kg/m", low=0.0)
    """Air drag c at 1 m/s, half of density, drag coefficient and area."""
    rolling: Scalar = param(default=0.0, unit="1", low=0.0)
    """Coefficient f of rolling resistance."""
    crawl_speed: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least denominator of the slip."""
    incline: Scalar = param(default=0.0, unit="rad", above=-0.7, below=0.7)
    """Angle of the road to the horizontal, positive uphill."""
    commanded: bool = static(default=False)
    """True for loads by the deceleration that the brakes demand."""
    front_tyre: Tyre = part(default=RoadTyre)
    """Tyre and road of the front axle."""
    rear_tyre: Tyre = part(default=RoadTyre)
    """Tyre and road of the rear axle."""
    pads: Pads = part(default=ConstantPads)
    """Pads and discs of all wheels."""

    controls = AxleBrakes
    frozen = ("speed", "distance")

    @property
    def shows(self) -> type[Any]:
        """Type of the outputs; heated discs show their temperatures."""
        return HeatedHalfCarOutput if self.pads.heated else HalfCarOutput

    def start(self, initial: BrakeStart) -> HalfCarState:
        """Return the state for a speed and a slip of both axles."""
        spin = (1 - initial.slip) * initial.speed / self.radius
        contacts = tuple(settled_contact(tyre, initial.slip) for tyre in self._tyres())
        return HalfCarState(initial.speed, spin, spin, 0.0 * initial.speed, contacts, self.pads.start(brakes=2))

    def derivative(self, t: Scalar, state: HalfCarState, control: AxleBrakes) -> HalfCarState:
        """Return dx/dt under the brake torques [N m]."""
        del t
        force = self._braking_force(state)
        torques = AxleBrakes(*self.pads.torques(state.temperatures, control))
        loads = self.loads(sum(torques) / self.radius if self.commanded else force)
        front, rear = self._tyre_forces(state, loads)
        rolling = self._rolling_force(state.speed)
        return HalfCarState(
            halt_at_zero(state.speed, -self._deceleration(state.speed, front + rear + rolling)),
            halt_at_zero(state.front_spin, quotient(self.radius * front - torques.front_brake, self.front_inertia)),
            halt_at_zero(state.rear_spin, quotient(self.radius * rear - torques.rear_brake, self.rear_inertia)),
            state.speed,
            tuple(
                contact_rate(tyre, contact, Contact(slip, 0.0 * slip), state.speed)
                for tyre, contact, slip in zip(self._tyres(), state.contacts, self._slips(state), strict=True)
            ),
            self.pads.heat_rates(state.temperatures, self._disc_powers(state, torques)),
        )

    def least_scales(self) -> HalfCarState:
        """Return the sizes below which errors are absolute: those of contacts, which begin at 0."""
        discs = tuple(0.0 * temperature for temperature in self.pads.start(brakes=2))
        return HalfCarState(0.0, 0.0, 0.0, 0.0, tuple(map(least_contact, self._tyres())), discs)

    def project(self, state: HalfCarState) -> HalfCarState:
        """Return the state with neither car nor axles moving backwards."""
        front, rear = forward_speed(state.front_spin), forward_speed(state.rear_spin)
        return state._replace(speed=forward_speed(state.speed), front_spin=front, rear_spin=rear)

    def output(self, state: HalfCarState) -> Any:
        """Return slips [1], speeds [m/s], deceleration [m/s^2], loads [N] and distance [m]."""
        force = self._braking_force(state)
        slips, loads = self._slips(state), self.loads(force)
        return self.shows(
            *slips,
            state.speed,
            self.radius * state.front_spin,
            self.radius * state.rear_spin,
            self._deceleration(state.speed, force),
            *loads,
            state.distance,
            *state.temperatures,
        )

    def holding(self, output: HalfCarOutput, target: PyTree) -> AxleBrakes:
        """Return the torques r F + (1 - slip) J v'/r [N m] at which both axles hold their slips."""
        slips = Axles(target.front_slip, target.rear_slip)
        places = self._places(output.distance)
        force = self._solve_force(slips, places, output.speed)
        deceleration = self._deceleration(output.speed, force)
        forces = self._forces(slips, places, output.speed, self.loads(force))
        inertias = Axles(self.front_inertia, self.rear_inertia)
        torques = [
            self.radius * axle_force + (1 - slip) * inertia * deceleration / self.radius
            for axle_force, slip, inertia in zip(forces, slips, inertias, strict=True)
        ]
        return AxleBrakes(*self.pads.commands(output[len(HalfCarOutput._fields) :], torques))

    def loads(self, force: Scalar) -> Axles:
        """Return the vertical forces of the axles [N] under the road's whole force against the motion [N]."""
        wheelbase = self.to_front + self.to_rear
        weight, shift = self.mass * GRAVITY * jnp.cos(self.incline), self.height * force
        return Axles(
            (weight * self.to_rear + shift) / wheelbase,
            (weight * self.to_front - shift) / wheelbase,
        )

    def energy(self, state: HalfCarState) -> Scalar:
        """Return the kinetic energy of car and axles in a `state` [J]."""
        spins = self.front_inertia * state.front_spin**2 + self.rear_inertia * state.rear_spin**2
        return 0.5 * (self.mass * state.speed**2 + spins)

    def usual_parts(self) -> dict[str, PyTree]:
        """Return the default parts of a loop: a PID on the slip of each axle, until standstill."""
        gains = PID(kp=2e4, ki=3e5, low=0.0, high=4000.0, antiwindup=Clamping())
        target = FilteredSlip(slip=0.1)
        return {
            "initial": BrakeStart(),
            "reference": PerTarget(reference=dict.fromkeys(CHANNELS.values(), target)),
            "feedforward": NoFeedforward(),
            "controller": PerChannel(dict.fromkeys(CHANNELS, gains), CHANNELS),
            "stop": Standstill(),
        }

    def usual_objectives(self) -> dict[str, Objective]:
        """Return time and distance to the stop, and the metrics of braking for each axle."""
        each = {name: objective for name, objective in BRAKING.items() if not name.startswith("stop_")}
        by_axle = {
            f"{metric}_{slip.removesuffix('_slip')}": InChannel(objective=objective, control=brake, output=slip)
            for brake, slip in CHANNELS.items()
            for metric, objective in each.items()
        }
        return {"stop_time": StopTime(), "stop_distance": StopDistance(), **by_axle}

    def _slips(self, state: HalfCarState) -> Axles:
        rims = (self.radius * state.front_spin, self.radius * state.rear_spin)
        return Axles(*(slip_ratio(state.speed, rim, self.crawl_speed) for rim in rims))

    def _tyres(self) -> tuple[Tyre, ...]:
        return self.front_tyre, self.rear_tyre

    def _disc_powers(self, state: HalfCarState, torques: AxleBrakes) -> tuple[Scalar, Scalar]:
        """Return the power that heats a disc of the front and of the rear axle [W], half of the power of the axle."""
        return 0.5 * torques.front_brake * state.front_spin, 0.5 * torques.rear_brake * state.rear_spin

    def _contact_slips(self, state: HalfCarState) -> Axles:
        """Return the slips to which the forces belong: those of the axles, or of the contacts of relaxed tyres."""
        pairs = zip(state.contacts, self._slips(state), strict=True)
        return Axles(*(contact.slip if contact else slip for contact, slip in pairs))

    def _places(self, distance: Scalar) -> Axles:
        """Return the distances of both axles along the road."""
        return Axles(distance, distance - self.to_front - self.to_rear)

    def _forces(self, slips: Axles, places: Axles, speed: Scalar, loads: Axles) -> Axles:
        """Return the braking forces of both axles."""
        return Axles(
            self.front_tyre.braking_force(slips.front, loads.front, speed, places.front),
            self.rear_tyre.braking_force(slips.rear, loads.rear, speed, places.rear),
        )

    def _tyre_forces(self, state: HalfCarState, loads: Axles) -> Axles:
        return self._forces(self._contact_slips(state), self._places(state.distance), state.speed, loads)

    def _rolling_force(self, speed: Scalar) -> Scalar:
        """Return f m g cos(incline) while the car moves."""
        moves = jnp.where(jnp.greater(speed, 0), 1.0, 0.0)
        return self.rolling * self.mass * GRAVITY * jnp.cos(self.incline) * moves

    def _braking_force(self, state: HalfCarState) -> Scalar:
        """Return the road's whole force X in a state."""
        return self._solve_force(self._contact_slips(state), self._places(state.distance), state.speed)

    def _solve_force(self, slips: Axles, places: Axles, speed: Scalar) -> Scalar:
        """Return the X at which tyres and rolling resistance have the sum X under the loads of X."""
        rolling = self._rolling_force(speed)

        def excess(force: Scalar) -> Scalar:
            return sum(self._forces(slips, places, speed, self.loads(force))) + rolling - force

        proportional = self.front_tyre.proportional and self.rear_tyre.proportional
        return _newton_root(excess, 0.0 * speed, 1 if proportional else LOAD_STEPS)

    def _deceleration(self, speed: Scalar, force: Scalar) -> Scalar:
        return quotient(force + self.drag * speed * speed, self.mass) + GRAVITY * jnp.sin(self.incline)


def _newton_root(function: Callable[[Scalar], Scalar], start: Scalar, steps: int) -> Scalar:
    """Return the root after a fixed number of Newton's steps; one is exact for a linear function."""
    for _ in range(steps):
        value, slope = jax.jvp(function, (start,), (jnp.ones_like(start),))
        start = start - quotient(value, slope)
    return start
