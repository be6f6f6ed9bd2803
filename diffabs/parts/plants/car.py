"""Car: seven degrees of freedom of a braking and steering car, with four wheels on roads of their own.

    m (u' - r v) = sum Fx - c u^2 - f m g,   m (v' + r u) = sum Fy,   Jz r' = sum (x Fy - y Fx),   J w' = R F - T

u and v are the longitudinal and lateral velocity of the centre of gravity, r is the yaw velocity, and x, y are the
positions of the wheels in the car's axes. Axes and names are those of ISO 8855:2011: x forward, y to the left, yaw and
steer angle positive to the left. F is the braking force of a wheel in its own axes, T its brake torque.

Loads are quasi-static. With X = f m g - sum Fx and Y = sum Fy,

    front: (m g b + h X)/(2 (a + b)) -+ k h Y/Tf,    rear: (m g a - h X)/(2 (a + b)) -+ (1 - k) h Y/Tr

for the left (-) and the right (+) wheel; k is the front axle's share of the roll stiffness. A wheel that would pull has
no load. Forces and loads are solved together: for tyres with F = Fz mu and four loaded wheels X and Y are the solution
of two linear equations.

The front wheels follow the demanded steer angle with a lag. The road may rise along the x axis: g cos(incline) is then
in the place of g, and g sin(incline) acts downhill. The model is for forward motion (u > 0). Suspension and roll have
no dynamics.

Source: R. Rajamani, Vehicle Dynamics and Control, 2nd ed., sec. 8.3; the default numbers are vehicle 2 (BMW 320i) of M.
Althoff and G. Wuersching, CommonRoad: Vehicle Models, 2020, with half of its axle's inertia for each wheel.
"""

import math
from collections import namedtuple
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp

from diffabs.core.channels import put_first
from diffabs.core.numerics import larger, quotient
from diffabs.core.protocols import BrakeOutput, Contact, Objective, Pads, Tyre, TyreForces
from diffabs.core.pytree import param, part, pytree, static
from diffabs.core.types import Any, PyTree, Scalar
from diffabs.parts.controllers import PID, Clamping, HoldCourse, NoFeedforward, PerChannel, SelectLow
from diffabs.parts.objectives import InChannel, LockedTime, PeakOutput, StopDistance, StopTime
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

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
BRAKES = {f"{wheel}_brake": f"{wheel}_slip" for wheel in WHEELS}
SOLVE_STEPS = {True: 2, False: 3}  # by whether all tyres are proportional; a wheel that lifts needs the second


class Wheels(NamedTuple):
    """A quantity of each wheel."""

    front_left: Scalar
    front_right: Scalar
    rear_left: Scalar
    rear_right: Scalar


class WheelPlace(NamedTuple):
    """Where a wheel is in the car's axes [m], x forward and y to the left, and its tyre."""

    x: Scalar
    y: Scalar
    tyre: Tyre


class CarState(NamedTuple):
    """Position [m], yaw [rad], velocities [m/s], yaw velocity [rad/s], steer angle [rad], spins of wheels [rad/s],
    contacts of relaxed tyres, temperatures of the discs [K].
    """

    x: Scalar
    y: Scalar
    yaw: Scalar
    longitudinal_velocity: Scalar
    lateral_velocity: Scalar
    yaw_velocity: Scalar
    steer: Scalar
    spins: Wheels
    contacts: tuple[PyTree, ...] = ((), (), (), ())
    temperatures: tuple[Scalar, ...] = ()


