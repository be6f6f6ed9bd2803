"""A second version of the loops of experiments/real_rig, in NumPy, from a document of its `document.py` alone.

Nothing of diffabs: the plant by Runge-Kutta's classical method, everything else by the difference equations. Noise of
zero deviation only: the random numbers are another program's."""

import math
from typing import Any

import numpy as np

GRAVITY = 9.81


class Read:
    """Parameters of a document by path, and the kinds of its parts."""

    def __init__(self, document: dict[str, Any]):
        self.values = {path: np.array(one["value"]) for path, one in document["parameters"].items()}
        self.kinds, self.sensors = document["kinds"], document["sensors"]

    def __call__(self, path: str) -> Any:
        value = self.values[path]
        return float(value) if value.ndim == 0 else value

    def sensor(self, kind: str, name: str) -> float:
        """Of the first block of a kind."""
        return self(f"sensor.blocks.{self.sensors.index(kind)}.{name}")


def friction(read: Read, slip: float) -> float:
    """mu."""
    w1, w2, w3, w4, a, q = (read(f"plant.road.{name}") for name in ("w1", "w2", "w3", "w4", "a", "q"))
    s = abs(slip)
    return math.copysign(w4 * s**q / (a + s**q) + w3 * s**3 + w2 * s**2 + w1 * s, slip) if s else 0.0


def seen(read: Read, omega: np.ndarray) -> tuple[float, float, float, float]:
    """Slip, v, w, deceleration."""
    v, w = read("plant.body_radius") * omega[1], read("plant.wheel_radius") * omega[0]
    slip = (v - w) / max(v, w, read("plant.crawl_speed"))
    return slip, v, w, friction(read, slip) * GRAVITY / read("plant.inertia_factor")


def rates(read: Read, x: np.ndarray, u: float) -> np.ndarray:
    """Of omega1, omega2, torque."""
    _, _, _, a = seen(read, x)
    push = read("plant.inertia_factor") * read("plant.mass") * a * read("plant.wheel_radius")
    wheel = (push - x[2]) / read("plant.wheel_inertia")
    body, torque = -a / read("plant.body_radius"), (u - x[2]) / read("actuator.time_constant")
    return np.array([wheel if x[0] > 0 else max(wheel, 0.0), body if x[1] > 0 else max(body, 0.0), torque])


def integrated(read: Read, x: np.ndarray, u: float, h: float) -> np.ndarray:
    """One step of RK4 under a constant command."""
    a = rates(read, x, u)
    b = rates(read, x + h / 2 * a, u)
    c = rates(read, x + h / 2 * b, u)
    d = rates(read, x + h * c, u)
    x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return np.array([max(x[0], 0.0), max(x[1], 0.0), x[2]])


class Speed:
    """What is seen of the vehicle's speed."""

    def __init__(self, read: Read):
        self.read, self.kind = read, read.kinds["speed"]
        self.v, self.variance, self.braked = 0.0, 0.0, 0.0
        self.begun = False

    def __call__(self, t: float, v: float, w: float, deceleration: float) -> tuple[float, float]:
        """v_k and slip_k."""
        read, kind = self.read, self.kind
        floor = read.sensor(kind, "floor")
        if kind == "DriftingSpeed":
            first, last, time = (read.sensor(kind, name) for name in ("first", "last", "time_constant"))
            v = (1 + last + (first - last) * math.exp(-t / time)) * v
            return v, (v - w) / max(v, floor)
        noise, growth, gate, rest, hold, h = (
            read.sensor(kind, name) for name in ("noise", "growth", "gate", "rest", "hold", "period")
        )
        a = deceleration + read.sensor("Bias", "deceleration")
        p, variance = max(self.v - h * a, floor), self.variance + h * growth**2
        slip, self.braked = (p - w) / p, max(a, self.braked * math.exp(-h / hold))
        if not self.begun or (slip >= gate and self.braked < rest):
            self.v, self.braked, self.begun = max(w, floor), 9.81, True
            self.variance = (noise * self.v) ** 2
        else:
            gain = min(max(1 - slip / gate, 0.0), 1.0) * variance / (variance + (noise * p) ** 2)
            self.v, self.variance = max(p + gain * (w - p), floor), (1 - gain) * variance
        return self.v, (self.v - w) / self.v


