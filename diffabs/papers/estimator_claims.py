"""Judgement of Aoki and Nakamura's text on its figures: abrupt braking, gain of distance by friction, and the slip of
greatest friction.

The paper gives no number for these statements. The numbers here are those of the identified car, from the runs of its
tables.
"""

from collections.abc import Mapping

import jax
import numpy as np

from diffabs.core.types import JsonObject, Table
from diffabs.loop.result import Run
from diffabs.papers import record
from diffabs.parts.roads import peak

KMH = 3.6
LATE_TIME = 0.45  # s; later the torque is built up in every run
SLOW_SPEED = 20 / KMH  # m/s, for "even when the vehicle is slow"
CONTROLLERS = ("P", "PD", "PI", "PID")
COMPARED_METHODS = ("conventional", "proposed")


def run_columns(run: Run) -> dict[str, np.ndarray]:
    """Return the columns of a trajectory up to its end: time, torque, and the plant's outputs."""
    if run.trajectory is None:
        raise ValueError("a run without a trajectory, as `measure` returns it: use `rollout`")
    sample = run.trajectory.sample
    t = np.asarray(sample.t)
    fresh = np.concatenate([[True], np.diff(t) > 0])
    columns = {"t": t, "torque": sample.control, **sample.output._asdict()}
    return {name: np.asarray(column)[fresh] for name, column in columns.items()}


def variation(run: Run) -> float:
    """Return the total variation of the torque between the stored samples [N m]."""
    return float(np.sum(np.abs(np.diff(run_columns(run)["torque"]))))


def jerk(run: Run) -> float:
    """Return the greatest |da/dt| of the vehicle between stored samples from `LATE_TIME` on [m/s^3]."""
    columns = run_columns(run)
    t = columns["t"]
    rates = np.abs(np.diff(columns["deceleration"]) / np.diff(t))
    return float(np.max(rates[t[:-1] >= LATE_TIME]))


def rebounds(run: Run) -> int:
    """Return the number of sign changes of the wheel's acceleration from 0.3 s to 1 s."""
    columns = run_columns(run)
    rate = np.diff(columns["wheel_speed"])[(columns["t"][:-1] >= 0.3) & (columns["t"][:-1] < 1.0)]
    return int(np.sum(np.diff(np.sign(rate)) != 0))


def slow_deceleration(run: Run) -> float:
    """Return the mean deceleration over distance [m/s^2], from 20 km/h (`SLOW_SPEED`) to the last sample."""
    columns = run_columns(run)
    slow = columns["speed"] <= SLOW_SPEED
    v, x = columns["speed"][slow], columns["distance"][slow]
    return float((v[0] ** 2 - v[-1] ** 2) / (2 * (x[-1] - x[0])))


def braking_gain(slower: Run, faster: Run) -> tuple[float, float]:
    """Return by how much `faster` stops shorter than `slower` [m], and the part of it below 20 km/h [m].

    The distance is the integral of v dv/a(v), so its integrand gives the gain at each speed.
    """
    slow, fast = run_columns(slower), run_columns(faster)
    v = np.linspace(slow["speed"][-1], slow["speed"][1], 20_001)  # the first sample has no friction
    shorter = v * (1 / _at(v, slow) - 1 / _at(v, fast))
    return float(np.trapezoid(shorter, v)), float(np.trapezoid(np.where(v <= SLOW_SPEED, shorter, 0.0), v))


def _at(v: np.ndarray, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the deceleration at these speeds [m/s^2]; requires a speed that only falls."""
    return np.interp(v, columns["speed"][::-1], columns["deceleration"][::-1])


def judge_estimator_claims(runs: Mapping[str, Run], roads: Table) -> list[JsonObject]:
    """Return the rows that judge the statements, one for each number."""
    rows = []
    for name in (f"{method} {controller}" for method in COMPARED_METHODS for controller in CONTROLLERS):
        rows.append(record.computed_row(name, "variation of the torque", "N m", variation(runs[name])))
        rows.append(record.computed_row(name, f"largest jerk after {LATE_TIME:g} s", "m/s^3", jerk(runs[name])))
        rows.append(record.computed_row(name, "turns of the wheel's speed, 0.3 to 1 s", "1", rebounds(runs[name])))
    for method in COMPARED_METHODS:
        distances = [float(runs[f"{method} {controller}"].metrics["stop_distance"]) for controller in CONTROLLERS]
        rows.append(record.computed_row(method, "distance, between the four controllers", "m", np.ptp(distances)))
        name = f"{method} PI"
        rows.append(record.computed_row(name, "deceleration below 20 km/h", "m/s^2", slow_deceleration(runs[name])))
    whole, slow = braking_gain(runs["conventional PI"], runs["proposed PI"])
    rows.append(record.computed_row("proposed PI", "shorter than conventional", "m", whole))
    rows.append(record.computed_row("proposed PI", "of that below 20 km/h", "m", slow))
    for name, road in roads.items():
        rows.append(
            record.computed_row(f"friction curve, {name}", "slip of greatest friction", "1", jax.jit(peak)(road).slip)
        )
    return rows
