"""Random scenarios of all parts with random overrides: each is refused in one line, or runs to numbers that can be.

    python tests/support/fuzz_scenarios.py --count 20000 --seed 0

Scenario i of a seed is always the same. They come in groups of one structure, which is compiled once; within a group
values change: mostly to ones that can be, now and then to ends of ranges, nonsense, or what is no value at all. What is
accepted runs for some hundred steps. A finding is a traceback, a refusal of more than a line, a scenario that is
another one after it was written and read, or a metric that is not finite or out of its physical range although the
run's flags say nothing. Exit status 1 if there is one. Not collected by pytest; `test_fuzz.py` runs a few."""

import argparse
import dataclasses
import math
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.protocols import BrakeOutput
from diffabs.core.pytree import elements, get
from diffabs.engine.solvers import FixedStep
from diffabs.loop.result import Run
from diffabs.loop.run import measure
from diffabs.loop.stability import stable_step
from diffabs.scenario import registry, toml
from diffabs.scenario.scenario import Scenario, ScenarioError, dump, loads

PER_STRUCTURE = 200
STEPS = 300
CANDIDATES = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5)  # steps [s] of which every default period is a multiple
LANES = 64  # that run together
BRAKES = {
    "plant": ("quarter-car", "mirrored-rig", "lab-rig"),
    "sensor": ("direct", "noise", "bias", "quantisation", "integrated-accelerometer", "wheel-speed", "series"),
    "reference": ("fixed-slip", "filtered-slip", "peak-latch", "peak-literal", "peak-robust"),
    "feedforward": ("no-feedforward", "constant-input", "holding-input"),
    "controller": ("pid", "state-feedback", "proportional-feedback", "scheduled-feedback", "constant-torque", "relay")
    + ("sliding-mode", "sampled"),
    "actuator": ("direct", "lag", "limits", "rate-limit", "delay", "series"),
    "stop": ("speed-reached", "standstill"),
}
BALANCES = {
    "plant": ("arm-balance", "acrobot", "printed-arm"),
    "sensor": ("direct", "angle-sensor"),
    "reference": ("upright",),
    "feedforward": ("no-feedforward",),
    "controller": ("balance-feedback", "observer-feedback", "sampled"),
    "actuator": ("direct", "voltage-limit", "lag", "delay", "series"),
    "stop": ("fallen",),
}
OF_BLOCKS = {"sensor": ("noise", "bias", "wheel-speed", "quantisation"), "actuator": ("lag", "delay", "rate-limit")}
EXTRA = {"braking": ("itae", "effort", "variation", "torque-rate"), "balance": ("balance-cost", "soft-loss")}
EDGES = ("0", "-1", "1e-300", "1e300", "-1e300", "nan", "inf", "-inf", "1", "1e-9", "1e9")
NONSENSE = (
    "true",
    "'5.3'",
    "[1.0, 2.0]",
    "[]",
    "{}",
    "1979-05-27",
    "[[1.0]]",
    "{type='pid'}",
    "=",
    "'",
    "\\",
    "0x1p3",
    "",
)
STRANGE = (
    "nothing=1",
    "plant.nothing=1",
    "plant=nothing",
    "road=pid",
    "=",
    "a.b.c",
    "solver.step=0",
    "solver.every=-1",
)
STRANGE += ("solver.duration=-1", "stop.speed=1e9", "initial.speed=0", "plant.mass.0=1", "controller.gain.7=1", "[")
LEAST = {  # what a metric of a run that ended well cannot be less than; all are finite
    name: 0.0
    for name in ("stop_time", "stop_distance", "overshoot", "settling_time", "iae", "locked_time", "final_slip_error")
    + ("itae", "effort", "variation", "torque-rate", "fell", "peak_lean", "peak_arm_angle", "peak_voltage")
    + ("peak_torque", "final_norm", "balance-cost", "soft-loss")
} | {"max_slip": -1.0}
MOST = {"max_slip": 1.0, "fell": 1.0, "soft-loss": 1.0}
ROUNDING = 1e-9
SHOWN = 20  # findings, as they come


@dataclasses.dataclass
class Tally:
    """What came of the scenarios; each finding with all that is needed to see it again."""

    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    refusals: Counter[str] = dataclasses.field(default_factory=Counter)
    findings: list[str] = dataclasses.field(default_factory=list)

    def found(self, what: str, text: str, changes: Sequence[str]) -> None:
        """A finding."""
        lines = text.strip().replace("\n", "\n    ")
        self.findings.append(f"{what}\n    overrides: {list(changes)}\n    {lines}")
        if len(self.findings) <= SHOWN:
            print(f"\nFOUND: {self.findings[-1]}\n", flush=True)


