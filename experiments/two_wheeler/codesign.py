"""A machine for the paper's claim: arm, mount, motor, gear and weights, designed together by gradients.

The objective is a multiple c of the paper's start, frame c 0.5 rad and rider c 0.2 rad. It is the largest that 48 V
recover with every rider of 40 to 100 kg. Three stages follow each other:

- bound: the largest multiple that any control recovers in the linear model, 2 U/sqrt((B'PB)(d'Pd)), is maximised over
  machines for the worst rider. It costs a Riccati equation and needs no controller.
- rollouts: the mean of `SoftLoss` over riders and multiples, through the nonlinear closed loop, the Riccati equation of
  the LQR and the machine. Machine and weights vary together. The multiples go up to 1.4 times that of the worst rider,
  and are drawn again after every stage.
- draws: for a rider of 50 kg alone, from the best machine of the second stage (`random_designs.py`).

The ranges of the machine:

- The arm is a uniform rod, as in the paper (I2 = m2 s^2/3 about its centre, of half length s), of 5 to 40 kg. It may
  turn all the way round 0.05 m above the ground.
- Its centre hangs below the mount by 30 to 50 % of its reach (a rod; the paper's is mounted at its end), or by 1 to 3
  % (a flywheel that knows where down is).
- The mount, at which the rider sits too, is 0.4 to 1.0 m high.
- The motor has k = 0.05 to 0.2 N m/A, a rotor of 2e-4 kg m^2, and a gear of 5 to 400.
- The winding decides the power at 48 V: the paper's 3 ohm (at most 192 W), and less, with a current of at most 60 A.

    python experiments/two_wheeler/run.py codesign
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from diffabs import Batch, FixedStep, Loop
from diffabs.core.pytree import replace
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.recoverable import recoverable_bound
from diffabs.loop.run import rollout
from diffabs.output import plot
from diffabs.papers import record
from diffabs.parts.objectives import BALANCE, SoftLoss
from diffabs.robust.design import certify
from diffabs.robust.design.attraction import Reach, largest_recovered_multiples
from diffabs.robust.design.parameter_grid import grid_polytope
from diffabs.scenario.scenario import load
from diffabs.tune import Method, Stopping, build_problem, tune
from experiments.two_wheeler import random_designs
from experiments.two_wheeler.machine import CLEAR, Machine

START = np.array([0.5, 0.0, 0.2, 0.0, 0.0, 0.0])
SHARP = 40.0  # of the smooth minimum over riders
DIRECTION = {"initial.theta": START[0], "initial.phi": START[2]}
# The multiple that the paper's machine with a hanging arm recovers under its LQR: `reproduce arm-balance`.
HANGING = 0.0801


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    windings: tuple[tuple[float, float], ...] = ((3.0, 16.0), (1.0, 48.0), (0.3, 60.0), (0.1, 60.0))  # ohm, A
    tuned: tuple[tuple[int, str], ...] = ((0, "flywheel"), (2, "rod"), (2, "flywheel"), (3, "flywheel"))  # by rollouts
    voltage: float = 48.0
    riders: tuple[float, ...] = (40.0, 55.0, 70.0, 85.0, 100.0)  # kg
    designed_for: tuple[float, float] = (40.0, 120.0)  # kg, the rider of the LQR
    mount: tuple[float, float] = (0.4, 1.0)  # m
    reach: tuple[float, float] = (0.2, 1.0)  # of the way from the mount to the ground, less the clearance
    rod: tuple[float, float] = (0.3, 0.5)  # of the rod's centre below the mount, relative to the rod's reach
    flywheel: tuple[float, float] = (0.01, 0.03)
    arm_mass: tuple[float, float] = (5.0, 40.0)  # kg
    constant: tuple[float, float] = (0.05, 0.2)  # N m/A
    gear: tuple[float, float] = (5.0, 400.0)
    step: float = 2.5e-3  # s, of the rollouts that are differentiated
    duration: float = 4.0
    counted: tuple[float, ...] = (1.0, 0.01, 1.0, 1.0, 0.0, 1.0)  # of the squares in SoftLoss: the arm may still turn
    radius: float = 0.1  # of SoftLoss
    softness: float = 0.5
    multiples: int = 12  # of the start
    beyond: float = 1.4  # times what the worst rider recovers
    stages: int = 2
    iterations: int = 8  # of each
    judged_step: float = 1e-3
    judged_duration: float = 60.0  # s, at most: a run ends when it is decided
    judged_multiples: int = 60
    alone: tuple[int, str] | None = (2, "flywheel")  # which of those tuned is then improved for one rider
    draws: random_designs.Draws = dataclasses.field(default_factory=random_designs.Draws)
    out: str = "out/experiments/two_wheeler/codesign"


WEIGHTS = {"log_q": (-8.0, 12.0), "log_r": (-9.0, 4.0)}
FREE = ("mount", "reach", "offset", "arm_mass", "constant", "gear")


def bounds(config: Config, machine: Machine) -> Any:
    """Return for each rider the largest multiple that any control recovers in the linear model.

    It is the lesser of two: with a limit of the voltage only, and with one of the current only.
    """

    def largest(rider: Any) -> Any:
        plant = dataclasses.replace(machine.plant(), rider_mass=rider)
        a, b = BalanceModel(plant=plant).matrices()
        by_voltage = recoverable_bound(a, b, START, config.voltage)
        voltage = (
            machine.current * machine.resistance
        )  # the voltage that drives this current through a motor without emf
        a, b = BalanceModel(plant=dataclasses.replace(plant, back_emf=0.0 * plant.back_emf)).matrices()
        return jnp.minimum(by_voltage, recoverable_bound(a, b, START, voltage))

    return jax.vmap(largest)(jnp.asarray(config.riders))


def limits(config: Config, shape: str) -> dict[str, tuple[float, float]]:
    """Return the ranges of a machine."""
    return {name: getattr(config, shape if name == "offset" else name) for name in FREE}


def best_bound(config: Config, machine: Machine, shape: str) -> Machine:
    """The machine with the greatest bound for the worst rider: L-BFGS-B on the gradient of a smooth minimum."""
    low, high = np.log(list(limits(config, shape).values())).T

    def built(z: Any) -> Machine:
        return replace(machine, dict(zip(FREE, jnp.exp(z), strict=True)))

    @jax.jit
    @jax.value_and_grad
    def loss(z: Any) -> Any:
        return jax.nn.logsumexp(-SHARP * jnp.log(bounds(config, built(z)))) / SHARP

    start = np.clip(np.log([float(getattr(machine, name)) for name in FREE]), low, high)
    ranges = np.stack([low, high], axis=1)
    optimum = minimize(
        lambda z: [np.asarray(x, float) for x in loss(z)], start, jac=True, method="L-BFGS-B", bounds=ranges
    )
    return replace(machine, {name: float(x) for name, x in zip(FREE, np.exp(optimum.x), strict=True)})


def counted(config: Config, loop: Loop, riders: Any, top: float) -> list[Reach]:
    """Return for each rider the largest recovered multiple, of so many up to `top`, by runs."""
    multiples = np.linspace(0.0, top, config.judged_multiples + 1)[1:]
    solver = FixedStep(step=config.judged_step, duration=config.judged_duration)
    return largest_recovered_multiples(loop, {"plant.rider_mass": np.asarray(riders)}, DIRECTION, multiples, solver)


def worst_of(reaches: list[Reach]) -> float:
    """The least multiple."""
    return min(reach.multiple for reach in reaches)


def tuned(config: Config, machine: Machine, shape: str) -> Machine:
    """Machine and weights together, through nonlinear runs."""
    ranges = limits(config, shape)
    inside = {
        name: np.clip(float(getattr(machine, name)), 1.01 * low, 0.99 * high) for name, (low, high) in ranges.items()
    }
    best, bound = replace(machine, inside), float(jnp.max(bounds(config, machine)))
    worst = worst_of(counted(config, best.closed_loop(), config.riders, bound))
    machine = best
    for _ in range(config.stages):
        top = config.beyond * max(worst, 0.05 * bound)
        multiples = np.linspace(0.1, 1.0, config.multiples) * top
        riders, multiples = (x.ravel() for x in np.meshgrid(config.riders, multiples, indexing="ij"))
        over = {"plant.rider_mass": riders, "initial.theta": START[0] * multiples, "initial.phi": START[2] * multiples}
        machine = tune(
            build_problem(
                machine,
                free={**ranges, "rider": config.designed_for, **WEIGHTS},
                objective={"loss": 1.0},
                over=Batch(over),
                solver=FixedStep(step=config.step, duration=config.duration),
                measured={
                    "loss": SoftLoss(weight=np.array(config.counted), radius=config.radius, softness=config.softness)
                },
            ),
            method=Method(stopping=Stopping(iterations=config.iterations)),
        ).part
        now = worst_of(counted(config, machine.closed_loop(), config.riders, bound))
        if now > worst:
            best, worst = machine, now
    return best


def for_one(config: Config, machine: Machine, shape: str, rider: float = 50.0) -> Machine:
    """The machine and weights that recover the most with one rider, of designs drawn around this one."""
    ranges = limits(config, shape) | {"rider": config.designed_for, **WEIGHTS}
    bound = float(jnp.max(bounds(config, machine)))
    multiple = worst_of(counted(config, machine.closed_loop(), [rider], bound))
    solver = FixedStep(step=config.judged_step, duration=config.judged_duration)
    judge = random_designs.runs(lambda z: replace(machine, z).closed_loop(), rider, START, solver)
    centre = {name: np.asarray(getattr(machine, name)) for name in ranges}
    return replace(machine, random_designs.improved(config.draws, centre, ranges, judge, multiple)[0])


def motor_power(voltage: float, resistance: float, current: float) -> float:
    """Return the greatest mechanical power of the motor [W]: I (U - R I), at I = U/(2 R) or at the current's limit.

    Args:
        voltage: limit of the voltage [V].
        resistance: of the winding [ohm].
        current: limit of the current [A].
    """
    at = min(voltage / (2 * resistance), current)
    return at * (voltage - resistance * at)


def described(config: Config, machine: Machine) -> dict[str, Any]:
    """A machine's numbers, as values of a table."""
    plant = machine.plant()
    return {
        "winding [ohm]": machine.resistance,
        "current [A]": machine.current,
        "power [W]": motor_power(config.voltage, machine.resistance, machine.current),
        "mount [m]": float(machine.mount),
        "arm centre [m]": float(plant.arm_length),
        "arm [kg]": float(machine.arm_mass),
        "arm inertia [kg m^2]": float(plant.arm_inertia),
        "k [N m/A]": float(machine.constant),
        "gear": float(machine.gear),
        "bound, worst": float(jnp.min(bounds(config, machine))),
        "bound, 50 kg": float(bounds(dataclasses.replace(config, riders=(50.0,)), machine)[0]),
    }


