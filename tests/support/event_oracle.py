"""Brakes whose runs have events, a second time: equations written out by hand, integrated by SciPy between events.

    python tests/support/event_oracle.py [--steps 4e-4 1e-4 2.5e-5] [--only relay]

Of each loop and metric: value and d/d ln J (J the wheel's inertia) of the package at some steps beside those of the
oracle, their errors, and the order in the step between the last two. Nothing here calls diffabs for physics, control or
measurement: the numbers of its parts are read, and the meaning of the parts is that of continuous time. A run is a row
of pieces, in each of which everything is smooth: the mode of a piece says at which limit the torque is, on which side
of its setpoint the slip, in which interval of a tabulated road, and whether the wheel stands still. SciPy finds the end
of a piece as the root of a guard on its dense output; a jump happens there, and the next piece starts there.

Relay: high until slip > target + band, low until slip < target - band. PeakLatch: the first target until
the deceleration falls, then the slip at its maximum; a later maximum counts if it is greater by a millionth.
PeakRobust: the same of deceleration and slip behind equal low-passes, from the moment at which the filtered
deceleration lies below (1 - threshold) of its greatest, if that is above `arming`. ConditionalIntegration: the integral
stands still while the torque is at a limit and the error would push it further out."""

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from conditional import ConditionalIntegration
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator

import diffabs as d
from diffabs import controllers, plants, references, roads
from diffabs.parts.stops import SpeedReached, Standstill
from diffabs.scenario.defaults import braking

G = 9.81
EXCEEDS = 1 + 1e-6  # what a later maximum must be
TOLERANCE = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-14, "max_step": 5e-3}
SETTLED = 0.01
V, W, X, I, AF, SF, AREA = range(7)  # speed, wheel's angular speed, distance, integral of e, filters, integral of |e|
METRICS = ("stop_distance", "stop_time", "iae", "max_slip", "settling_time", "overshoot")

ASPHALT = {
    "plant": plants.QuarterCar(road=roads.DRY_ASPHALT),
    "initial": d.BrakeStart(speed=22.0),
    "stop": SpeedReached(),
}
REST = Standstill(speed=0.5)
SPLINE = {"plant": plants.QuarterCar(road=roads.SPLINE_B), "initial": d.BrakeStart(), "stop": REST}
LOOPS = {
    "fixed slip, P": braking(
        **ASPHALT, controller=controllers.PID(low=0.0, high=90.0), reference=references.FixedSlip(slip=0.12)
    ),
    "fixed slip, PI, clamping": braking(
        **ASPHALT,
        controller=controllers.PID(kp=2000.0, ki=8000.0, high=150.0, antiwindup=ConditionalIntegration(), low=0.0),
        reference=references.FixedSlip(slip=0.12),
    ),
    "latch, P": braking(
        **ASPHALT | {"stop": REST}, controller=controllers.PID(low=0.0, high=90.0), reference=references.PeakLatch()
    ),
    "relay": braking(  # ends well inside a half-wave: its settling time has a derivative
        **ASPHALT | {"stop": SpeedReached(speed=1.3)},
        controller=controllers.Relay(high=150.0),
        reference=references.FixedSlip(slip=0.12),
    ),
    "robust, PI": braking(
        **ASPHALT, controller=controllers.PID(ki=2000.0, low=0.0, high=90.0), reference=references.PeakRobust(slip=0.3)
    ),
    "spline, latch, P": braking(
        **SPLINE, controller=controllers.PID(low=0.0, high=90.0), reference=references.PeakLatch()
    ),
    "spline, latch, PI": braking(
        **SPLINE, controller=controllers.PID(ki=2000.0, low=0.0, high=90.0), reference=references.PeakLatch()
    ),
}


@dataclasses.dataclass
class Mode:
    """What stays the same in a piece of a run."""

    torque: str = "inside"  # low, inside, high: at which limit; or that of the relay
    side: int = -1  # sign of slip - setpoint
    interval: int = 0  # of a tabulated road
    locked: bool = False
    target: float = 0.0
    latched: bool = False
    above: bool = True  # the deceleration exceeds the greatest: its next maximum counts
    greatest: float = 0.0  # deceleration, filtered or not
    best: float = 0.0  # slip there


@dataclasses.dataclass
class Record:
    """What was measured so far."""

    peak: float = 0.0
    outside: float = 0.0  # since when |e| was last greater than the band
    events: list[tuple[float, str]] = dataclasses.field(default_factory=list)


