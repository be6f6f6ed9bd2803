"""An adversary chooses road, noise and start, 124 numbers, against each controller of the rig.

`bounds.py` fixed the set before the first search. Gradients, CMA-ES, random points and corners look for the worst point
at equal cost (`search.py`, `ascent.py`). Shorter steps and SciPy check the worst runs (`check.py`). Then the tuned
controller is tuned against the adversary (`minmax.py`).

    OPENBLAS_NUM_THREADS=1 python experiments/adversary/run.py

One thread of BLAS suffices for matrices of 124 rows. With more threads CMA-ES takes ten times as long.
"""

import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from diffabs.papers import record
from experiments._shared.entry import with_times
from experiments._shared.numbers import SEARCH_TOLERANCE, store_numbers
from experiments.adversary.attack import Attack, Running
from experiments.adversary.bounds import Bounds, nominal, parameters
from experiments.adversary.check import against_differences, by_block, elsewhere, with_shorter_steps
from experiments.adversary.figures import cost_figure, road_figure
from experiments.adversary.loops import TUNED, contenders
from experiments.adversary.minmax import Rounds, hardened, judged
from experiments.adversary.search import SEARCHES, Log, Searching
from experiments.real_rig.box import Fixed

GRADIENTS, CMA = "gradients", "CMA-ES"
NEAR = 0.95  # of the greatest excess that anybody found


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    fixed: Fixed = dataclasses.field(default_factory=Fixed)
    bounds: Bounds = dataclasses.field(default_factory=Bounds)
    running: Running = dataclasses.field(default_factory=Running)
    searching: Searching = dataclasses.field(default_factory=Searching)
    rounds: Rounds = dataclasses.field(default_factory=Rounds)
    controllers: tuple[str, ...] = ()  # all, where none is named
    finer: Bounds = dataclasses.field(default_factory=lambda: Bounds(factors=286, spacing=0.1, noises=640))  # 928
    finer_budget: int = 2000  # runs; 0 leaves it out
    marks: tuple[int, ...] = (500, 1000, 2000, 5000)  # costs at which the searches are compared
    drawn: tuple[str, ...] = ("first cure", TUNED)  # whose roads are drawn
    out: str = "out/experiments/adversary"


def searched(attack: Attack, config: Config, report: Callable[[str], None]) -> tuple[float, dict[str, Log]]:
    """Return the price of a gradient and the log of each search."""
    price = config.searching.priced(attack)
    report(f"a gradient costs {price:.1f} runs")
    logs = {}
    for name, search in SEARCHES.items():
        logs[name] = search(attack, config.searching, price)
        report(f"{name}: overshoot [%] {np.round(100 * logs[name].overshoots, 3).tolist()}")
    return price, logs


def worst_of(logs: dict[str, Log], name: str) -> np.ndarray:
    """The worst point of a search (1, size)."""
    log = logs[name]
    return log.points[[int(log.overshoots.argmax())]]


def excesses(config: Config, logs: dict[str, Log], at_rest: float) -> list[dict[str, Any]]:
    """Return the excess [%] of each search at each cost, and the cost at which it comes near the greatest excess.

    The excess is a median, least and greatest over the seeds.
    """
    greatest = max(log.overshoots.max() for log in logs.values())
    near, rows = at_rest + NEAR * (greatest - at_rest), []
    for name, log in logs.items():
        row: dict[str, Any] = {"search": name}
        for mark in config.marks:
            excess = 100 * (log.at(mark) - at_rest)
            row[f"{mark} runs"] = f"{np.median(excess):.2f} ({excess.min():.2f}-{excess.max():.2f})"
        cost = log.cost_of(near)
        row["runs to 95 %, median"] = _whole(float(np.median(cost)))
        row["seeds there"] = int(np.isfinite(cost).sum())
        rows.append(row)
    return rows


def _whole(cost: float) -> str:
    return f"{cost:.0f}" if np.isfinite(cost) else "more"


def _curve(log: Log, at_rest: float) -> list[list[float]]:
    """Return the costs at which the excess [%] of a seed changes, and the excesses."""
    rows = [[spent, *(100 * (overshoots - at_rest)).tolist()] for spent, overshoots in log.history]
    return [row for i, row in enumerate(rows) if not i or row[1:] != rows[i - 1][1:]]


def ratios(config: Config, logs: dict[str, Log], at_rest: float) -> dict[str, float]:
    """Median excess of gradients over that of CMA-ES at each cost."""
    by = {name: [float(np.median(logs[name].at(mark))) - at_rest for mark in config.marks] for name in (GRADIENTS, CMA)}
    return {f"{mark} runs": a / b for mark, a, b in zip(config.marks, by[GRADIENTS], by[CMA], strict=True)}


def checked(attack: Attack, config: Config, z: np.ndarray) -> dict[str, Any]:
    """Return checks of the worst points: other steps, another program, and the gradient beside differences."""
    run = attack.runs(z)
    entries = np.array([0, 1, 2, *range(config.bounds.factors, config.bounds.factors + 6), config.bounds.size - 2])
    start = parameters(config.bounds, z)
    return {
        "flagged": bool(run.diverged[0] or run.timed_out[0] or not run.stopped[0]),
        "locked [s]": float(run.metrics["locked"][0]),
        "mass [kg]": float(start["plant.mass"][0]),
        "speed [km/h]": 3.6 * float(start["initial.speed"][0]),
        "excess of its parts [%]": by_block(attack, z),
        "shorter steps": with_shorter_steps(attack, z),
        "gradient": against_differences(attack, 0.9 * z, entries),
    }