def judged(config: Config, machine: Machine) -> dict[str, Any]:
    """Return a tuned machine's recovered multiples in nonlinear runs, and the certificate of its gain."""
    loop = machine.closed_loop()
    riders = np.array([*config.riders, 50.0])
    reaches = counted(config, loop, riders, float(jnp.max(bounds(config, machine))))
    multiples = np.array([reach.multiple for reach in reaches])
    box = {"plant.rider_mass": (min(config.riders), max(config.riders))}
    for name in ("stiffness", "damping"):
        value = float(getattr(loop.plant, name))
        box[f"plant.{name}"] = (0.7 * value, 1.3 * value)
    gain = np.asarray(loop.controller.gain)
    proof = certify(gain, grid_polytope(BalanceModel(plant=loop.plant), box, 3))
    start = {"initial.theta": START[0] * multiples.min(), "initial.phi": START[2] * multiples.min()}
    solver = FixedStep(step=config.judged_step, duration=config.judged_duration)
    heavy = replace(loop, {**start, "plant.rider_mass": riders.max()})
    run = jax.tree.map(float, rollout(heavy, solver, BALANCE).metrics)
    span = float(machine.reach * (machine.mount - CLEAR))
    return {
        "recovered by rider": dict(zip(riders.tolist(), multiples.tolist(), strict=True)),
        "undecided beyond, riders": [float(m) for m, reach in zip(riders, reaches, strict=True) if reach.undecided],
        "worst": float(multiples[:-1].min()),
        "50 kg": float(multiples[-1]),
        "times the hanging arm, 50 kg": float(multiples[-1]) / HANGING,
        "common P over the riders": {True: "yes", False: "none", None: "undecided"}[proof.quadratically_stable],
        "gain": gain.tolist(),
        "plant": {field.name: float(getattr(loop.plant, field.name)) for field in dataclasses.fields(loop.plant)},
        "peaks from the worst, 100 kg": run,
        "least clearance [m]": float(machine.mount) * float(np.cos(run["peak_lean"])) - span,
    }