class Curve:
    """mu and its derivatives in slip and speed, for slips of 0 and more, in an interval of the curve."""

    def __init__(self, road: Any):
        if isinstance(road, roads.Tabulated):
            cubic = PchipInterpolator(np.asarray(road.slip), np.asarray(road.mu))
            self.knots, self.rows = cubic.x.tolist(), cubic.c.T.tolist()
        elif isinstance(road, roads.Burckhardt):
            self.knots, self.c = [0.0, math.inf], tuple(map(float, (road.c1, road.c2, road.c3, road.c4)))
        else:
            raise TypeError(type(road))
        self.tabulated = isinstance(road, roads.Tabulated)

    def at(self, s: float, v: float, interval: int) -> tuple[float, float, float]:
        """mu, dmu/ds, dmu/dv."""
        if self.tabulated:
            c3, c2, c1, c0 = self.rows[interval]
            z = s - self.knots[interval]
            return c0 + z * (c1 + z * (c2 + z * c3)), c1 + z * (2 * c2 + 3 * z * c3), 0.0
        c1, c2, c3, c4 = self.c
        plain, fade = -c1 * math.expm1(-c2 * s) - c3 * s, math.exp(-c4 * s * v)
        return plain * fade, (c1 * c2 * math.exp(-c2 * s) - c3 - c4 * v * plain) * fade, -c4 * s * plain * fade

    def interval(self, s: float) -> int:
        """Where a slip lies."""
        return max(0, min(int(np.searchsorted(self.knots, s, "right")) - 1, len(self.knots) - 2))

    def neighbour(self, interval: int, way: int) -> int:
        """The next interval."""
        return max(0, min(interval + way, len(self.knots) - 2))


