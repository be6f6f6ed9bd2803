"""Can the overshoot of Maeda and Sugiura be cured with a real actuator and a computer, and the cure be proved?

Their gain overshoots the target by 54 %, with torque limits by 82 %. Here the rig has torque limits of 0 and 9.03 N m
and an actuator lag of 1 ms. The controller runs at 1 kHz and assumes a mass of 5.75 kg in the holding torque tau*.
Gradients through 9 runs tune k1, k2 and T of

    u = tau*(5.75 kg) + (v/v0) (k1 x1 + k2 x2),   T target' = 0.2 - target

under constraints on overshoot and certified decay. The criterion is the worst run over a box of masses and speeds that
includes its corners. The study compares the published gain, LMI gains, known cures, and the cure without each of its
ingredients. `weak_spots.py` adds one deviation at a time. The certificate is one Lyapunov matrix for all masses, all
speeds from 5 to 50 km/h, and every course of the speed that friction allows.

    python experiments/overshoot_cured/run.py
"""

import dataclasses
import itertools
from typing import Any

import jax
import numpy as np

from diffabs import Batch, BrakeStart, FixedStep, Loop, Run, replace, run_batch
from diffabs.core.pytree import parameters
from diffabs.linear.slip_model import Sampling, SlipModel
from diffabs.papers import lmi_design, record
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import ConstantInput, HoldingInput, ProportionalFeedback, Sampled, StateFeedback
from diffabs.parts.objectives import BRAKING
from diffabs.parts.plants import MirroredRig
from diffabs.parts.references import FilteredSlip, FixedSlip
from diffabs.parts.stops import SpeedReached
from diffabs.robust.design import Certificate, Polytope, Spec, certify, design
from diffabs.robust.design.parameter_box import polytope
from diffabs.robust.design.speed_scaled import SpeedScaled, greatest_speed_fall
from diffabs.robust.design.state_feedback import feedback_gain
from diffabs.scenario.defaults import braking
from diffabs.scenario.scenario import load
from diffabs.tune import AtMost, CertifiedDecay, Method, Stopping, Tuned, build_problem, grid, tune
from experiments._shared.numbers import SEARCH_TOLERANCE, store_numbers
from experiments._shared.statistics import kept
from experiments.overshoot_cured.figures import figures
from experiments.overshoot_cured.weak_spots import Box, torques, weak_spots

KMH = 3.6


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    mass: tuple[float, float] = (5.3, 6.2)  # kg
    known_mass: float = 5.75  # kg, whose holding torque is fed forward
    slip: float = 0.2
    torque: tuple[float, float] = (0.0, 9.03)  # N m
    lag: float = 1e-3  # s, of the actuator
    period: float = 1e-3  # s, of the controller
    proved_speeds: tuple[float, float] = (5.0, 50.0)  # km/h
    fastest_fall: float = 7.9  # m/s^2, more than the rig's friction gives
    tuned_masses: tuple[float, ...] = (5.3, 5.75, 6.2)  # kg
    tuned_speeds: tuple[float, ...] = (20.0, 35.0, 50.0)  # km/h
    box: Box = dataclasses.field(default_factory=Box)  # judged on; the tuned masses and speeds lie in it
    drawn: tuple[tuple[float, float], ...] = ((5.3, 20.0), (6.2, 50.0), (6.2, 70.0))  # kg, km/h; the last is outside
    seeds: int = 4  # of the noise
    gain: tuple[float, float] = (-8000.0, -200.0)  # start of the tuning, at 50 km/h
    filter: float = 0.03  # s, start of the tuning
    gain_range: tuple[tuple[float, float], tuple[float, float]] = ((-1e5, -600.0), (-100.0, -15.0))
    filter_range: tuple[float, float] = (0.003, 0.1)
    overshoot: float = 0.008  # tuned for; 0.01 is asked
    decay: float = 50.0  # 1/s, to be proved
    weights: tuple[tuple[float, ...], tuple[float, ...]] = ((1e2, 1e4, 1e6, 1e8), (1.0, 1e2, 1e4))  # of the LMI
    tuning_step: float = 5e-4  # s
    step: float = 2.5e-4
    duration: float = 2.0
    longer: float = 3.0  # s, from 70 km/h
    iterations: int = 60
    out: str = "out/experiments/overshoot_cured"


def holding(config: Config) -> float:
    """Return tau* of the known mass [N m]."""
    rig = MirroredRig(mass=config.known_mass)
    output = rig.output(rig.start(BrakeStart(speed=config.tuned_speeds[-1] / KMH, slip=config.slip)))
    return float(rig.holding(output, config.slip))


def loop(config: Config, controller: Any, time_constant: float = 0.0, *, exact: bool = False) -> Loop:
    """Return the rig with its limits, lag and computer.

    Time constant 0: no filter; `exact`: the holding torque of the true mass.
    """
    low, high = config.torque
    controller = dataclasses.replace(controller, low=low, high=high)
    filtered = (
        FilteredSlip(slip=config.slip, time_constant=time_constant) if time_constant else FixedSlip(slip=config.slip)
    )
    return braking(
        plant=MirroredRig(mass=config.known_mass),
        initial=BrakeStart(speed=config.proved_speeds[1] / KMH),
        reference=filtered,
        feedforward=HoldingInput() if exact else ConstantInput(value=holding(config)),
        controller=Sampled(controller=controller, period=config.period),
        actuator=Lag(time_constant=config.lag),
        stop=SpeedReached(speed=config.proved_speeds[0] / KMH),
    )


