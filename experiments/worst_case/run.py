"""The worst case of a controller in a box of plant, road, actuator and speed, and a certificate over the box.

Gradient ascent starts from the worst corner and from the worst of a few random points. It is compared with 100,000
random samples and with the 32 corners alone. The controllers are the published gain and the cured loop (scenario
slip-cured), on the rig with torque limits, lag and sampling. A counterexample needs no proof, but its absence does. So
`certify` gets the linear loop over the same box.

    python experiments/worst_case/run.py
"""

import dataclasses
import time
from typing import Any

import jax
import numpy as np

from diffabs import FixedStep, Loop, Run, measure, replace, rollout, run_batch
from diffabs.linear.slip_model import Sampling, SlipModel
from diffabs.output import plot
from diffabs.papers import lmi_design, record
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers import StateFeedback
from diffabs.parts.objectives import BRAKING
from diffabs.parts.references import FixedSlip
from diffabs.robust.design import Certificate, certify
from diffabs.robust.design.parameter_box import polytope
from diffabs.robust.design.speed_scaled import SpeedScaled, greatest_speed_fall
from diffabs.robust.design.state_feedback import feedback_gain
from diffabs.scenario.scenario import load
from diffabs.tune import WorstCase, grid, worst_case
from experiments._shared.numbers import store_numbers


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment. Ranges of the loop's parameters by path, [low, high], SI."""

    box: tuple[tuple[str, float, float], ...] = (
        ("plant.mass", 5.3, 6.2),
        ("plant.wheel_inertia", 6.5e-3, 8.5e-3),
        ("plant.road.w4", 0.37, 0.44),
        ("actuator.time_constant", 5e-4, 2e-3),
        ("initial.speed", 20 / 3.6, 50 / 3.6),
    )
    bound: float = 0.05  # overshoot that would count as a failure
    samples: int = 100_000
    block: int = 2000  # samples that run together
    screen: int = 32
    starts: int = 4
    iterations: int = 8
    step: float = 5e-4  # s
    duration: float = 2.0
    seed: int = 5
    out: str = "out/experiments/worst_case"


def loops() -> dict[str, Loop]:
    """The cure, and the published gain in its place."""
    cure = load("slip-cured").loop
    feedback = StateFeedback(gain=np.array(lmi_design.PUBLISHED_GAIN), low=0.0, high=9.03)
    sampled = dataclasses.replace(cure.controller, controller=feedback)
    published = dataclasses.replace(cure, controller=sampled, reference=FixedSlip(slip=cure.reference.slip))
    return {"published gain": published, "the cure": cure}


def search_worst(config: Config, loop: Loop) -> WorstCase:
    """Return the worst case by gradients."""
    return worst_case(
        loop,
        over={path: (low, high) for path, low, high in config.box},
        metric="overshoot",
        solver=FixedStep(step=config.step, duration=config.duration),
        bound=config.bound,
        screen=config.screen,
        starts=config.starts,
        iterations=config.iterations,
        seed=config.seed,
    )


def corners(config: Config, loop: Loop) -> tuple[float, dict[str, float]]:
    """Greatest overshoot at the corners of the box, and where."""
    batch = grid({path: (low, high) for path, low, high in config.box})
    solver = FixedStep(step=config.step, duration=config.duration)
    overshoot = np.asarray(jax.jit(lambda loop: run_batch(loop, batch, solver, BRAKING))(loop).metrics["overshoot"])
    i = int(np.nanargmax(overshoot))
    return float(overshoot[i]), {path: float(column[i]) for path, column in batch.values.items()}


def draw_samples(config: Config, loop: Loop) -> dict[str, np.ndarray]:
    """Overshoot of random samples, uniform over the box, and where the worst lies."""
    low, high = np.array([ends[1:] for ends in config.box]).T
    u = jax.random.uniform(jax.random.key(config.seed), (config.samples, len(low)))
    points = low + (high - low) * u
    solver = FixedStep(step=config.step, duration=config.duration)

    def brake(point: Any) -> Any:
        values = {path: x for (path, _, _), x in zip(config.box, point, strict=True)}
        run = measure(replace(loop, values), solver, BRAKING)
        return run.metrics["overshoot"], run.diverged

    overshoot, diverged = jax.jit(lambda x: jax.lax.map(brake, x, batch_size=config.block))(points)
    return {"points": np.asarray(points), "overshoot": np.asarray(overshoot), "diverged": np.asarray(diverged)}