def against(name: str, attack: Attack, config: Config, report: Callable[[str], None]) -> tuple[dict[str, Log], Any]:
    """Return everything about one controller."""
    at_rest = float(attack.overshoots(nominal(config.bounds))[0])
    price, logs = searched(attack, config, lambda line: report(f"{name}, {line}"))
    rows, z = excesses(config, logs, at_rest), worst_of(logs, GRADIENTS)
    record.print_rows(f"{name}: nominal overshoot {100 * at_rest:.2f} %, excess [%] at equal cost", rows)
    return logs, {
        "nominal overshoot [%]": 100 * at_rest,
        "price of a gradient": price,
        "excess": rows,
        "curves [%]": {search: _curve(log, at_rest) for search, log in logs.items()},
        "gradients over CMA-ES": ratios(config, logs, at_rest),
        "worst found": checked(attack, config, z),
        "point": {path: np.asarray(value)[0].tolist() for path, value in parameters(config.bounds, z).items()},
    }


def in_more_dimensions(config: Config, report: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return gradients and CMA-ES against the tuned controller with many more numbers of road and noise.

    Nothing of this was fixed beforehand. A kernel does not take so many numbers that differ between lanes, so XLA makes
    the runs.
    """
    bounds, searching = config.finer, dataclasses.replace(config.searching, budget=config.finer_budget)
    running = dataclasses.replace(config.running, engine="xla")
    attack = Attack(contenders(bounds, config.fixed)[TUNED], bounds, running)
    at_rest, price = float(attack.overshoots(nominal(bounds))[0]), searching.priced(attack)
    logs = {name: SEARCHES[name](attack, searching, price) for name in (GRADIENTS, CMA)}
    marks = tuple(mark for mark in config.marks if mark <= config.finer_budget)
    rows = excesses(dataclasses.replace(config, marks=marks), logs, at_rest)
    record.print_rows(f"{TUNED}, {bounds.size} numbers, a gradient {price:.1f} runs: excess [%]", rows)
    report(f"{bounds.size} numbers")
    return [{"numbers": bounds.size, "price of a gradient": price, **row} for row in rows]


def tuned_against(attack: Attack, config: Config, price: float, report: Callable[[str], None]) -> dict[str, Any]:
    """Return the rounds, and how each loop fares against fresh adversaries."""
    loops, _ = hardened(attack, config.rounds, config.searching, price, report)
    rows = []
    for number, loop in enumerate(loops):
        fares = judged(dataclasses.replace(attack, loop=loop), config.rounds, config.searching, price)
        rows.append({"rounds": number, **fares})
        report(f"after {number} rounds: fresh adversaries {fares['fresh adversaries, median [%]']:.2f} %")
    record.print_rows("Tuned against the adversary", rows)
    last: Any = loops[-1]
    c, r = last.controller.controller, last.reference
    values = {"gain": np.asarray(c.gain).tolist(), "tracking_time": float(c.antiwindup.tracking_time)}
    return {"table": rows, "found": values | {"rate": float(r.rate), "time_constant": float(r.time_constant)}}


def main(config: Config | None = None, progress: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config, told, begun = config or Config(), progress or (lambda line: None), time.process_time()
    those = contenders(config.bounds, config.fixed)
    names = config.controllers or tuple(those)
    attacks = {name: Attack(those[name], config.bounds, config.running) for name in names}
    logs_by_loop, results = {}, {}
    for name, attack in attacks.items():
        logs_by_loop[name], results[name] = against(name, attack, config, told)
    worst = {name: worst_of(logs, GRADIENTS) for name, logs in logs_by_loop.items()}
    scipy = {
        name: {
            "here [%]": results[name]["worst found"]["shorter steps"]["overshoot [%]"],
            "SciPy [%]": 100 * elsewhere(attacks[name].loop, attacks[name], worst[name]),
        }
        for name in names
        if name in (TUNED, "slip-real")
    }
    record.print_rows(
        "The worst found, integrated by SciPy", [{"controller": name, **row} for name, row in scipy.items()]
    )
    tuning = (
        tuned_against(attacks[TUNED], config, results[TUNED]["price of a gradient"], told) if TUNED in names else {}
    )
    nominals = {name: result["nominal overshoot [%]"] / 100 for name, result in results.items()}
    figures = {
        "cost": cost_figure(logs_by_loop, nominals, config.searching.budget),
        "road": road_figure({n: attacks[n] for n in config.drawn if n in names}, worst, seed=1),
    }
    pathlib.Path(config.out).mkdir(parents=True, exist_ok=True)
    more = in_more_dimensions(config, told) if config.finer_budget and TUNED in names else []
    spent = time.process_time() - begun
    told(f"{spent:.0f} s of processor time")
    everything = {
        "controllers": results,
        "SciPy": scipy,
        "tuned against": tuning,
        "more numbers": more,
        "processor [s]": spent,
    }
    return record.experiment(config, everything, figures)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(progress=with_times()), SEARCH_TOLERANCE)