def proportional(config: Config, gain: Any) -> ProportionalFeedback:
    """The gain at the highest speed."""
    return ProportionalFeedback(gain=np.array(gain, float), reference_speed=config.proved_speeds[1] / KMH)


def start(config: Config) -> Loop:
    """Return the loop before its tuning."""
    return loop(config, proportional(config, config.gain), config.filter)


def systems(config: Config) -> dict[str, Polytope]:
    """Return the linear systems of the certificates: the sampled rig with its lag, over masses and speeds.

    One is for a fixed gain. The other is for a proportional gain, and for any fall of the speed.
    """
    model = SlipModel(slip=config.slip, actuator=Lag(time_constant=config.lag), sampling=Sampling(period=config.period))
    low, high = (speed / KMH for speed in config.proved_speeds)
    scaled = SpeedScaled(model=model, reference_speed=high)
    falls = (0.0, greatest_speed_fall(config.fastest_fall, low, config.period))
    return {
        "fixed": polytope(model, {"plant.mass": config.mass, "speed": (low, high)}),
        "proportional": polytope(scaled, {"model.plant.mass": config.mass, "model.speed": (low, high), "fall": falls}),
    }


def tuned(config: Config, system: Polytope, subject: Loop, progress: Any = None) -> Tuned:
    """Gain and filter by gradients."""
    return tune(
        build_problem(
            subject,
            free={"controller.controller.gain": config.gain_range, "reference.time_constant": config.filter_range},
            objective={"iae": 1.0},
            over=grid({"plant.mass": config.tuned_masses, "initial.speed": [v / KMH for v in config.tuned_speeds]}),
            solver=FixedStep(step=config.tuning_step, duration=config.duration),
            constraints=[AtMost("overshoot", config.overshoot), CertifiedDecay(system, config.decay)],
        ),
        method=Method(stopping=Stopping(iterations=config.iterations)),
        progress=progress,
    )


def lmi_gains(config: Config) -> np.ndarray:
    """The paper's design, with correct vertices, for a grid of weights: diag(q1, q2), R = 1. Continuous time, as there,
    without lag and sampling."""
    low, high = (speed / KMH for speed in config.proved_speeds)
    system = polytope(SlipModel(slip=config.slip), {"plant.mass": config.mass, "speed": (low, high)})
    designs = (design(system, Spec(Q=weights, R=1.0)) for weights in itertools.product(*config.weights))
    return np.array([answer.gain[0] for answer in designs])


def best_lmi(config: Config, batch: Batch) -> tuple[float, float]:
    """Return the one of these gains that overshoots least on the rig."""
    gains, template = lmi_gains(config), loop(config, StateFeedback())
    solver = FixedStep(step=config.step, duration=config.duration)

    def brake(gain: Any) -> Run:
        return run_batch(replace(template, {"controller.controller.gain": gain}), batch, solver, BRAKING)

    metrics = jax.device_get(jax.jit(jax.vmap(brake))(gains)).metrics
    worst = np.nan_to_num(metrics["overshoot"].max(axis=1), nan=np.inf)
    k1, k2 = gains[int(np.argmin(worst))].tolist()
    return k1, k2


def contenders(config: Config, cure: Loop, lmi: tuple[float, float]) -> dict[str, tuple[Loop, str]]:
    """Return the compared loops, and the kind of certificate of each.

    The last rows are the cure without one of its ingredients.
    """
    k = np.asarray(cure.controller.controller.gain)  # pyright: ignore[reportAttributeAccessIssue]
    time_constant = float(cure.reference.time_constant)  # pyright: ignore[reportAttributeAccessIssue]
    slowest = k * config.proved_speeds[0] / config.proved_speeds[1]

    def fixed(gain: Any, time_constant: float = 0.0) -> tuple[Loop, str]:
        return loop(config, StateFeedback(gain=np.array(gain, float)), time_constant), "fixed"

    def follows(gain: Any, time_constant: float = 0.0, *, exact: bool = False) -> tuple[Loop, str]:
        return loop(config, proportional(config, gain), time_constant, exact=exact), "proportional"

    return {
        "published gain": fixed(lmi_design.PUBLISHED_GAIN),
        "LMI, same k1": fixed(lmi_design.SAME_INTEGRAL),
        "LMI, weights of least overshoot": fixed(lmi),
        "published gain, filter 35 ms": fixed(lmi_design.PUBLISHED_GAIN, 0.035),
        "K = [-121.8, -158.2]": fixed(lmi_design.GENTLE),
        "the cure": (cure, "proportional"),
        "the cure, as packaged": (load("slip-cured", integrated=False).loop, "proportional"),
        "before tuning": (start(config), "proportional"),
        "cure, filter left out": follows(k),
        "cure, gain fixed as at 50 km/h": fixed(k, time_constant),
        "cure, gain fixed as at 5 km/h": fixed(slowest, time_constant),
        "cure, integral left out": follows((-1e-3, k[1]), time_constant),
        "cure, exact holding torque": follows(k, time_constant, exact=True),
    }


