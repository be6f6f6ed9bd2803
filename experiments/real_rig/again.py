"""Judge and prove the controllers in `controllers/` again, without the tuning.

python experiments/real_rig/run.py again
"""

import dataclasses
import json
import pathlib
from typing import Any

from diffabs import Loop, replace
from diffabs.papers import record
from experiments.real_rig.box import ESTIMATED, KNOWN, Box, Fixed
from experiments.real_rig.document import loop_of
from experiments.real_rig.judge import Judging, chance, drawn, in_corners, on_samples, runs, seconds
from experiments.real_rig.proof import Proving, proofs

RAREST = 1e-200  # m/s^2: an estimator with this `rest` never begins anew


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    box: Box = dataclasses.field(default_factory=Box)
    fixed: Fixed = dataclasses.field(default_factory=Fixed)
    judging: Judging = dataclasses.field(default_factory=Judging)
    proving: Proving = dataclasses.field(default_factory=Proving)
    folder: str = str(pathlib.Path(__file__).parent / "controllers")
    only: str = ""  # controllers whose file names contain this
    out: str = "out/experiments/real_rig/again"


def loops(config: Config, speed: str) -> dict[str, Loop]:
    """Return the committed loops of one kind of speed, by the name of their file."""
    files = sorted(pathlib.Path(config.folder).glob(f"{speed}-*.json"))
    those = {path.stem.removeprefix(f"{speed}-"): path for path in files if config.only in path.stem}
    return {name: loop_of(json.loads(path.read_text())) for name, path in those.items()}


def near_corner(config: Config, speed: str, corner: dict[str, float]) -> dict[str, Any]:
    """Return points of the box, each coordinate within a fifth of its range from a corner's."""
    points = drawn(config.box, speed, config.judging.fewer, config.judging.seed + 4)
    return {name: corner[name] + 0.2 * (x - corner[name]) for name, x in points.items()}


def judged(config: Config, speed: str, name: str, loop: Loop) -> dict[str, Any]:
    """Return the judgement of a loop on corners and points of the box, and of a tuned estimator that never restarts."""
    tuned = name.startswith("tuned")
    samples = config.judging.samples if tuned else config.judging.fewer
    results = {
        "corners": in_corners(loop, config.box, config.fixed, speed, config.judging),
        "box": on_samples(loop, config.box, config.fixed, speed, config.judging, samples),
    }
    if name == "tuned-cvar" and speed == ESTIMATED:
        points = drawn(config.box, speed, samples, config.judging.seed)
        never = runs(replace(loop, {"sensor.blocks.4.rest": RAREST}), points, config.judging, config.judging.seed)
        near = runs(loop, near_corner(config, speed, results["corners"]["at"]), config.judging, config.judging.seed + 4)
        results["near the worst corner, overshoot [%]"] = 100 * float(near["overshoot"].max())
        results["without rest, does not stop"] = chance(~never["stopped"], config.judging.confidence)
    return results


def row(result: dict[str, Any]) -> dict[str, Any]:
    """Return a line of the table: percentages, and times in s."""
    box, proof = result["box"], result["proof"]
    rate, settling, deviation = proof.get("decay [1/s]"), box["settling [s]"], box["deviation above the floor [%]"]
    return {
        "meets": "yes" if box["meets the requirement"] else "no",
        "deviation near the floor": f"{box['deviation near the floor']['percent']:.1f}",
        "above it, median, 95 %": f"{deviation['median']:.1f}, {deviation['95 %']:.1f}",
        "overshoot: worst corner, worst point": f"{result['corners']['overshoot [%]']:.1f}, "
        f"{box['overshoot [%]']['greatest']:.1f}",
        "near the worst corner": result.get("near the worst corner, overshoot [%]", ""),
        "locks, not stopped": f"{box['locks']['count']}, {box['does not stop']['count']}",
        "not stopped without rest": result.get("without rest, does not stop", {}).get("count", ""),
        "settled within 0.25 s": f"{box['settled within 0.25 s']['percent']:.1f}",
        "settled, median, 95 %": f"{seconds(settling['median'])}, {seconds(settling['95 %'])}",
        "certificate": proof["said"] + ("" if rate is None else f", {rate:.3g} /s"),
        "pole": f"{proof.get('largest frozen |pole| of a machine', float('nan')):.5f}",
        "samples": box["samples"],
    }


def main(config: Config | None = None, progress: Any = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config, told, results = config or Config(), progress or (lambda line: None), {}
    for speed in (KNOWN, ESTIMATED):
        those = loops(config, speed)
        proved = proofs(config.proving, config.box, config.fixed, those)
        told(f"{speed}, proofs")
        results[speed] = {}
        for name, loop in those.items():
            results[speed][name] = judged(config, speed, name, loop) | {"proof": proved[name]}
            told(f"{name}: {row(results[speed][name])}")
        record.print_rows(
            f"Speed {speed}", [{"controller": name, **row(result)} for name, result in results[speed].items()]
        )
    return record.experiment(config, results, {})
