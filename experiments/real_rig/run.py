"""Is the overshoot cured on the rig as it really is, with every error at once?

`box.py` fixed the unknowns beforehand. Gradients over thousands of lanes tune estimator, reference and controller
together (`tune.py`). Beside them stand other controllers (`others.py`), the floor that no gain undercuts (`floor.py`),
and proofs (`proof.py`). `judge.py` judges at weak spots, in all corners and on 100,000 points.

    python experiments/real_rig/run.py
    python experiments/real_rig/run.py again     # the committed controllers, without the tuning
"""

import dataclasses
import pathlib
import re
import time
from typing import Any

import numpy as np

from diffabs import Loop
from diffabs.papers import record
from diffabs.tune import Tuned
from experiments._shared.entry import run_part, with_times
from experiments._shared.numbers import store_parts
from experiments.real_rig import again
from experiments.real_rig.box import ESTIMATED, KNOWN, Box, Fixed
from experiments.real_rig.document import document
from experiments.real_rig.figures import degradation, descents, distributions, map_figure, traces
from experiments.real_rig.judge import Judging, in_corners, on_samples, seconds, weak_spots
from experiments.real_rig.loops import loop, quantised
from experiments.real_rig.others import Others, Score, cma_es, contenders, designs, proportional_integral
from experiments.real_rig.proof import Proving, proofs
from experiments.real_rig.tune import ONE_SIDED, TWO_SIDED, Tuning, start, tuned

BEFORE = "before tuning"
DRAWN = ("published gain", "first cure", "PI, Nelder-Mead", "PI, CMA-ES", "sliding mode, CMA-ES", BEFORE, "tuned, CVaR")
STAGES = {"CVaR": "tuned, CVaR", "smooth worst": "tuned, smooth worst", "both sides": "tuned, both sides"}
TUNED = STAGES["CVaR"]


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    fixed: Fixed = dataclasses.field(default_factory=Fixed)
    box: Box = dataclasses.field(default_factory=Box)
    tuning: Tuning = dataclasses.field(default_factory=Tuning)
    judging: Judging = dataclasses.field(default_factory=Judging)
    others: Others = dataclasses.field(default_factory=Others)
    proving: Proving = dataclasses.field(default_factory=Proving)
    price: float = 4.0  # runs that a gradient counts as; about 3 were measured, by a kernel, of 5 to 7 parameters
    map_points: int = 25  # along each side of a map
    drawn: int = 20_000  # points of the figure of distributions
    out: str = "out/experiments/real_rig"


def cost(config: Config, stages: dict[str, Tuned], last: str) -> int:
    """Runs that a tuning took: of the starts, of CVaR, and of the stage that went on from there."""
    t = config.tuning
    lanes = {"starts": t.few} | dict.fromkeys(STAGES, t.lanes)
    took = {
        name: lanes[name] * sum(descent.history[-1].evaluations for descent in stages[name].starts) for name in stages
    }
    return int(config.price * sum(took[name] for name in {"starts", "CVaR", last}))


def scored(config: Config, speed: str, weights: Any = ONE_SIDED) -> Score:
    """The objective of the tuning, as others search it."""
    return Score(config.others, config.box, config.fixed, speed, weights, config.judging)


def compared(
    config: Config, speed: str, robust: dict[str, Any], stages: dict[str, Tuned], report: Any
) -> dict[str, tuple[Loop, int]]:
    """Return all loops of one kind of speed by name, with the runs behind each. All have the same estimated speed."""
    best: Any = stages["CVaR"].loop
    estimator = None if speed == KNOWN else best.sensor.blocks[-1]
    rivals = contenders(config.others, config.fixed, speed, robust, estimator, scored(config, speed), report)
    if "both sides" in stages:
        score = scored(config, speed, TWO_SIDED)
        pi, free = proportional_integral(config.others)
        rivals["PI, CMA-ES, both sides"] = (
            cma_es(score, loop(config.fixed, pi, speed), free, config.others),
            score.rollouts,
        )
        report("PI, CMA-ES, both sides")
    ours = {
        name: (stages[stage].loop, cost(config, stages, stage)) for stage, name in STAGES.items() if stage in stages
    }
    ours = {BEFORE: (start(config.tuning, config.fixed, speed), 0)} | ours
    return rivals | {name: (quantised(loop, config.fixed), runs) for name, (loop, runs) in ours.items()}


def judged(config: Config, speed: str, name: str, loop: Loop) -> dict[str, Any]:
    """Weak spots, corners, points of the box."""
    samples = config.judging.samples if name in STAGES.values() else config.judging.fewer
    return {
        "weak spots: overshoot [%]": weak_spots(loop, speed, config.judging),
        "corners": in_corners(loop, config.box, config.fixed, speed, config.judging),
        "box": on_samples(loop, config.box, config.fixed, speed, config.judging, samples),
    }


def printed(speed: str, results: dict[str, dict[str, Any]]) -> None:
    """The table, in two: weak spots, and the rest."""
    record.print_rows(
        f"Speed {speed}: worst overshoot [%] where one thing is wrong",
        [{"controller": name, **result["weak spots: overshoot [%]"]} for name, result in results.items()],
    )
    record.print_rows(
        f"Speed {speed}: the box", [{"controller": name, **row(result)} for name, result in results.items()]
    )