def judged(config: Config, loop: Loop, system: Polytope, batch: Batch) -> tuple[dict[str, Any], Certificate]:
    """Return the worst metrics of the lanes that do not diverge, and the certificate of the gain."""
    solver = FixedStep(step=config.step, duration=config.duration)
    runs = jax.device_get(jax.jit(lambda loop: run_batch(loop, batch, solver, BRAKING))(loop))
    proof = certify(feedback_gain(loop, system.states), system, fastest=True)
    worst = {name: float(np.max(kept(values, ~runs.diverged))) for name, values in runs.metrics.items()}
    row = {
        "overshoot [%]": 100 * worst["overshoot"],
        "settling [s]": record.format_time(worst["settling_time"]),
        "locked [s]": worst["locked_time"],
        "max slip": worst["max_slip"],
        "IAE [s]": worst["iae"],
        "diverged": int(np.sum(runs.diverged)),
        "proved": {True: "stable", False: "no common P", None: "undecided"}[proof.quadratically_stable],
        "decay proved [1/s]": proof.decay_rate,
        "largest frozen |pole|": float(np.max(proof.frozen)),
    }
    return row, proof


def weak(config: Config, controllers: dict[str, tuple[Loop, str]]) -> list[dict[str, Any]]:
    """Return the worst overshoot of each controller under one deviation."""
    solver = FixedStep(step=config.step, duration=config.longer)
    return [
        {"controller": n, **weak_spots(loop, config.box, solver, config.seeds)} for n, (loop, _) in controllers.items()
    ]


def asked(config: Config, loop: Loop) -> dict[str, tuple[float, float]]:
    """Return least and greatest torque that the controller commands [N m]; inside the limits the linear model holds."""
    solver = FixedStep(step=config.step, duration=config.longer)
    outside = dataclasses.replace(config.box, speeds=(config.drawn[-1][1],))
    return {"in the box": torques(loop, config.box, solver), "from 70 km/h": torques(loop, outside, solver)}


def summary(config: Config, tuning: Tuned, proof: Certificate) -> dict[str, Any]:
    """Return everything to simulate the cure again, and its certificate."""
    plain = {path: np.asarray(value, float).tolist() for path, _, value in parameters(tuning.loop)}
    finite = {path: value for path, value in plain.items() if np.isfinite(value).all()}
    return {
        "controller": {
            "law": "u = limit(tau + (v/v0) (k1 x1 + k2 x2)), x1' = x2 = slip - target, T target' = slip_ref - target",
            "gain at v0 [N m/s, N m]": plain["controller.controller.gain"],
            "v0 [m/s]": plain["controller.controller.reference_speed"],
            "filter time constant T [s]": plain["reference.time_constant"],
            "slip_ref [1]": plain["reference.slip"],
            "feed-forward tau [N m]": plain["feedforward.value"],
            "limits [N m]": list(config.torque),
            "actuator lag [s]": plain["actuator.time_constant"],
            "period [s]": plain["controller.period"],
            "computing delay [s]": plain["controller.delay"],
        },
        "parameters": finite,
        "reason": tuning.reason.value,
        "evaluations": tuning.evaluations,
        "certificate": proof.summary(),
    }


def main(config: Config | None = None, progress: Any = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    proved, batch = systems(config), Batch(config.box.lanes())
    tuning = tuned(config, proved["proportional"], start(config), progress)
    controllers = contenders(config, tuning.loop, best_lmi(config, batch))
    rows, proofs = [], {}
    for name, (loop, kind) in controllers.items():
        row, proofs[name] = judged(config, loop, proved[kind], batch)
        rows.append({"controller": name, **row})
    record.print_rows(
        f"Worst of {batch.size} masses and speeds, corners included: 0..9.03 N m, lag 1 ms, 1 kHz, tau* of 5.75 kg",
        rows,
    )
    spots = weak(config, controllers)
    record.print_rows("Weak spots: worst overshoot [%] over the same box where one thing is wrong", spots)
    asked_for = asked(config, tuning.loop)
    cure = {**summary(config, tuning, proofs["the cure"]), "torque asked for [N m]": asked_for}
    demands = [{"starts": name, "least": low, "greatest": high} for name, (low, high) in asked_for.items()]
    record.print_rows(
        f"Torque [N m] that the cure asks for; {config.torque[0]:g} to {config.torque[1]:g} is what it gets", demands
    )
    results = {"table": rows, "weak_spots": spots, "cure": cure}
    return record.experiment(config, results, figures(config, tuning, controllers))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    results = main(progress=lambda p: print(f"round {p.round}: objective {p.point.objective:.6g}", end="\r"))
    store_numbers(__file__, results, SEARCH_TOLERANCE)