def proof(config: Config, loop: Loop) -> Certificate:
    """Return the certificate of the linear loop over the same box, down to the speed at which a run ends."""
    lag, controller = config.box[3][0], loop.controller
    assert lag == "actuator.time_constant"
    names = {"initial.speed": "speed"}
    over = {names.get(path, path): (low, high) for path, low, high in config.box}
    over["speed"] = (float(loop.stop.speed), over["speed"][1])  # pyright: ignore[reportAttributeAccessIssue]
    model = SlipModel(actuator=Lag(time_constant=1e-3), sampling=Sampling(period=float(controller.period)))  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(controller.controller, StateFeedback):  # pyright: ignore[reportAttributeAccessIssue]
        system = polytope(model, over, grid=5)
    else:
        wider = SpeedScaled(model=model, reference_speed=over["speed"][1])
        falls = (0.0, greatest_speed_fall(8.6, over["speed"][0], float(controller.period)))  # pyright: ignore[reportAttributeAccessIssue]
        system = polytope(wider, {**{f"model.{path}": ends for path, ends in over.items()}, "fall": falls}, grid=5)
    return certify(feedback_gain(loop, system.states), system, fastest=True)


def roll_out(config: Config, loop: Loop) -> Run:
    """Return the run with its trajectory."""
    return rollout(loop, FixedStep(step=config.step, duration=config.duration), BRAKING)


def figures(config: Config, worst: dict[str, WorstCase], controllers: dict[str, Loop], random: Any) -> dict[str, Any]:
    """Nominal and worst run of each controller, and how the random samples are distributed."""
    figure, axes = plot.sheet(2, len(controllers), title="Nominal and worst case", size=(5.8, 3.1))
    for i, (name, loop) in enumerate(controllers.items()):
        runs = {"nominal": roll_out(config, loop), "worst case found": roll_out(config, worst[name].loop)}
        plot.draw_slip_lines(axes[i], {label: run.trajectory for label, run in runs.items()})
        axes[i].set_xlim(0, 0.5)
        plot.label_axes(axes[i], "time [s]", "slip [1]", name)
        ax = axes[len(controllers) + i]
        ax.hist(100 * random[name]["overshoot"], bins=80, color=plot.COLOURS[5], log=True, label="random samples")
        ax.axvline(100 * worst[name].value, color=plot.COLOURS[1], label="worst found")
        plot.label_axes(ax, "overshoot [%]", "samples")
    return {"worst_case": figure}


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    controllers, rows, worst, random, reports, at_corner = loops(), [], {}, {}, {}, {}
    for name, loop in controllers.items():
        begun = time.perf_counter()
        worst[name] = search_worst(config, loop)
        seconds = time.perf_counter() - begun
        random[name] = draw_samples(config, loop)
        at_corners, at_corner[name] = corners(config, loop)
        proved = proof(config, loop)
        greatest = float(np.nanmax(random[name]["overshoot"]))
        reports[name] = worst[name].report(proved.quadratically_stable)
        rows.append(
            {
                "controller": name,
                "nominal overshoot [%]": 100 * float(roll_out(config, loop).metrics["overshoot"]),
                "worst found [%]": 100 * worst[name].value,
                f"worst of the {2 ** len(config.box)} corners [%]": 100 * at_corners,
                f"worst of {config.samples} samples [%]": 100 * greatest,
                "rollouts": worst[name].rollouts,
                "samples per rollout": config.samples / worst[name].rollouts,
                "seconds, compiling": seconds,
                "stable over the box": {True: "proved", False: "no common P", None: "undecided"}[
                    proved.quadratically_stable
                ],
            }
        )
    record.print_rows("The worst case in a box of five parameters", rows)
    for name, report in reports.items():
        print(f"{name}: {report}")
    at = {name: {k: float(v) for k, v in loop.values.items()} for name, loop in worst.items()}
    results = {"table": rows, "reports": reports, "worst": at, "worst_corner": at_corner}
    return record.experiment(config, results, figures(config, worst, controllers, random))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(), tolerance=1e-3)
