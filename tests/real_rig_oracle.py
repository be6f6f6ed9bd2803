"""A second version of the loops of experiments/real_rig.py, in NumPy, from a document of `real_rig_document` alone.

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
        self.v, self.variance = 0.0, None

    def __call__(self, t: float, v: float, w: float, deceleration: float) -> tuple[float, float]:
        """v_k and slip_k."""
        read, kind = self.read, self.kind
        floor = read.sensor(kind, "floor")
        if kind == "DriftingSpeed":
            first, last, time = (read.sensor(kind, name) for name in ("first", "last", "time_constant"))
            v = (1 + last + (first - last) * math.exp(-t / time)) * v
            return v, (v - w) / max(v, floor)
        noise, growth, gate, h = (read.sensor(kind, name) for name in ("noise", "growth", "gate", "period"))
        if self.variance is None:
            self.v = max(w, floor)
            self.variance = (noise * self.v) ** 2
        else:
            p = max(self.v - h * (deceleration + read.sensor("Bias", "deceleration")), floor)
            variance = self.variance + h * growth**2
            share = min(max(1 - (p - w) / p / gate, 0.0), 1.0)
            gain = share * variance / (variance + (noise * p) ** 2)
            self.v, self.variance = max(p + gain * (w - p), floor), (1 - gain) * variance
        return self.v, (self.v - w) / self.v


def rounded(read: Read, w: float) -> float:
    """The wheel's speed as it is seen."""
    q = read.sensor("Quantisation", "wheel_speed") if "Quantisation" in read.sensors else 0.0
    return q * np.round(w / q) if q else w


def control(read: Read, v: float, error: float, x: float) -> tuple[float, float]:
    """u_k, and x_(k+1)."""
    path, h = "controller.controller.", read("controller.sampling_period")
    k1, k2 = read(path + "gain")
    g = v / read(path + "reference_speed") if read.kinds["controller"] == "ProportionalFeedback" else 1.0
    raw = read("feedforward.value") + g * (k1 * x + k2 * error)
    u = min(max(raw, read(path + "torque_min")), read(path + "torque_max"))
    windup = path + "antiwindup.tracking_time"
    drain = (u - raw) / (g * k1 * read(windup)) if windup in read.values else 0.0
    return u, x + h * (error + drain)


def target(read: Read, v: float, last: float) -> float:
    """target_k."""
    h = read("reference.period") * read("reference.reference_speed") / max(v, read("reference.floor"))
    left = read("reference.slip") - last
    return last + min(-math.expm1(-h / read("reference.time_constant")) * left, h * read("reference.rate"))


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
    applied = x = 0.0
    found: dict[str, list[float]] = {name: [] for name in ("slip", "speed", "torque", "target")}
    for k in range(steps + 1):
        slip, v, w, a = seen(read, state)
        v_seen, slip_seen = speed(k * h, v, rounded(read, w), a)
        asked = target(read, v_seen, asked)
        u, x = control(read, v_seen, slip_seen - asked, x)
        for name, value in zip(found, (slip, v, state[2], asked), strict=True):
            found[name].append(value)
        share = min(delay / h, 1.0)
        state = integrated(read, state, share * applied + (1 - share) * u, h)
        applied = u
    return {name: np.array(values) for name, values in found.items()}