class Brake:
    """A quarter car under a PID or a relay, with a fixed slip or one of the estimators."""

    def __init__(self, loop: Any, inertia: float):
        self.plant, self.controller, self.reference = loop.plant, loop.controller, loop.reference
        self.inertia, self.loop, self.curve = inertia, loop, Curve(loop.plant.road)
        self.relay = isinstance(loop.controller, controllers.Relay)
        self.robust = isinstance(loop.reference, references.PeakRobust)
        self.latch = isinstance(loop.reference, references.PeakLatch)

    def slip(self, z: Any) -> float:
        return 1.0 - self.plant.radius * z[W] / z[V]

    def raw(self, z: Any, m: Mode) -> float:
        """Torque before its limits."""
        c = self.controller
        return c.kp * (m.target - self.slip(z)) + c.ki * z[I]

    def torque(self, z: Any, m: Mode) -> float:
        if m.torque == "inside":
            return self.raw(z, m)
        c = self.controller
        return c.high if m.torque == "high" else c.low

    def rates(self, t: float, z: Any, m: Mode) -> list[float]:
        del t
        p, s = self.plant, self.slip(z)
        mu = self.curve.at(s, z[V], m.interval)[0]
        spin = 0.0 if m.locked else (p.radius * mu * p.mass * G - self.torque(z, m)) / self.inertia
        fast, slow = ((mu * G - z[AF]), (s - z[SF])) if self.robust else (0.0, 0.0)
        lag = self.reference.time_constant if self.robust else 1.0
        error = 0.0 if self.frozen(m) else m.target - s
        return [-mu * G, spin, z[V], error, fast / lag, slow / lag, m.side * (s - m.target)]

    def frozen(self, m: Mode) -> bool:
        """Whether the anti-windup holds the integral: at a limit, with an error that pushes further out."""
        outward = (m.torque == "high" and m.side < 0) or (m.torque == "low" and m.side > 0)
        return outward and isinstance(getattr(self.controller, "antiwindup", None), ConditionalIntegration)

    def slip_rate(self, z: Any, m: Mode) -> float:
        r = self.rates(0.0, z, m)
        return self.plant.radius * (z[W] * r[V] / z[V] - r[W]) / z[V]

    def deceleration_rate(self, z: Any, m: Mode) -> float:
        """d|a|/dt [m/s^3]."""
        _, by_slip, by_speed = self.curve.at(self.slip(z), z[V], m.interval)
        return G * (by_slip * self.slip_rate(z, m) + by_speed * self.rates(0.0, z, m)[V])

    def deceleration(self, z: Any, m: Mode) -> float:
        return G * self.curve.at(self.slip(z), z[V], m.interval)[0]

    def start(self) -> tuple[np.ndarray, Mode]:
        v, s = float(self.loop.initial.speed), float(self.loop.initial.slip)
        z = np.array([v, (1 - s) * v / self.plant.radius, 0.0, 0.0, 0.0, s, 0.0])
        m = Mode(target=float(self.reference.slip), interval=self.curve.interval(s))
        z[AF] = self.deceleration(z, m)
        m.torque = "high" if self.relay and s < m.target else "low"
        return z, self.placed(z, m)

    def placed(self, z: Any, m: Mode) -> Mode:
        """The mode after a jump of the target: side of the setpoint, limit of the torque. On a limit, by the rate."""
        e = self.slip(z) - m.target
        m = dataclasses.replace(m, side=int(math.copysign(1, e)) if abs(e) > 1e-9 else 0)
        if not m.side:
            m = dataclasses.replace(m, side=1)
            low = dataclasses.replace(m, torque="low") if not self.relay else m
            m = dataclasses.replace(m, side=int(math.copysign(1, self.slip_rate(z, low))))
        m = self.on_knot(z, m)
        if self.relay:
            return m
        raw, c = self.raw(z, m), self.controller
        for name, limit, way in (("low", c.low, 1), ("high", c.high, -1)):
            if way * (raw - limit) < -1e-9:
                return dataclasses.replace(m, torque=name)
            if abs(raw - limit) <= 1e-9:
                at = dataclasses.replace(m, torque=name)
                rising = -c.kp * self.slip_rate(z, at) + c.ki * (m.target - self.slip(z))
                return at if way * rising < 0 else dataclasses.replace(m, torque="inside")
        return dataclasses.replace(m, torque="inside")

    def on_knot(self, z: Any, m: Mode) -> Mode:
        """The mode of a slip that stands on a knot of the road: the interval that it goes to."""
        s = self.slip(z)
        for i, knot in enumerate(self.curve.knots[1:-1], 1):
            if self.curve.tabulated and abs(s - knot) < 1e-9:
                forth = self.slip_rate(z, dataclasses.replace(m, torque=self.limit(z, m))) > 0
                return dataclasses.replace(m, interval=i if forth else i - 1)
        return m

    def limit(self, z: Any, m: Mode) -> str:
        """At which limit the torque is, if at one."""
        if self.relay:
            return m.torque
        raw, c = self.raw(z, m), self.controller
        return "low" if raw <= c.low else "high" if raw >= c.high else "inside"

    def guards(self, m: Mode) -> Iterator[tuple[str, Callable[..., float], int]]:
        """Names, functions and directions of what ends a piece."""
        yield "stop", lambda t, z: z[V] - self.loop.stop.speed, -1
        yield "side", lambda t, z: self.slip(z) - m.target, -m.side
        yield from self.guards_of_wheel(m)
        yield from self.guards_of_torque(m)
        if self.latch or self.robust:
            yield from self.guards_of_estimator(m)

    def guards_of_estimator(self, m: Mode) -> Iterator[tuple[str, Callable[..., float], int]]:
        if not m.above:
            yield "above", lambda t, z: self.size(z, m) - EXCEEDS * m.greatest, 1
        elif self.robust:
            yield "maximum", lambda t, z: self.deceleration(z, m) - z[AF], -1
        else:
            yield "maximum", lambda t, z: self.deceleration_rate(z, m), -1
        if self.robust and not m.latched and m.greatest > self.reference.arming:
            yield "latch", lambda t, z: z[AF] - (1 - self.reference.threshold) * m.greatest, -1

    def size(self, z: Any, m: Mode) -> float:
        """The deceleration that the estimator looks at."""
        return z[AF] if self.robust else self.deceleration(z, m)

    def guards_of_wheel(self, m: Mode) -> Iterator[tuple[str, Callable[..., float], int]]:
        if m.locked:
            yield "free", lambda t, z: self.grip(z, m) - self.torque(z, m), 1
        else:
            yield "lock", lambda t, z: z[W], -1
        for way, i in ((1, m.interval + 1), (-1, m.interval)):
            if self.curve.tabulated and 0 < i < len(self.curve.knots) - 1:
                yield f"knot {way}", lambda t, z, i=i: self.slip(z) - self.curve.knots[i], way

    def grip(self, z: Any, m: Mode) -> float:
        """Torque of the road [N m]."""
        return self.plant.radius * self.plant.mass * self.deceleration(z, m)

    def guards_of_torque(self, m: Mode) -> Iterator[tuple[str, Callable[..., float], int]]:
        c = self.controller
        if self.relay:
            side = 1 if m.torque == "high" else -1
            yield "switch", lambda t, z: self.slip(z) - m.target - side * c.band, side
            return
        for name, limit, way in (("low", c.low, 1), ("high", c.high, -1)):
            if m.torque in (name, "inside"):
                leaving = way if m.torque == name else -way
                yield name, lambda t, z, limit=limit: self.raw(z, m) - limit, leaving

    def after(self, name: str, z: np.ndarray, m: Mode, t: float, record: Record) -> Mode:
        """The mode after an event; the record notes a jump."""
        change = dataclasses.replace
        if name == "side":
            return change(m, side=-m.side)
        if name == "switch":
            return change(m, torque="low" if m.torque == "high" else "high")
        if name in ("low", "high"):
            return change(m, torque="inside" if m.torque == name else name)
        if name in ("lock", "free"):
            z[W] = max(z[W], 0.0) if name == "free" else 0.0
            return change(m, locked=name == "lock")
        if name.startswith("knot"):
            return self.past_knot(z, m, int(name.split()[1]), t, record)
        if name == "above":
            return change(m, above=True)
        if name == "latch":
            return self.moved(z, change(m, latched=True, target=m.best), t, record, m)
        return self.maximum(z, m, t, record)

    def past_knot(self, z: np.ndarray, m: Mode, way: int, t: float, record: Record) -> Mode:
        """The next interval of the road. A peak of the curve lies on a knot: there the deceleration has its maximum."""
        new = dataclasses.replace(m, interval=self.curve.neighbour(m.interval, way))
        if not self.latch:
            return new
        middle = [0.5 * (self.curve.knots[i] + self.curve.knots[i + 1]) for i in (m.interval, new.interval)]
        before, after = (self.curve.at(s, z[V], self.curve.interval(s))[1] for s in middle)
        peak = m.above and way * before > 0 > way * after
        return self.maximum(z, new, t, record) if peak else new

    def maximum(self, z: np.ndarray, m: Mode, t: float, record: Record) -> Mode:
        """A maximum of the deceleration, filtered or not: kept if it is the greatest."""
        slip = z[SF] if self.robust else self.slip(z)
        new = dataclasses.replace(m, above=False, greatest=self.size(z, m), best=slip)
        if self.robust and not m.latched:
            return new
        return self.moved(z, dataclasses.replace(new, latched=True, target=slip), t, record, m)

    def moved(self, z: np.ndarray, new: Mode, t: float, record: Record, old: Mode) -> Mode:
        if abs(self.slip(z) - old.target) > SETTLED:
            record.outside = t
        record.events.append((t, f"target {new.target:.9g}"))
        return self.placed(z, new)

    def run(self) -> tuple[dict[str, float], Record]:
        """Metrics of a run, and its events."""
        z, m = self.start()
        t, record = 0.0, Record(peak=self.slip(z))
        for _ in range(20_000):
            t, z, name = self.piece(t, z, m, record)
            if name == "stop":
                return self.measured(t, z, m, record), record
            record.events.append((t, name))
            m = self.after(name, z, m, t, record)
        raise RuntimeError("a run without end")

    def piece(self, t: float, z: np.ndarray, m: Mode, record: Record) -> tuple[float, np.ndarray, str]:
        """The end of a piece: instant, state, and the guard that ended it."""
        guards = list(self.guards(m))
        events = [_event(guard, direction, True) for _, guard, direction in guards]
        events.append(_event(lambda t, z: self.slip_rate(z, m), -1, False))
        events.append(_event(lambda t, z: abs(self.slip(z) - m.target) - SETTLED, -1, False))
        part = solve_ivp(lambda t, z: self.rates(t, z, m), (t, t + 60.0), z, events=events, **TOLERANCE)
        if part.status != 1:
            raise RuntimeError(f"no event in a minute: {part.message}")
        t, z = float(part.t[-1]), part.y[:, -1].copy()
        tops = [self.slip(y) for y in part.y_events[-2]]
        record.peak = max([record.peak, self.slip(z), *tops])
        record.outside = max([record.outside, *part.t_events[-1]])
        hit = [
            name for (name, _, _), times in zip(guards, part.t_events, strict=False) if len(times) and times[-1] == t
        ]
        return t, z, hit[0]

    def measured(self, t: float, z: np.ndarray, m: Mode, record: Record) -> dict[str, float]:
        outside = abs(self.slip(z) - m.target) > SETTLED
        time, distance = self.left(t, z, m)
        settled = t if outside else record.outside
        beyond = max(record.peak / m.target - 1, 0.0)
        return dict(zip(METRICS, (z[X] + distance, t + time, z[AREA], record.peak, settled, beyond), strict=True))

    def left(self, t: float, z: np.ndarray, m: Mode) -> tuple[float, float]:
        """Time and distance from the stop's speed to rest: at the last deceleration, at half the mean one at least."""
        if isinstance(self.loop.stop, SpeedReached):
            return 0.0, 0.0
        deceleration = max(self.deceleration(z, m), (z[X] / t - z[V]) / t)
        return z[V] / deceleration, z[V] ** 2 / (2 * deceleration)


