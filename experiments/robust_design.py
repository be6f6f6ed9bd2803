"""What do further specifications cost, and what do they buy?

Maeda and Sugiura's rig over 5.3 to 6.2 kg and 5 to 50 km/h. Beside the guaranteed quadratic cost, a gain is asked for a
decay rate, damping, a limit of the torque from slip 0, an L2 gain from torque to slip error, a computer's sampling, or
it may follow the speed. Each is proved, and then brakes the nonlinear rig from 50 km/h, at 5.3 kg, without limits.

    python experiments/robust_design.py
"""

import dataclasses
from typing import Any

import jax

from diffabs import BrakeStart, FixedStep, Run, plot, rollout
from diffabs.controllers import HoldingInput, Sampled, ScheduledFeedback, StateFeedback
from diffabs.design import Certificate, Design, InputLimit, L2Gain, Spec, certify, design
from diffabs.design.parameter_box import polytope, schedule
from diffabs.linear.slip_model import Sampling, SlipModel
from diffabs.objectives import BRAKING
from diffabs.papers import record
from diffabs.plants import MirroredRig
from diffabs.scenario.defaults import braking
from diffabs.stops import SpeedReached


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    mass: tuple[float, float] = (5.3, 6.2)  # kg
    speed: tuple[float, float] = (5 / 3.6, 50 / 3.6)  # m/s
    weights: tuple[float, float] = (11753.0**2, 1e4)
    decay: float = 90.0  # 1/s
    damping: float = 0.95
    torque: float = 20.0  # N m, of the feedback, while the slip rises from 0
    gain: float = 4e-3  # of slip error over torque, 1/(N m)
    period: float = 1e-3  # s
    rates: tuple[float, float] = (-7.9, 0.0)  # m/s^2; friction slows the rig no faster
    cells: int = 8
    step: float = 1e-4  # s
    duration: float = 2.0  # s
    out: str = "out/experiments/robust_design"


def designs(config: Config) -> dict[str, Design]:
    """A gain and its proof for each specification."""
    model, box = SlipModel(plant=MirroredRig()), {"plant.mass": config.mass, "speed": config.speed}
    cost, system = {"Q": config.weights, "R": 1.0}, polytope(model, box)
    computer = dataclasses.replace(model, sampling=Sampling(period=config.period, delay=0.0))
    # per sample; the torque of the last sample is a state, whose weight only adds a thousandth to R
    sampled = Spec(Q=[config.period * w for w in (*config.weights, 1e-3)], R=config.period)
    start = InputLimit(config.torque, [[0.0, -model.slip]])
    return {
        "cost alone": design(system, Spec(**cost)),
        "decay": design(system, Spec(**cost, decay=config.decay)),
        "damping": design(system, Spec(**cost, damping=config.damping)),
        "torque limit": design(system, Spec(**cost, input=start)),
        "L2 gain": design(system, Spec(**cost, l2=L2Gain(output=[[0.0, 1.0]], bound=config.gain))),
        "sampled": design(polytope(computer, box), sampled),
        "scheduled": design(schedule(model, box, "speed", config.cells), Spec(**cost, rates=config.rates)),
    }


def controller(config: Config, name: str, found: Design) -> Any:
    """What runs in the loop."""
    if name == "scheduled":
        nodes = found.certificate.system.nodes  # pyright: ignore[reportAttributeAccessIssue]
        return ScheduledFeedback(speeds=nodes, integral_gains=found.gain[:, 0, 0], gains=found.gain[:, 0, 1])
    feedback = StateFeedback(gain=found.gain[0, :2])
    return Sampled(controller=feedback, period=config.period) if name == "sampled" else feedback


def brake(config: Config, found: dict[str, Design]) -> dict[str, Run]:
    """The nonlinear rig under each gain."""
    runs = {}
    for name, answer in found.items():
        loop = braking(
            plant=MirroredRig(mass=config.mass[0]),
            initial=BrakeStart(speed=config.speed[1]),
            feedforward=HoldingInput(),
            controller=controller(config, name, answer),
            stop=SpeedReached(speed=config.speed[0]),
        )
        runs[name] = rollout(loop, FixedStep(step=config.step, duration=config.duration, every=5), BRAKING)
    return runs


def table(found: dict[str, Design], runs: dict[str, Run]) -> list[dict[str, Any]]:
    """Gains, what is proved, and what the nonlinear rig does."""
    rows = []
    for name, answer in found.items():
        proof, metrics = _fastest(answer), runs[name].metrics
        gains = answer.gain.reshape(-1, answer.gain.shape[-1])
        low, high = gains[[0, -1], 1]
        rows.append(
            {
                "specification": name,
                "k1 [N m/s]": float(gains[-1, 0]),
                "k2 [N m]": f"{high:.1f}" if len(gains) == 1 else f"{low:.1f} to {high:.1f}",
                "guaranteed cost": proof.guaranteed_cost,
                "decay proved [1/s]": proof.decay_rate,
                "proved exactly": proof.verified_exactly,
                "overshoot [%]": 100 * float(metrics["overshoot"]),
                "settling time [s]": record.format_time(metrics["settling_time"]),
            }
        )
    return rows


def _fastest(answer: Design) -> Certificate:
    """What is proved about the gain, with the fastest decay."""
    proof = answer.certificate
    cost = next(claim.data for claim in proof.claims if claim.kind in ("cost", "scheduled"))
    spec = Spec(Q=cost["Q"], R=cost["R"], rates=cost.get("rates"))
    return certify(answer.gain, proof.system, spec, fastest=True)


def figures(runs: dict[str, Run], found: dict[str, Design]) -> dict[str, Any]:
    """Slip under each gain, and the scheduled gain."""
    seen: dict[str, Any] = {name: run.trajectory for name, run in runs.items()}
    figure, (ax,) = plot.sheet(title="The gain that follows the speed", size=(6.4, 3.8))
    answer = found["scheduled"]
    speeds = plot.KMH * answer.certificate.system.nodes  # pyright: ignore[reportAttributeAccessIssue]
    ax.plot(speeds, answer.gain[:, 0, 1], "o-", color=plot.COLOURS[0], label="scheduled")
    ax.axhline(found["cost alone"].gain[0, 1], color=plot.COLOURS[1], linestyle="--", label="one gain for all speeds")
    plot.label_axes(ax, "speed [km/h]", "k2 [N m]")
    slips = plot.draw_slips(seen, title="Braking under each specification, 5.3 kg", until=0.15)
    return {"slips": slips, "scheduled_gain": figure}


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    found = designs(config)
    runs = brake(config, found)
    rows = table(found, runs)
    record.print_rows("Specifications of a robust gain", rows)
    proofs = {name: answer.certificate.summary() for name, answer in found.items()}
    return record.experiment(config, {"table": rows, "certificates": proofs}, figures(runs, found))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