class CarSignals(NamedTuple):
    """The fields of a `CarOutput`."""

    front_left_slip: Scalar  # [1] (vx - r w)/vx in the wheel's axes
    front_right_slip: Scalar
    rear_left_slip: Scalar
    rear_right_slip: Scalar
    front_left_wheel_speed: Scalar  # [m/s] r w
    front_right_wheel_speed: Scalar
    rear_left_wheel_speed: Scalar
    rear_right_wheel_speed: Scalar
    front_left_load: Scalar  # [N]
    front_right_load: Scalar
    rear_left_load: Scalar
    rear_right_load: Scalar
    speed: Scalar  # [m/s] of the centre of gravity
    deceleration: Scalar  # [m/s^2] against the car's heading
    lateral_acceleration: Scalar  # [m/s^2] to the left
    yaw_velocity: Scalar  # [rad/s] to the left
    sideslip_angle: Scalar  # [rad] from the heading to the velocity
    yaw: Scalar  # [rad] from the road to the heading
    distance: Scalar  # [m] along the road
    lateral_position: Scalar  # [m] to the left of the first heading
    steer: Scalar  # [rad] of the front wheels


class CarOutput(CarSignals):
    """The outputs of a car; the four slips have targets."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({
        **dict.fromkeys((f"{wheel}_slip" for wheel in WHEELS), "1"),
        **dict.fromkeys((f"{wheel}_wheel_speed" for wheel in WHEELS), "m/s"),
        **dict.fromkeys((f"{wheel}_load" for wheel in WHEELS), "N"),
        **{"speed": "m/s", "deceleration": "m/s^2", "lateral_acceleration": "m/s^2", "yaw_velocity": "rad/s"},
        **{"sideslip_angle": "rad", "yaw": "rad", "distance": "m", "lateral_position": "m", "steer": "rad"},
    })  # fmt: skip
    tracked: ClassVar[tuple[str, ...]] = tuple(BRAKES.values())
    highest: ClassVar[float] = 1.0

    def channel(self, name: str) -> Any:
        """Return the outputs of one wheel as those of a braked wheel, for the four slips."""
        if name not in type(self).tracked:
            return put_first(self, name)
        wheel_speed = getattr(self, f"{name.removesuffix('_slip')}_wheel_speed")
        return BrakeOutput(getattr(self, name), self.speed, wheel_speed, self.deceleration, self.distance)

    def with_channel(self, name: str, output: Any) -> Self:
        """Return the outputs with slip and wheel speed of one wheel, or another output, as a sensor changed them."""
        if name not in type(self).tracked:
            return self._replace(**{name: output[0]})
        wheel_speed = f"{name.removesuffix('_slip')}_wheel_speed"
        return self._replace(**{name: output.slip, wheel_speed: output.wheel_speed})


WHEEL_TEMPERATURES = tuple(f"{wheel}_brake_temperature" for wheel in WHEELS)


class HeatedCarOutput(namedtuple("HeatedCarSignals", (*CarOutput._fields, *WHEEL_TEMPERATURES))):
    """The outputs of a car with heated discs."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({**CarOutput.units, **dict.fromkeys(WHEEL_TEMPERATURES, "K")})
    tracked, highest = CarOutput.tracked, CarOutput.highest
    channel, with_channel = CarOutput.channel, CarOutput.with_channel


class CarControlSignals(NamedTuple):
    """The fields of `CarControls`."""

    front_left_brake: Scalar  # [N m]
    front_right_brake: Scalar
    rear_left_brake: Scalar
    rear_right_brake: Scalar
    steer_angle: Scalar  # [rad] demanded of the front wheels


class CarControls(CarControlSignals):
    """The controls of a car: the brake torque of each wheel, and the steer angle."""

    __slots__ = ()
    units: ClassVar[Mapping[str, str]] = MappingProxyType({**dict.fromkeys(BRAKES, "N m"), "steer_angle": "rad"})


class Contacts(NamedTuple):
    """Motion of the wheels on the road: slips [1], slip angles [rad], rims' speeds [m/s], places on the road [m]."""

    slips: Wheels
    slip_angles: Wheels
    rims: Wheels
    places: Wheels

    def each(self) -> list[Contact]:
        """Return slip and slip angle of each wheel."""
        return [Contact(slip, angle) for slip, angle in zip(self.slips, self.slip_angles, strict=True)]