def _event(guard: Callable[..., float], direction: int, terminal: bool) -> Callable[..., float]:
    def event(t: float, z: Any) -> float:
        return guard(t, z)

    event.terminal, event.direction = terminal, direction  # pyright: ignore[reportFunctionMemberAccess]
    return event


def values(name: str, log_factor: float = 0.0) -> np.ndarray:
    """Metrics of a loop whose wheel has exp(log_factor) times its inertia."""
    loop = LOOPS[name]
    metrics, _ = Brake(loop, loop.plant.inertia * math.exp(log_factor)).run()
    return np.array([metrics[one] for one in METRICS])


def sensitivities(name: str, width: float = 2e-4) -> np.ndarray:
    """d(metrics)/d ln J: differences of two widths, extrapolated."""
    wide, narrow = ((values(name, w) - values(name, -w)) / (2 * w) for w in (width, width / 2))
    return (4 * narrow - wide) / 3


def ours(name: str, step: float) -> tuple[np.ndarray, np.ndarray]:
    """The package's metrics and their d/d ln J, forward mode."""
    import jax
    import jax.numpy as jnp

    from diffabs import objectives
    from diffabs.core.pytree import replace

    loop = LOOPS[name]

    def measured(log: Any) -> Any:
        moved = replace(loop, {"plant.inertia": loop.plant.inertia * jnp.exp(log)})
        run = d.measure(moved, d.FixedStep(step, 4.0, kinks=True), objectives.BRAKING)
        settling = run.metrics["settling_time"]  # of a run that never settles the oracle gives the end
        metrics = run.metrics | {"settling_time": jnp.where(jnp.isinf(settling), run.ending.sample.t, settling)}
        return jnp.stack([metrics[one] for one in METRICS])

    value, slope = jax.jit(lambda: jax.jvp(measured, (0.0,), (1.0,)))()
    return np.asarray(value), np.asarray(slope)