def structure(rng: np.random.Generator) -> tuple[str, Scenario]:
    """Some parts that suit one another, as text, and the scenario that they make; mostly with a step that is stable."""
    family = BALANCES if rng.random() < 0.2 else BRAKES
    sections = {name: {"type": str(rng.choice(there))} for name, there in family.items()}
    if family is BRAKES:
        sections["road"] = {"type": str(rng.choice(list(registry.family_types("road"))))}
    if sections["controller"]["type"] == "sampled":
        inner = [name for name in family["controller"] if name != "sampled"]
        sections["controller"]["controller"] = {"type": str(rng.choice(inner))}
    for name, there in OF_BLOCKS.items():
        if sections[name]["type"] == "series":
            chosen = rng.choice(there[:2] if family is BALANCES else there, rng.integers(1, 3), replace=False)
            sections[name]["blocks"] = [{"type": str(one)} for one in chosen]
    extra = EXTRA["balance" if family is BALANCES else "braking"]
    sections["objective"] = {
        str(name): {"type": str(name)} for name in rng.choice(extra, rng.integers(0, 3), replace=False)
    }
    first = loads(toml.write_toml({}, sections).encode(), "fuzz", "fuzz.toml", integrated=False)
    most = stable_step(first.loop) / (1.5 if rng.random() < 0.95 else 0.7)
    step = next((step for step in CANDIDATES if step <= most), CANDIDATES[-1])
    sections["solver"] = {"step": step, "duration": STEPS * step}
    base = loads(toml.write_toml({}, sections).encode(), "fuzz", "fuzz.toml", integrated=False)
    return dump(base), base  # with every field written, so that single numbers of lists can be changed


def overrides(rng: np.random.Generator, base: Scenario) -> list[str]:
    """Some numbers of a scenario changed; in one of ten, something that is not meant to be."""
    specs = elements(base.loop)
    paths = [path for path in specs if rng.random() < 0.25]
    changes = [f"{_written(path)}={_value(rng, base, path, specs[path])}" for path in paths]
    if rng.random() < 0.1 and specs:
        path = str(rng.choice(list(specs)))
        wild = rng.choice(EDGES if rng.random() < 0.6 else NONSENSE)
        changes.append(f"{_written(path)}={wild}")
    if rng.random() < 0.04:
        changes.append(str(rng.choice(STRANGE)))
    return changes


def _written(path: str) -> str:
    return path.removeprefix("plant.") if path.startswith("plant.road.") else path


def _value(rng: np.random.Generator, base: Scenario, path: str, spec: Any) -> str:
    """Near the default, in the parameter's range; a time on the grid where the default is."""
    value = float(get(base.loop, path))
    if path.rpartition(".")[2] in ("period", "time"):
        return f"{base.solver.step * int(rng.integers(1, 12))!r}"
    if path in ("initial.slip",):
        return f"{rng.uniform(0, 0.3)!r}"
    new = value * float(np.exp(rng.normal(0.0, 0.3))) if math.isfinite(value) and value else value
    if value == 0.0:
        new = float(rng.normal(0.0, 0.05))
    if not math.isfinite(new):
        new = float(rng.uniform(50, 500)) * (1 if value > 0 else -1)
    low, high = max(spec.low, -1e12), min(spec.high, 1e12)
    return f"{float(np.clip(new, low, high))!r}"


def loaded(text: str, changes: Sequence[str], tally: Tally, again: bool) -> Scenario | None:
    """The scenario, if it is accepted."""
    try:
        scenario = loads(text.encode(), "fuzz", "fuzz.toml", changes)
    except ScenarioError as error:
        tally.counts["refused"] += 1
        tally.refusals[_kind(str(error))] += 1
        if "\n" in str(error) or not str(error).strip():
            tally.found(f"refused in more or less than a line: {error!r}", text, changes)
        return None
    except Exception:
        tally.counts["crashed"] += 1
        tally.found(traceback.format_exc(limit=-6), text, changes)
        return None
    tally.counts["accepted"] += 1
    if again:
        written = dump(scenario)
        if dump(loads(written.encode(), "fuzz", "fuzz.toml", integrated=False)) != written:
            tally.found("another scenario after it was written and read", text, changes)
    return scenario


def _kind(line: str) -> str:
    """A refusal without its names and numbers."""
    kinds = (
        "not stable",
        "is outside",
        "exceeds",
        "not above",
        "multiple of",
        "is not a field",
        "did you mean",
        "needed",
    )
    return next((kind for kind in kinds if kind in line), "other")


@partial(jax.jit, static_argnums=(3, 4), compiler_options={"xla_backend_optimization_level": 0})
def _measured(loops: Any, objectives: Any, seeds: Any, step: float, duration: float) -> Any:
    def one(loop: Any, seed: Any) -> Any:
        run = measure(loop, FixedStep(step, duration), objectives, key=jax.random.key(seed))
        return run, loop.start().plant

    return jax.vmap(one)(loops, seeds)[0]