def row(result: dict[str, Any]) -> dict[str, Any]:
    """Return a line of the table."""

    def interval(name: str) -> str:
        p = result["box"][name]
        return f"{p['percent']:.4g} ({p['low']:.3g}-{p['high']:.3g})"

    box, proof = result["box"], result["proof"]
    truth = box.get("against the true speed", {"median": 0.0, "95 %": 0.0})
    rate = proof.get("decay [1/s]")
    return {
        "objective": f"{result['objective']:.4f}",
        "of both sides": f"{result['objective, both sides']:.4f}",
        "worst corner [%]": f"{result['corners']['overshoot [%]']:.1f}",
        "P(> 1 %) [%]": interval("overshoot > 1 %"),
        "P(> 5 %) [%]": interval("overshoot > 5 %"),
        "P(locks) [%]": interval("locks"),
        "do not stop": box["does not stop"]["count"],
        "within 1.5 floors [%]": f"{box['within 1.5 floors of the box']['percent']:.2f}",
        "overshoot median, 95 %": f"{box['overshoot [%]']['median']:.1f}, {box['overshoot [%]']['95 %']:.1f}",
        "above floor 95 %": f"{box['above the floor [%]']['95 %']:.1f}",
        "settled median, 95 % [s]": f"{seconds(box['settling [s]']['median'])}, {seconds(box['settling [s]']['95 %'])}",
        "lost median [%]": f"{box['distance lost [%]']['median']:.2f}",
        "longer than with the true speed, median, 95 % [%]": f"{truth['median']:.2f}, {truth['95 %']:.2f}",
        "certificate": proof["said"] + ("" if rate is None else f", {rate:.2g} /s"),
        "runs to find": result["runs to find"],
    }


def of_speed(
    config: Config, speed: str, robust: dict[str, Any], report: Any
) -> tuple[dict[str, Tuned], dict[str, Loop], dict[str, Any]]:
    """Tune, compare, judge, prove. Returns the stages of the tuning, the loops, and the results of each."""
    stages = tuned(config.tuning, config.box, config.fixed, speed, report)
    those = compared(config, speed, robust, stages, lambda name: report(f"{speed}, found: {name}"))
    loops = {name: loop for name, (loop, _) in those.items()}
    proved = proofs(config.proving, config.box, config.fixed, loops)
    report(f"{speed}, proofs")
    results, score, both = {}, scored(config, speed), scored(config, speed, TWO_SIDED)
    for name, (contender, runs) in those.items():
        search = {
            "objective": score(contender),
            "objective, both sides": both(contender),
            "proof": proved[name],
            "runs to find": runs,
        }
        results[name] = {**judged(config, speed, name, contender), **search}
        report(f"{speed}, judged: {name}")
    return stages, loops, results


def main(config: Config | None = None, progress: Any = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config, begun = config or Config(), time.perf_counter()
    told = progress or (lambda line: None)
    folder, figures, results, stages = pathlib.Path(config.out), {}, {}, {}
    robust = designs(config.others, config.box, config.fixed)
    told("robust designs")
    for speed in (KNOWN, ESTIMATED):
        stages[speed], loops, rows = of_speed(config, speed, robust, told)
        printed(speed, rows)
        maps = degradation(loops[TUNED], speed, config.judging, config.map_points)
        shown = {name: loop for name, loop in loops.items() if name in DRAWN}
        figures[f"maps-{speed}"] = map_figure(maps, speed, config.box)
        figures[f"overshoot-{speed}"] = distributions(
            shown, speed, config.box, config.fixed, config.judging, config.drawn
        )
        figures[f"traces-{speed}"] = traces(shown, speed)
        told(f"{speed}, figures")
        results[speed] = {"controllers": rows, "beyond the box": maps, "tuning": described(stages[speed])}
        (folder / "controllers").mkdir(parents=True, exist_ok=True)
        for name, contender in loops.items():
            record.write_summary(folder / "controllers", document(contender), name=f"{speed}-{file_name(name)}.json")
    figures["tuning"] = descents(stages)
    told(f"{time.perf_counter() - begun:.0f} s")
    return record.experiment(config, results | {"seconds": time.perf_counter() - begun}, figures)


def file_name(name: str) -> str:
    """Of a controller: "LMI, best of 12" is lmi-best-of-12."""
    return "-".join(re.findall(r"[a-z0-9]+", name.lower()))


def described(stages: dict[str, Tuned]) -> dict[str, Any]:
    """Return the results of the descents."""
    return {
        name: {
            "objective": list(tuning.objective),
            "values": {path: np.asarray(value).tolist() for path, value in tuning.values.items()},
            "starts": [{"objective": descent.objective, "reason": descent.reason.value} for descent in tuning.starts],
            "gradients": sum(descent.history[-1].evaluations for descent in tuning.starts),
        }
        for name, tuning in stages.items()
    }


if __name__ == "__main__":
    report = with_times()
    parts = {"tune": lambda: main(progress=report), "again": lambda: again.main(progress=report)}
    run_part(store_parts(__file__, parts))