def table(name: str, steps: list[float]) -> Iterator[str]:
    """Lines of one loop."""
    exact = values(name), sensitivities(name)
    found = [ours(name, step) for step in steps]
    for i, metric in enumerate(METRICS):
        for label, n in (("", 0), (" d/dlnJ", 1)):
            errors = [abs(one[n][i] - exact[n][i]) for one in found]
            shown = " ".join(f"{one[n][i]:>13.8g}" for one in found)
            order = _order(errors[-2:], steps[-2:])
            yield (
                f"{name + ', ' + metric + label:<42} {shown}  {exact[n][i]:>15.10g}  "
                f"{' '.join(f'{e:8.1e}' for e in errors)}  {order}"
            )


def _order(errors: list[float], steps: list[float]) -> str:
    if len(errors) < 2 or min(errors) < 1e-12:
        return "  -"
    return f"{math.log(errors[0] / errors[1]) / math.log(steps[0] / steps[1]):4.1f}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=float, nargs="+", default=[4e-4, 1e-4, 2.5e-5])
    parser.add_argument("--only", help="loops whose name contains this")
    asked = parser.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    heads = " ".join(f"{'h = ' + format(h, 'g') + ' s':>13}" for h in asked.steps)
    print(f"{'':<42} {heads}  {'oracle':>15}  errors, order")
    for name in LOOPS:
        if not asked.only or asked.only in name:
            print("\n".join(table(name, asked.steps)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