def rounded(read: Read, w: float) -> float:
    """The wheel's speed as it is seen."""
    q = read.sensor("Quantisation", "wheel_speed") if "Quantisation" in read.sensors else 0.0
    return q * np.round(w / q) if q else w


class Controller:
    """u_k, and what is remembered of it."""

    def __init__(self, read: Read):
        self.read, self.kind, self.x, self.filtered = read, read.kinds["controller"], 0.0, 0.0

    def __call__(self, v: float, error: float) -> float:
        """`error` is slip_k - target_k."""
        if self.kind == "SlidingMode":
            share = -error / self.of("boundary")
            return self.within(self.read("feedforward.value") + self.of("gain") * min(max(share, -1.0), 1.0))
        return self.pid(-error) if self.kind == "PID" else self.feedback(v, error)

    def of(self, name: str) -> Any:
        """A parameter."""
        return self.read(f"controller.controller.{name}")

    def within(self, raw: float) -> float:
        """Within the torque's limits."""
        return min(max(raw, self.of("low")), self.of("high"))

    def drained(self, lost: float, gain: float) -> float:
        """What the anti-windup adds to the integral's rate."""
        known = "controller.controller.antiwindup.tracking_time" in self.read.values
        return lost / (gain * self.of("antiwindup.tracking_time")) if known else 0.0

    def feedback(self, v: float, error: float) -> float:
        """With a gain that is fixed or proportional to the speed."""
        k1, k2 = self.of("gain")
        g = v / self.of("reference_speed") if self.kind == "ProportionalFeedback" else 1.0
        raw = self.read("feedforward.value") + g * (k1 * self.x + k2 * error)
        u = self.within(raw)
        self.x += self.read("controller.sampling_period") * (error + self.drained(u - raw, g * k1))
        return u

    def pid(self, error: float) -> float:
        """`error` is target_k - slip_k."""
        kp, ki, kd, cutoff = (self.of(name) for name in ("kp", "ki", "kd", "cutoff"))
        h, rate = self.read("controller.sampling_period"), cutoff * (error - self.filtered)
        raw = self.read("feedforward.value") + kp * error + ki * self.x + kd * rate
        u = self.within(raw)
        self.x += h * (error + self.drained(u - raw, ki))
        self.filtered += h * rate
        return u


def target(read: Read, v: float, last: float, k: int) -> float:
    """target_k; `last` is that before, of k = 0 the first slip."""
    kind, slip = read.kinds["reference"], read("reference.slip")
    if kind == "FixedSlip":
        return slip
    time = read("reference.time_constant")
    if kind == "FilteredSlip":  # its equation by the plant's Runge-Kutta steps
        z = -read("controller.sampling_period") / time
        return slip - (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24) * (slip - last) if k else last
    h = read("reference.period") * read("reference.reference_speed") / max(v, read("reference.floor"))
    return last + min(-math.expm1(-h / time) * (slip - last), h * read("reference.rate"))


def simulated(document: dict[str, Any], steps: int) -> dict[str, np.ndarray]:
    """True slip, speed, torque and target at t_k, k = 0 ... steps, one step of RK4 for each period; the step in which
    the command changes takes its mean, as `SampledOnGrid` says."""
    read = Read(document)
    h, delay = read("controller.sampling_period"), read("controller.delay")
    v0, slip0 = read("initial.speed"), read("initial.slip")
    state = np.array([(1 - slip0) * v0 / read("plant.wheel_radius"), v0 / read("plant.body_radius"), 0.0])
    speed = Speed(read)
    _, v, w, a = seen(read, state)
    asked = Speed(read)(0.0, v, rounded(read, w), a)[1]
    applied, controller = 0.0, Controller(read)
    found: dict[str, list[float]] = {name: [] for name in ("slip", "speed", "torque", "target")}
    for k in range(steps + 1):
        slip, v, w, a = seen(read, state)
        v_seen, slip_seen = speed(k * h, v, rounded(read, w), a)
        asked = target(read, v_seen, asked, k)
        u = controller(v_seen, slip_seen - asked)
        for name, value in zip(found, (slip, v, state[2], asked), strict=True):
            found[name].append(value)
        share = min(delay / h, 1.0)
        state = integrated(read, state, share * applied + (1 - share) * u, h)
        applied = u
    return {name: np.array(values) for name, values in found.items()}