def figure(results: dict[str, dict[str, Any]]) -> Any:
    """Recovered multiples over riders."""
    drawn, (ax,) = plot.sheet(title="Recovered at 48 V, one gain for every rider", size=(6.8, 4.0))
    for i, (name, row) in enumerate(results.items()):
        riders, multiples = zip(*sorted(row["recovered by rider"].items()), strict=True)
        ax.plot(riders, multiples, "o" + plot.DASHES[i], color=plot.COLOURS[i], label=name)
    ax.plot([50.0], [HANGING], "k*", markersize=11, label="the paper's machine with its arm hanging, LQR")
    plot.label_axes(ax, "rider [kg]", "multiple of (0.5, 0, 0.2) rad")
    ax.set_ylim(0, 1.6 * max(max(row["recovered by rider"].values()) for row in results.values()))
    return drawn


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    hanging = load("arm-hanging").loop
    rows, results = [], {}
    for i, (resistance, current) in enumerate(config.windings):
        for shape in ("rod", "flywheel"):
            machine = best_bound(config, Machine(loop=hanging, resistance=resistance, current=current), shape)
            rows.append({"shape": shape, "by": "bound", **described(config, machine)})
            for_fifty = dataclasses.replace(config, riders=(50.0,))
            alone = best_bound(for_fifty, Machine(loop=hanging, resistance=resistance, current=current), shape)
            rows.append({"shape": shape, "by": "bound, 50 kg", **described(config, alone)})
            if (i, shape) in config.tuned:
                machine = tuned(config, machine, shape)
                rows.append({"shape": shape, "by": "rollouts", **described(config, machine)})
                name = f"{shape}, {resistance:g} ohm, {current:g} A"
                results[name] = judged(config, machine)
                if (i, shape) == config.alone:
                    machine = for_one(config, machine, shape)
                    rows.append({"shape": shape, "by": "draws", **described(config, machine)})
                    results[f"{name}, for 50 kg"] = judged(config, machine)
    record.print_rows("Machines", rows)
    keys = ("worst", "50 kg", "undecided beyond, riders", "times the hanging arm, 50 kg", "common P over the riders")
    record.print_rows(
        "Tuned by rollouts",
        [{"machine": name, **{key: result[key] for key in keys}} for name, result in results.items()],
    )
    return record.experiment(config, {"machines": rows, "tuned": results}, {"codesign": figure(results)})