def judged(scenarios: Sequence[tuple[Scenario, list[str]]], text: str, tally: Tally) -> None:
    """Run all of one structure, together where step and objectives agree, and look at what they show."""
    groups: dict[Any, list[tuple[Scenario, list[str]]]] = {}
    for scenario, changes in scenarios:
        shapes = tuple(np.shape(x) for x in jax.tree.leaves(scenario.loop))
        key = (jax.tree.structure((scenario.loop, dict(scenario.objectives))), shapes, scenario.solver.step)
        groups.setdefault((key, scenario.solver.duration), []).append((scenario, changes))
    for members in groups.values():
        if members[0][0].solver.steps > 10 * STEPS:
            tally.counts["too long to run here"] += len(members)
            continue
        for start in range(0, len(members), LANES):
            lanes = members[start : start + LANES]
            try:
                run = _together([scenario for scenario, _ in lanes])
            except Exception:
                tally.found(traceback.format_exc(limit=-6), text, lanes[0][1])
                continue
            for i, (scenario, changes) in enumerate(lanes):
                _look(scenario, jax.tree.map(lambda x, i=i: x[i], run), text, changes, tally)


def _together(scenarios: Sequence[Scenario]) -> Run:
    padded = [scenarios[i % len(scenarios)] for i in range(LANES)]
    first = padded[0]
    loops = jax.tree.map(lambda *x: jnp.asarray(np.stack(x), float), *[one.loop for one in padded])
    objectives = jax.tree.map(lambda x: jnp.asarray(x, float), dict(first.objectives))
    seeds = jnp.arange(LANES)
    return jax.device_get(_measured(loops, objectives, seeds, first.solver.step, first.solver.duration))


def _look(scenario: Scenario, run: Run, text: str, changes: Sequence[str], tally: Tally) -> None:
    flags = [name for name in ("diverged", "stopped") if getattr(run, name)]
    tally.counts["diverged" if run.diverged else "ran"] += 1
    if run.diverged:
        return
    for line in wrong(scenario, run):
        tally.counts["impossible"] += 1
        tally.found(f"{line} (flags: {', '.join(flags) or 'none'})", text, changes)


def wrong(scenario: Scenario, run: Run) -> Iterator[str]:
    """What cannot be of a run that did not diverge."""
    for name, value in run.metrics.items():
        value = float(value)
        size = ROUNDING * (1 + abs(value))
        unreached = getattr(scenario.objectives.get(name), "unreached", None)
        if value == unreached or (unreached is not None and math.isnan(unreached) and math.isnan(value)):
            continue  # the run ended before the event that the objective measures, or has no step
        if not math.isfinite(value):
            yield f"{name} = {value} is not finite"
        elif value < LEAST.get(name, -math.inf) - size or value > MOST.get(name, math.inf) + size:
            yield f"{name} = {value:g} cannot be"
    output = run.ending.sample.output
    braking = scenario.loop.plant.shows is BrakeOutput and not drives(scenario.loop)
    if braking and not output.speed <= scenario.loop.initial.speed * (1 + 1e-6):
        yield f"speed = {float(output.speed):g} m/s at the end, from {scenario.loop.initial.speed:g}: it rose"


def drives(loop: Any) -> bool:
    """Whether a negative torque, which speeds the wheel up, is allowed."""
    ends = ("torque", "low", "value")
    return any(path.rpartition(".")[2] in ends and get(loop, path) < 0 for path in elements(loop))


def fuzz(count: int, seed: int, per_structure: int = PER_STRUCTURE, told: Any = None) -> Tally:
    """So many scenarios, judged."""
    tally = Tally()
    for group in range(-(-count // per_structure)):
        rng = np.random.default_rng([seed, group])
        text, base = structure(rng)
        accepted = []
        for i in range(min(per_structure, count - group * per_structure)):
            changes = overrides(rng, base)
            scenario = loaded(text, changes, tally, again=i % 20 == 0)
            if scenario:
                accepted.append((scenario, changes))
        judged(accepted, text, tally)
        if told:
            told(group, tally)
    return tally


def main() -> int:
    """Says how far it is after each structure, and what was found at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--per-structure", type=int, default=PER_STRUCTURE)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    begun = time.monotonic()

    def told(group: int, tally: Tally) -> None:
        counts = ", ".join(f"{name} {n}" for name, n in sorted(tally.counts.items()))
        print(
            f"structure {group}, {time.monotonic() - begun:.0f} s: {counts}; findings {len(tally.findings)}", flush=True
        )

    tally = fuzz(asked.count, asked.seed, asked.per_structure, told)
    print(f"\nrefused for: {dict(tally.refusals)}")
    print(f"{len(tally.findings)} findings in {asked.count} scenarios of seed {asked.seed}: {dict(tally.counts)}")
    return min(len(tally.findings), 1)


if __name__ == "__main__":
    sys.exit(main())
