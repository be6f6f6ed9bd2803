"""Proofs about the controllers of the study: the sampled loop with lag and computing delay, over the box.

The states are integral of the slip error, slip error, torque of the brake, torque of the last sample. Mass, inertia,
friction, lag and delay are constant in a run. The speed varies, and with it the rate of its fall and the place on the
friction curve. So the box is cut into cells of lag and delay. Within a cell everything may vary at will. A Lyapunov
matrix for each cell proves the whole.

A controller in proportion to the measured speed cancels the error of that speed: the measured slip moves by v/v_seen of
the true one, the gain is v_seen/v times the right one. Under a fixed gain the error acts like a range of the inertia.

Hulls of matrices cover a cell, one for each range of the speed: one hull of all speeds has vertices that are no
machine. A common P of all vertices is a proof. A vertex that fails proves no instability. So instability and the
absence of a common P are looked for among machines, the systems at points of the cell. Verdicts:

    proved      every cell: the vertices of its hulls have a common P
    unstable    a machine has a pole outside of the unit circle, at a frozen speed
    refuted     in a cell the machines themselves have no common P
    undecided   the machines have a common P, the vertices have none
"""

import dataclasses
import itertools
from typing import Any

import numpy as np

from diffabs import Loop
from diffabs.linear.slip_model import Sampling, SlipModel
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import PID, ProportionalFeedback, StateFeedback
from diffabs.parts.roads import RIG
from diffabs.robust.design import Polytope, certify
from diffabs.robust.design.parameter_box import polytope
from diffabs.robust.design.parameter_grid import grid_polytope
from diffabs.robust.design.speed_scaled import SpeedScaled, greatest_speed_fall
from experiments.real_rig.box import INERTIA, KMH, Box, Fixed


@dataclasses.dataclass(frozen=True)
class Proving:
    """Every number of the proofs."""

    cuts: int = 2  # of lag, and of delay
    speeds: int = 4  # ranges of the speed, of a fixed gain: a hull for each
    points: int = 2  # of each parameter: the machines of a cell
    fastest: float = 8.8  # m/s^2, more than the friction of the box gives
    slips: tuple[float, float] = (0.2, 0.2)  # where the wheel may be
    grid: int = 5


def gain(loop: Loop) -> tuple[np.ndarray, str] | None:
    """K of a linear controller, and whether it is fixed or proportional to the speed; None for another."""
    inner: Any = loop.controller.controller  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(inner, PID):
        return np.array([-float(inner.ki), -float(inner.kp)]), "fixed"
    if isinstance(inner, StateFeedback):
        return np.asarray(inner.gain, float), "fixed"
    if isinstance(inner, ProportionalFeedback):
        return np.asarray(inner.gain, float), "proportional"
    return None


def cells(config: Proving, box: Box) -> list[dict[str, tuple[float, float]]]:
    """Ranges of lag and delay."""
    lags = np.geomspace(*box.lag, config.cuts + 1)
    delays = np.linspace(*box.delay, config.cuts + 1)
    pairs = itertools.product(itertools.pairwise(lags.tolist()), itertools.pairwise(delays.tolist()))
    return [{"actuator.time_constant": lag, "sampling.delay": delay} for lag, delay in pairs]


def models(
    config: Proving, box: Box, fixed: Fixed, kind: str, cell: dict[str, tuple[float, float]]
) -> tuple[Any, dict[str, tuple[float, float]]]:
    """Return the model of a cell, and the ranges of its parameters by path."""
    model = SlipModel(
        slip=fixed.slip, actuator=Lag(time_constant=box.lag[0]), sampling=Sampling(period=fixed.period, delay=0.0)
    )
    low, high = fixed.end / KMH, box.speed[1] / KMH
    factor = 1 + box.first[1] if kind == "fixed" else 1.0
    over = {
        "plant.mass": box.mass,
        "plant.wheel_inertia": (INERTIA * box.inertia[0] / factor, INERTIA * box.inertia[1] * factor),
        "plant.road.w4": tuple(RIG.w4 * x for x in box.height),
        "speed": (low, high),
        **({"slip": config.slips} if config.slips[0] < config.slips[1] else {}),
        **cell,
    }
    if kind == "fixed":
        return model, over
    falls = {"fall": (0.0, greatest_speed_fall(config.fastest, low, fixed.period))}
    scaled = SpeedScaled(model=model, reference_speed=50 / KMH)
    return scaled, {f"model.{path}": ends for path, ends in over.items()} | falls


def covering(config: Proving, box: Box, fixed: Fixed, kind: str, cell: dict[str, tuple[float, float]]) -> Polytope:
    """Return the vertices of hulls that cover a cell: one hull, or for a fixed gain one for each range of the speed."""
    model, over = models(config, box, fixed, kind, cell)
    if kind != "fixed":
        return polytope(model, over, grid=config.grid)
    ends = np.geomspace(*over["speed"], config.speeds + 1).tolist()
    hulls = [polytope(model, over | {"speed": pair}, grid=config.grid) for pair in itertools.pairwise(ends)]
    a, b = (np.concatenate([getattr(hull, name) for hull in hulls]) for name in ("A", "B"))
    return Polytope(a, b, hulls[0].period, hulls[0].states)


def proofs(config: Proving, box: Box, fixed: Fixed, ones: dict[str, Loop]) -> dict[str, dict[str, Any]]:
    """Return the proof of each loop: the number of cells with a common P, and the slowest decay that it proves."""
    kinds = {name: matrix for name, loop in ones.items() if (matrix := gain(loop)) is not None}
    said: dict[str, dict[str, Any]] = {
        name: {"said": "not linear", "cells": 0, "of": 0} for name in ones if name not in kinds
    }
    systems = {
        kind: [
            (
                covering(config, box, fixed, kind, cell),
                grid_polytope(*models(config, box, fixed, kind, cell), config.points),
            )
            for cell in cells(config, box)
        ]
        for kind in {kind for _, kind in kinds.values()}
    }
    for name, (k, kind) in kinds.items():
        said[name] = _one(k, systems[kind], kind)
    return said


def _one(k: np.ndarray, those: list[tuple[Polytope, Polytope]], kind: str) -> dict[str, Any]:
    whole = np.concatenate([k, np.zeros(those[0][0].order - len(k))])
    certificates = [certify(whole, vertices, fastest=True) for vertices, _ in those]
    stable = [proof.quadratically_stable for proof in certificates]
    rates = [proof.decay_rate for proof in certificates if proof.quadratically_stable]
    sampled = [certify(whole, machines) for _, machines in those]
    worst = max(float(np.max(proof.frozen)) for proof in sampled)
    word = "proved" if all(stable) else "undecided"
    if any(proof.quadratically_stable is False for proof in sampled):
        word = "refuted"
    if kind == "fixed" and worst >= 1:
        word = "unstable"
    return {
        "said": word,
        "cells": sum(s is True for s in stable),
        "cells in which machines have a common P": sum(proof.quadratically_stable is True for proof in sampled),
        "of": len(certificates),
        "decay [1/s]": min(rates) if len(rates) == len(certificates) else None,
        "largest frozen |pole| of a machine": worst,
        "vertices": [vertices.vertices for vertices, _ in those],
        "machines": [machines.vertices for _, machines in those],
        "verified exactly": all(
            proof.verified_exactly for proof, s in zip(certificates, stable, strict=True) if s is not None
        ),
    }
