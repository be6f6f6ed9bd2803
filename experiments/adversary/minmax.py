"""Tuning against the adversary, in rounds: find the worst points for the present gains, then tune the gains.

A round tunes over all points of the rounds before, and over random points:

    minimise over gains   CVaR over lanes (overshoot + weight IAE)

The integral of the error stands beside the overshoot because a brake that does nothing does not overshoot.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from diffabs import Batch, Loop
from diffabs.tune import CVaR, DerivativeMode, Method, Stopping, build_problem, tune
from experiments._shared.statistics import kept
from experiments.adversary.attack import MEASURED, NOTHING, Attack
from experiments.adversary.bounds import Bounds, drawn, nominal, parameters
from experiments.adversary.search import Log, Searching, gradients
from experiments.real_rig.box import KNOWN, Box, Fixed
from experiments.real_rig.box import drawn as drawn_from_box
from experiments.real_rig.judge import Judging, runs
from experiments.real_rig.loops import loop as loop_of_box


@dataclasses.dataclass(frozen=True)
class Rounds:
    """Every number of the rounds."""

    rounds: int = 3
    budget: int = 1000  # runs of a search in a round
    seeds: tuple[int, ...] = (11, 12, 13, 14, 15)  # of the searches, times the number of the round
    box: int = 40  # random points, which stay
    room: int = 24  # lanes for what the adversary found; those that are not needed yet are random points
    level: float = 0.9  # of CVaR
    weights: Mapping[str, float] = dataclasses.field(default_factory=lambda: {"overshoot": 1.0, "iae": 1.0})  # 1, 1/s
    iterations: int = 8
    seed: int = 7
    fresh: tuple[int, ...] = (101, 102, 103, 104, 105)  # seeds of the searches that judge
    samples: int = 2000  # random points that judge
    free: Mapping[str, Any] = dataclasses.field(
        default_factory=lambda: {
            "controller.controller.gain": ((-2e4, -400.0), (-10.0, -10.0)),
            "controller.controller.antiwindup.tracking_time": (0.001, 1.0),
            "reference.rate": (0.5, 40.0),
            "reference.time_constant": (0.001, 0.1),
        }
    )


def attacked(attack: Attack, config: Searching, seeds: tuple[int, ...], budget: int, price: float) -> Log:
    """Return the results of a search by gradients from these seeds."""
    return gradients(attack, dataclasses.replace(config, seeds=seeds, budget=budget), price)


def hardened(
    attack: Attack, config: Rounds, searching: Searching, price: float, report: Callable[[str], None]
) -> tuple[list[Loop], np.ndarray]:
    """Return the loop before the first round and after each, and all worst points (n, size)."""
    bounds, loops = attack.bounds, [attack.loop]
    lanes = drawn(bounds, config.box + config.room, np.random.default_rng(config.seed))
    count = 0
    for number in range(1, config.rounds + 1):
        now = dataclasses.replace(attack, loop=loops[-1])
        seeds = tuple(number * 1000 + seed for seed in config.seeds)
        points = attacked(now, searching, seeds, config.budget, price).points
        lanes[config.box + count : config.box + count + len(points)] = points
        count += len(points)
        loops.append(_tuned(loops[-1], bounds, config, attack, lanes))
        report(f"round {number}: {_said(loops[-1])}")
    return loops, lanes[config.box : config.box + count]


def _tuned(loop: Loop, bounds: Bounds, config: Rounds, attack: Attack, lanes: np.ndarray) -> Loop:
    names = tuple(config.weights)
    tuning = tune(
        build_problem(
            loop,
            free=config.free,
            objective=config.weights,
            over=Batch(parameters(bounds, lanes)),
            solver=attack.solver(),
            measured={name: MEASURED[name] for name in names},
            aggregate=CVaR(level=config.level),
            mode=DerivativeMode.FORWARD,
        ),
        method=Method(stopping=Stopping(change=1e-4, iterations=config.iterations)),
    )
    return tuning.part


def _said(loop: Loop) -> str:
    parts: Any = loop
    gain = ", ".join(f"{k:.0f}" for k in np.asarray(parts.controller.controller.gain))
    tracking = float(parts.controller.controller.antiwindup.tracking_time)
    return (
        f"gain {gain}, tracking {tracking:.4f} s, rate {float(parts.reference.rate):.2f} /s, "
        f"time constant {float(parts.reference.time_constant):.4f} s"
    )


def judged(attack: Attack, config: Rounds, searching: Searching, price: float) -> dict[str, Any]:
    """Return how a loop fares against fresh adversaries, and on random points. A run that diverges or does not stop
    is counted, and in no mean."""
    log = attacked(attack, searching, config.fresh, config.budget, price)
    points = drawn(attack.bounds, config.samples, np.random.default_rng(config.seed + 1))
    both = log.overshoots, attack.overshoots(points)
    fresh, random = (kept(each, each > NOTHING) for each in both)
    error, errors = (attack.runs(z).metrics["iae"] for z in (nominal(attack.bounds), log.points))
    return {
        "nominal [%]": 100 * float(attack.overshoots(nominal(attack.bounds))[0]),
        "fresh adversaries, median [%]": 100 * float(np.median(fresh)),
        "least [%]": 100 * float(fresh.min()),
        "greatest [%]": 100 * float(fresh.max()),
        "random, median [%]": 100 * float(np.median(random)),
        "random, 95 % [%]": 100 * float(np.quantile(random, 0.95)),
        "random, greatest [%]": 100 * float(random.max()),
        "not stopped or diverged": sum(int(np.sum(each <= NOTHING)) for each in both),
        "IAE, nominal [s]": float(error[0]),
        "IAE, greatest found [s]": float(np.max(kept(errors, log.overshoots > NOTHING))),
        **in_the_box(attack.loop, config),
    }


def in_the_box(loop: Loop, config: Rounds) -> dict[str, float]:
    """Return overshoots of the same gains in the box of `real_rig`, with every error at once. A run that diverges
    counts as LOST."""
    parts: Any = loop
    judged = loop_of_box(Fixed(), parts.controller.controller, KNOWN, parts.reference)
    points = drawn_from_box(Box(), KNOWN, config.samples, config.seed + 2)
    overshoots = 100 * runs(judged, points, Judging(), config.seed + 2)["overshoot"]
    quantiles = {"median": 0.5, "95 %": 0.95, "greatest": 1.0}
    return {f"box, {name} [%]": float(np.quantile(overshoots, level)) for name, level in quantiles.items()}