class CarForces(NamedTuple):
    """What the road does: braking forces of the wheels [N], sums Fx, Fy [N] and yaw moment [N m] in the car's axes."""

    braking: Wheels
    longitudinal: Scalar
    lateral: Scalar
    moment: Scalar


ForceOfLoad = Callable[[Scalar], TyreForces]


@pytree
class Car(SlipProbes):
    """A car with four braked wheels that may yaw and slide, and steering.

    See also:
        `plants.HalfCar`: The same car in straight motion.
        `roads.RoadTyre`, `roads.PacejkaTyre`: Tyres of the wheels, each on a road of its own.

    Notes:
        The road lies along the x axis of the start; a wheel's place on it is its x coordinate, from the first place of
        the centre of gravity. With `commanded` the longitudinal load transfer follows the deceleration that the
        brakes demand, and there is no lateral one, as in CommonRoad's single-track model; the outputs show the real
        loads in both cases.

    Examples:
        >>> from diffabs.parts.plants import Car
        >>> from diffabs.parts.roads import SNOW, RoadTyre
        >>> split = Car(front_right_tyre=RoadTyre(road=SNOW), rear_right_tyre=RoadTyre(road=SNOW))
    """

    mass: Scalar = param(default=1093.2952334674046, unit="kg", above=0.0)
    """Mass m of the car."""
    yaw_inertia: Scalar = param(default=1791.5995300122856, unit="kg m^2", above=0.0)
    """Inertia Jz about the vertical axis."""
    to_front: Scalar = param(default=1.1561957064, unit="m", above=0.0)
    """Distance a from the centre of gravity to the front axle."""
    to_rear: Scalar = param(default=1.4227170936, unit="m", above=0.0)
    """Distance b from the centre of gravity to the rear axle; the wheelbase is a + b."""
    front_track: Scalar = param(default=1.38684, unit="m", above=0.0)
    """Track Tf of the front axle."""
    rear_track: Scalar = param(default=1.36398, unit="m", above=0.0)
    """Track Tr of the rear axle."""
    height: Scalar = param(default=0.5748689544, unit="m", low=0.0)
    """Height h of the centre of gravity."""
    roll_share: Scalar = param(default=0.55, unit="1", low=0.0, high=1.0)
    """Share k of the front axle in the roll stiffness."""
    radius: Scalar = param(default=0.344, unit="m", above=0.0)
    """Radius R of the wheels."""
    front_wheel_inertia: Scalar = param(default=0.85, unit="kg m^2", above=0.0)
    """Inertia J of a front wheel."""
    rear_wheel_inertia: Scalar = param(default=0.85, unit="kg m^2", above=0.0)
    """Inertia J of a rear wheel."""
    drag: Scalar = param(default=0.0, unit="kg/m", low=0.0)
    """Air drag c at 1 m/s, half of density, drag coefficient and area."""
    rolling: Scalar = param(default=0.0, unit="1", low=0.0)
    """Coefficient f of rolling resistance."""
    steer_lag: Scalar = param(default=0.05, unit="s", above=0.0)
    """Time constant of the steering."""
    crawl_speed: Scalar = param(default=0.01, unit="m/s", above=0.0)
    """Least denominator of the slip."""
    incline: Scalar = param(default=0.0, unit="rad", above=-0.7, below=0.7)
    """Angle of the road to the horizontal, positive uphill along the x axis."""
    commanded: bool = static(default=False)
    """True for loads by the deceleration that the brakes demand."""
    front_left_tyre: Tyre = part(default=RoadTyre)
    """Tyre and road of the front left wheel."""
    front_right_tyre: Tyre = part(default=RoadTyre)
    """Tyre and road of the front right wheel."""
    rear_left_tyre: Tyre = part(default=RoadTyre)
    """Tyre and road of the rear left wheel."""
    rear_right_tyre: Tyre = part(default=RoadTyre)
    """Tyre and road of the rear right wheel."""
    pads: Pads = part(default=ConstantPads)
    """Pads and discs of all wheels."""

    controls = CarControls
    valid_magnitudes: ClassVar[Mapping[str, float]] = MappingProxyType({"yaw": math.pi / 2})

    @property
    def shows(self) -> type[Any]:
        """Type of the outputs; heated discs show their temperatures."""
        return HeatedCarOutput if self.pads.heated else CarOutput

    def start(self, initial: BrakeStart) -> CarState:
        """Return the state of straight motion for a speed and a slip of all wheels."""
        spin, zero = (1 - initial.slip) * initial.speed / self.radius, 0.0 * initial.speed
        contacts = tuple(settled_contact(tyre, initial.slip) for tyre in self._tyres())
        spins, discs = Wheels(spin, spin, spin, spin), self.pads.start(brakes=4)
        return CarState(zero, zero, zero, initial.speed, zero, zero, zero, spins, contacts, discs)

    def derivative(self, t: Scalar, state: CarState, control: CarControls) -> CarState:
        """Return dx/dt under brake torques [N m] and demanded steer angle [rad]."""
        del t
        *commands, steer = control
        torques = self.pads.torques(state.temperatures, commands)
        contacts = self._contacts(state)
        forces_of_loads = self._forces_of_loads(contacts, state)
        loads = (
            self.loads(sum(torques) / self.radius, 0.0) if self.commanded else self._solve_loads(forces_of_loads, state)
        )
        road = self._sum_forces(forces_of_loads, loads, state)
        u, v, yaw_velocity = state.longitudinal_velocity, state.lateral_velocity, state.yaw_velocity
        longitudinal, lateral = self._accelerations(state, road)
        spins = [
            halt_at_zero(spin, quotient(self.radius * force - torque, inertia))
            for spin, force, torque, inertia in zip(state.spins, road.braking, torques, self._inertias(), strict=True)
        ]
        return CarState(
            u * jnp.cos(state.yaw) - v * jnp.sin(state.yaw),
            u * jnp.sin(state.yaw) + v * jnp.cos(state.yaw),
            yaw_velocity,
            halt_at_zero(u, longitudinal + yaw_velocity * v),
            lateral - yaw_velocity * u,
            road.moment / self.yaw_inertia,
            (steer - state.steer) / self.steer_lag,
            Wheels(*spins),
            self._contact_rates(contacts, state),
            self.pads.heat_rates(
                state.temperatures, [torque * spin for torque, spin in zip(torques, state.spins, strict=True)]
            ),
        )

    def least_scales(self) -> CarState:
        """Return the sizes below which errors are absolute: in straight motion y, yaw and steer angle are rounding."""
        contacts = tuple(map(least_contact, self._tyres()))
        spins, discs = Wheels(1.0, 1.0, 1.0, 1.0), tuple(1.0 + 0.0 * disc for disc in self.pads.start(brakes=4))
        return CarState(1.0, 1.0, 0.1, 1.0, 0.1, 0.1, 0.1, spins, contacts, discs)

    def project(self, state: CarState) -> CarState:
        """Return the state with neither car nor wheels moving backwards."""
        return state._replace(
            longitudinal_velocity=forward_speed(state.longitudinal_velocity),
            spins=Wheels(*map(forward_speed, state.spins)),
        )

    def output(self, state: CarState) -> Any:
        """Return slips, wheel speeds, loads, accelerations and motion of the car."""
        contacts = self._contacts(state)
        forces_of_loads = self._forces_of_loads(contacts, state)
        loads = self._solve_loads(forces_of_loads, state)
        longitudinal, lateral = self._accelerations(state, self._sum_forces(forces_of_loads, loads, state))
        return self.shows(
            *contacts.slips,
            *contacts.rims,
            *loads,
            self._total_velocity(state),
            -longitudinal,
            lateral,
            state.yaw_velocity,
            jnp.arctan2(state.lateral_velocity, larger(state.longitudinal_velocity, self.crawl_speed)),
            state.yaw,
            state.x,
            state.y,
            state.steer,
            *state.temperatures,
        )

    def holding(self, output: CarOutput, target: PyTree) -> CarControls:
        """Return the torques R F + (1 - slip) J u'/R [N m] at which all wheels hold their slips in straight motion."""
        slips = Wheels(*(getattr(target, name) for name in BRAKES.values()))
        straight = self.start(BrakeStart(speed=output.speed, slip=0.0))._replace(x=output.distance)
        still = straight._replace(contacts=tuple(map(settled_contact, self._tyres(), slips)))
        forces_of_loads = self._forces_of_loads(self._contacts(still)._replace(slips=slips), still)
        road = self._sum_forces(forces_of_loads, self._solve_loads(forces_of_loads, straight), straight)
        deceleration = -self._accelerations(straight, road)[0]
        torques = [
            self.radius * force + (1 - slip) * inertia * deceleration / self.radius
            for force, slip, inertia in zip(road.braking, slips, self._inertias(), strict=True)
        ]
        commands = self.pads.commands(output[len(CarOutput._fields) :], torques)
        return CarControls(commands[0], commands[1], commands[2], commands[3], 0.0 * deceleration)

    def loads(self, braking: Scalar, lateral: Scalar) -> Wheels:
        """Return the vertical forces of the wheels [N] under the road's forces X and Y [N]."""
        return Wheels(
            *(larger(still + by_x * braking + by_y * lateral, 0.0) for still, by_x, by_y in self._load_terms())
        )

    def energy(self, state: CarState) -> Scalar:
        """Return the kinetic energy of car and wheels in a `state` [J]."""
        u, v = state.longitudinal_velocity, state.lateral_velocity
        spins = sum(inertia * spin**2 for inertia, spin in zip(self._inertias(), state.spins, strict=True))
        return 0.5 * (self.mass * (u * u + v * v) + self.yaw_inertia * state.yaw_velocity**2 + spins)

    def wheel_places(self) -> dict[str, WheelPlace]:
        """Return position and tyre of each wheel by name, as a view from above draws them."""
        places = zip(WHEELS, self._positions(), self._tyres(), strict=True)
        return {wheel: WheelPlace(x, y, tyre) for wheel, (x, y), tyre in places}

    def usual_parts(self) -> dict[str, PyTree]:
        """Return the default parts of a loop until standstill: a PID on the slip of each wheel, and a driver.

        Both rear wheels get the lower one of their torques: on a split road a rear tyre then keeps friction for the
        lateral force.
        """
        gains = PID(kp=1e4, ki=1.5e5, low=0.0, high=2000.0, antiwindup=Clamping())
        brakes = SelectLow(controller=PerChannel(dict.fromkeys(BRAKES, gains), BRAKES), groups=(tuple(BRAKES)[2:],))
        return {
            "initial": BrakeStart(),
            "reference": PerTarget(reference=dict.fromkeys(BRAKES.values(), FilteredSlip(slip=0.1))),
            "feedforward": NoFeedforward(),
            "controller": HoldCourse(controller=brakes),
            "stop": Standstill(),
        }

    def usual_objectives(self) -> dict[str, Objective]:
        """Return time and distance to the stop, the time for which each wheel is locked, and how far the car turns."""
        locked = {
            f"locked_time_{slip.removesuffix('_slip')}": InChannel(objective=LockedTime(), control=brake, output=slip)
            for brake, slip in BRAKES.items()
        }
        signals = {"max_yaw": "yaw", "max_lateral_position": "lateral_position", "max_steer": "steer"}
        peaks = {metric: PeakOutput(output=name) for metric, name in signals.items()}
        return {"stop_time": StopTime(), "stop_distance": StopDistance(), **locked, **peaks}

    def _load_terms(self) -> tuple[tuple[Scalar, Scalar, Scalar], ...]:
        """Return the load of each wheel at rest [N], and how much X and Y add to it [N/N]."""
        weight, wheelbase = self.mass * GRAVITY * jnp.cos(self.incline), 2 * (self.to_front + self.to_rear)
        front, rear, pitch = (
            weight * self.to_rear / wheelbase,
            weight * self.to_front / wheelbase,
            self.height / wheelbase,
        )
        front_roll = self.roll_share * self.height / self.front_track
        rear_roll = (1 - self.roll_share) * self.height / self.rear_track
        return (
            (front, pitch, -front_roll),
            (front, pitch, front_roll),
            (rear, -pitch, -rear_roll),
            (rear, -pitch, rear_roll),
        )

    def _inertias(self) -> tuple[Scalar, ...]:
        return (self.front_wheel_inertia, self.front_wheel_inertia, self.rear_wheel_inertia, self.rear_wheel_inertia)

    def _positions(self) -> tuple[tuple[Scalar, Scalar], ...]:
        """Return x and y of each wheel in the car's axes."""
        a, b, front, rear = self.to_front, -self.to_rear, 0.5 * self.front_track, 0.5 * self.rear_track
        return ((a, front), (a, -front), (b, rear), (b, -rear))

    def _tyres(self) -> tuple[Tyre, ...]:
        return tuple(getattr(self, f"{wheel}_tyre") for wheel in WHEELS)

    def _total_velocity(self, state: CarState) -> Scalar:
        """Return the speed of the centre of gravity, the longitudinal one at rest."""
        u, v = state.longitudinal_velocity, state.lateral_velocity
        square = u * u + v * v
        moves = jnp.greater(square, 0.0)
        return jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), u)

    def _contacts(self, state: CarState) -> Contacts:
        """Return how the wheels move on the road, in their own axes."""
        slips, angles, rims, places = [], [], [], []
        cosine, sine = jnp.cos(state.yaw), jnp.sin(state.yaw)
        for (x, y), steer, spin in zip(self._positions(), _steers(state), state.spins, strict=True):
            along = state.longitudinal_velocity - state.yaw_velocity * y
            across = state.lateral_velocity + state.yaw_velocity * x
            if steer is not None:
                u, v = along, across
                along, across = u * jnp.cos(steer) + v * jnp.sin(steer), v * jnp.cos(steer) - u * jnp.sin(steer)
            rim = self.radius * spin
            slips.append(slip_ratio(along, rim, self.crawl_speed))
            angles.append(jnp.arctan(across / larger(along, self.crawl_speed)))
            rims.append(rim)
            places.append(state.x + x * cosine - y * sine)
        return Contacts(Wheels(*slips), Wheels(*angles), Wheels(*rims), Wheels(*places))

    def _forces_of_loads(self, contacts: Contacts, state: CarState) -> list[ForceOfLoad]:
        """Return the force of each wheel as a function of its load; proportional tyres are evaluated here, once."""
        speed = self._total_velocity(state)
        followed = (contact or motion for contact, motion in zip(state.contacts, contacts.each(), strict=True))
        return [
            _force_of_load(tyre, contact, speed, place)
            for tyre, contact, place in zip(self._tyres(), followed, contacts.places, strict=True)
        ]

    def _contact_rates(self, contacts: Contacts, state: CarState) -> tuple[PyTree, ...]:
        """Return d(contact)/dt of the relaxed tyres."""
        speed = self._total_velocity(state)
        wheels = zip(self._tyres(), state.contacts, contacts.each(), strict=True)
        return tuple(contact_rate(tyre, contact, motion, speed) for tyre, contact, motion in wheels)

    def _sum_forces(self, forces_of_loads: list[ForceOfLoad], loads: Wheels, state: CarState) -> CarForces:
        """Return the forces of the road under the loads."""
        forces = [force_of_load(load) for force_of_load, load in zip(forces_of_loads, loads, strict=True)]
        turned = [_turn_force(force, steer) for force, steer in zip(forces, _steers(state), strict=True)]
        front_left, front_right, rear_left, rear_right = turned
        # Differences of both sides: the moment of a car in straight motion is exactly 0.
        moment = (
            self.to_front * (front_left.lateral + front_right.lateral)
            - self.to_rear * (rear_left.lateral + rear_right.lateral)
            + 0.5 * self.front_track * (front_left.braking - front_right.braking)
            + 0.5 * self.rear_track * (rear_left.braking - rear_right.braking)
        )
        braking, lateral = (sum(getattr(force, name) for force in turned) for name in TyreForces._fields)
        return CarForces(
            Wheels(*(force.braking for force in forces)), -braking - self._rolling_force(state), lateral, moment
        )

    def _rolling_force(self, state: CarState) -> Scalar:
        """Return f m g cos(incline) while the car moves."""
        moves = jnp.greater(state.longitudinal_velocity, 0)
        return self.rolling * self.mass * GRAVITY * jnp.cos(self.incline) * jnp.where(moves, 1.0, 0.0)

    def _accelerations(self, state: CarState, road: CarForces) -> tuple[Scalar, Scalar]:
        """Return the accelerations along and across the car's heading."""
        drag, downhill = self.drag * state.longitudinal_velocity**2, GRAVITY * jnp.sin(self.incline)
        return (
            quotient(road.longitudinal - drag, self.mass) - downhill * jnp.cos(state.yaw),
            quotient(road.lateral, self.mass) + downhill * jnp.sin(state.yaw),
        )

    def _solve_loads(self, forces_of_loads: list[ForceOfLoad], state: CarState) -> Wheels:
        """Return the loads that belong to the forces that they cause, by Newton's steps from X = Y = 0."""
        steers, rolling = _steers(state), self._rolling_force(state)
        x = y = 0.0 * state.longitudinal_velocity
        for _ in range(SOLVE_STEPS[all(tyre.proportional for tyre in self._tyres())]):
            # Excesses f of the force X and g of the force Y, and their slopes by both.
            f, fx, fy, g, gx, gy = rolling - x, -1.0, 0.0, -y, 0.0, -1.0
            for force_of_load, (still, by_x, by_y), steer in zip(
                forces_of_loads, self._load_terms(), steers, strict=True
            ):
                load = still + by_x * x + by_y * y
                loaded = jnp.where(load > 0, 1.0, 0.0)
                force, slope = jax.jvp(
                    lambda load, force_of_load=force_of_load, steer=steer: _turn_force(force_of_load(load), steer),
                    (larger(load, 0.0),),
                    (loaded,),
                )
                f, fx, fy = f + force.braking, fx + slope.braking * by_x, fy + slope.braking * by_y
                g, gx, gy = g + force.lateral, gx + slope.lateral * by_x, gy + slope.lateral * by_y
            determinant = fx * gy - fy * gx
            x, y = x - quotient(f * gy - g * fy, determinant), y - quotient(g * fx - f * gx, determinant)
        return self.loads(x, y)


def _steers(state: CarState) -> tuple[Scalar | None, ...]:
    """Return the steer angle of each wheel; None for one that does not steer."""
    return state.steer, state.steer, None, None


def _turn_force(force: TyreForces, steer: Scalar | None) -> TyreForces:
    """Return the force of a steered wheel in the axes of the car."""
    if steer is None:
        return force
    cosine, sine = jnp.cos(steer), jnp.sin(steer)
    return TyreForces(
        force.braking * cosine + force.lateral * sine,
        force.lateral * cosine - force.braking * sine,
    )


def _force_of_load(tyre: Tyre, contact: Contact, speed: Scalar, place: Scalar) -> ForceOfLoad:
    """Return the force of a tyre as a function of its load."""
    if not tyre.proportional:
        return lambda load: tyre.forces(*contact, load, speed, place)
    friction = tyre.forces(*contact, 1.0, speed, place)
    return lambda load: TyreForces(load * friction.braking, load * friction.lateral)
