"""How near does a search with exact derivatives come to the best PI and PID controllers of published models?

The models are the 134 of Astrom and Hagglund's test batch (`models.py`). The greatest integral gain, which is the
least integral of the error after a step of the load, is sought for |S| and |T| of at most 1.4, for all models at once
(`search.py`). For PI controllers it is compared with a scan of the plane of the gains in NumPy alone (`scan.py`). The
rules SIMC and AMIGO are compared as printed, and with all gains times a factor that gives a peak of 1.4.

    python experiments/pid_published/run.py
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from diffabs.output import plot
from diffabs.papers import record
from experiments._shared.numbers import store_numbers
from experiments.pid_published import models, scan, search
from experiments.pid_published.models import Gains, Process, StepFit

SAME = 1e-3  # relative distance of ki below which two searches agree
RULES = {"SIMC PI": models.simc_pi, "AMIGO PI": models.amigo_pi, "AMIGO PID": models.amigo_pid}


@dataclasses.dataclass(frozen=True)
class Config:
    """Every number of the experiment."""

    peak: float = 1.4  # of |S| and |T|
    every: int = 1  # model of the batch
    greatest_k: float = 6.0  # of the scan, in units of AMIGO's k
    excess: float = 1e-5  # relative, of a peak in NumPy above the bound, beyond which a search is repeated
    repetitions: int = 4
    out: str = "out/experiments/pid_published"


@dataclasses.dataclass(frozen=True)
class Task:
    """The models of a search."""

    processes: Sequence[Process]
    fits: Sequence[StepFit]
    stacked: search.Models

    @classmethod
    def of(cls, processes: Sequence[Process]) -> "Task":
        """Return the task of some processes."""
        fits = [models.fit_step(process) for process in processes]
        return cls(processes, fits, search.stack_models(processes, [models.filter_time(fit) for fit in fits]))

    def measure(self, gains: Sequence[Gains]) -> np.ndarray:
        """Return the greatest of |S| and |T| of each loop, in NumPy."""
        rows = zip(self.processes, gains, self.fits, strict=True)
        return np.array([scan.measure_peaks(p, g, models.filter_time(fit), scan.FINE) for p, g, fit in rows])

    def search(self, guesses: Sequence[Gains], bounds: np.ndarray, size: int) -> search.Search:
        """Return the gains of the greatest ki of each model, in seconds."""
        start, units = search.start_inside(self.stacked, self._scale_time(guesses, 1), bounds, size)
        result = search.maximise_integral(self.stacked, start, units, bounds)
        return search.Search(self._scale_time(result.gains, -1), result.evaluations)

    def _scale_time(self, gains: Sequence[Gains], power: int) -> list[Gains]:
        """Return gains in the time of the stacked models (power 1), or back in seconds (power -1)."""
        scales = [process.duration**power for process in self.processes]
        return [Gains(g.k, g.ki * scale, g.kd / scale) for g, scale in zip(gains, scales, strict=True)]


class Best(NamedTuple):
    """The best of the searches from several starts.

    Attributes:
        gains: Gains of each model, in seconds.
        evaluations: Evaluations of each model, of all its starts.
        agreeing: Number of starts of each model that end at the same ki.
    """

    gains: list[Gains]
    evaluations: np.ndarray
    agreeing: np.ndarray


def search_best(task: Task, starts: Sequence[Sequence[Gains]], bounds: np.ndarray, size: int) -> Best:
    """Return the greatest ki of each model over some starts, each a list of gains for all models."""
    models_of_all = Task.of(list(task.processes) * len(starts))
    result = models_of_all.search([gains for start in starts for gains in start], np.tile(bounds, len(starts)), size)
    ki = np.array([gains.ki for gains in result.gains]).reshape(len(starts), -1)
    count, winners = ki.shape[1], ki.argmax(axis=0)
    gains = [result.gains[winner * count + i] for i, winner in enumerate(winners)]
    agreeing = np.sum(ki >= (1 - SAME) * ki.max(axis=0), axis=0)
    return Best(gains, result.evaluations.reshape(len(starts), -1).sum(axis=0), agreeing)


def search_all(config: Config, task: Task, starts: Sequence[Sequence[Gains]], size: int) -> Best:
    """Return the gains of the greatest ki for each model, with peaks that NumPy confirms.

    If a delay is much longer than the lags, |S| of a PID loop has tens of nearly equal peaks. The frequencies of the
    search may miss the highest by a thousandth. The search is repeated with a bound that is as much lower.
    """
    bounds = np.full(len(task.processes), config.peak)
    best = search_best(task, starts, bounds, size)
    for _ in range(config.repetitions):
        measured = task.measure(best.gains)
        beyond = np.flatnonzero(measured > config.peak * (1 + config.excess))
        if not beyond.size:
            break
        bounds[beyond] *= config.peak / measured[beyond]
        rest = Task.of([task.processes[i] for i in beyond])
        again = search_best(rest, [[start[i] for i in beyond] for start in starts], bounds[beyond], size)
        best.evaluations[beyond] += again.evaluations
        best.agreeing[beyond] = again.agreeing
        for i, gains in zip(beyond, again.gains, strict=True):
            best.gains[i] = gains
    return best


def list_pid_starts(fit: StepFit) -> tuple[Gains, ...]:
    """Return the starts of a PID search: AMIGO's gains, with less integral, more derivative, and nearly PI."""
    pid, pi = models.amigo_pid(fit), models.amigo_pi(fit)
    fast = Gains(pid.k, 0.5 * pid.ki, 2 * pid.kd)
    return pid, pid._replace(ki=0.3 * pid.ki), fast, Gains(pi.k, pi.ki, 0.3 * pid.kd)


def judge_rule(config: Config, process: Process, fit: StepFit, name: str) -> tuple[dict[str, Any], Gains | None]:
    """Return the peak of a rule's loop, and the gains times the factor that gives the peak of the bound."""
    gains, filtered = RULES[name](fit), models.filter_time(fit)
    return {f"{name}: peak": scan.measure_peaks(process, gains, filtered)}, scan.scale_to_peak(
        process, gains, filtered, config.peak
    )


def compare_model(config: Config, process: Process, fit: StepFit, pi: Gains, pid: Gains) -> dict[str, Any]:
    """Return the row of one model."""
    greatest_k = config.greatest_k * models.amigo_pi(fit).k + 1 / process.numerator[-1]
    filtered = models.filter_time(fit)
    oracle = scan.scan_pi(process, config.peak, greatest_k)
    errors = {"PI": scan.integrate_error(process, pi, filtered), "PID": scan.integrate_error(process, pid, filtered)}
    row: dict[str, Any] = {
        "model": process.name,
        "ki of the scan": oracle.ki,
        "k of the scan": oracle.k,
        "PI: ki / scan": pi.ki / oracle.ki,
        "PID: ki / PI": pid.ki / pi.ki,
        "PI: IAE ki": errors["PI"] * pi.ki,
        "PID: IAE ki": errors["PID"] * pid.ki,
    }
    for name in RULES:
        words, scaled = judge_rule(config, process, fit, name)
        best, error = (pid, errors["PID"]) if name.endswith("PID") else (pi, errors["PI"])
        row |= words
        row[f"{name}: ki / best"] = scaled.ki / best.ki if scaled else None
        row[f"{name}: IAE / best"] = scan.integrate_error(process, scaled, filtered) / error if scaled else None
    return row


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return medians and extremes of each family, and of all."""
    families = {row["model"].split()[0]: [] for row in rows} | {"all": list(rows)}
    for row in rows:
        families[row["model"].split()[0]].append(row)
    table = []
    for family, members in families.items():

        def values(name: str, members: list[dict[str, Any]] = members) -> np.ndarray:
            return np.array([np.nan if row[name] is None else row[name] for row in members])

        summary: dict[str, Any] = {"family": family, "models": len(members)}
        summary["PI: least ki / scan"] = float(values("PI: ki / scan").min())
        summary["PID: ki / PI"] = float(np.median(values("PID: ki / PI")))
        for name in RULES:
            ratios = values(f"{name}: ki / best")
            summary[f"{name}: ki / best"] = float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else None
            summary[f"{name}: IAE / best"] = (
                float(np.nanmedian(values(f"{name}: IAE / best"))) if np.isfinite(ratios).any() else None
            )
            summary[f"{name}: none"] = int(np.isnan(ratios).sum())
            summary[f"{name}: peak"] = float(np.median(values(f"{name}: peak")))
        table.append(summary)
    return table


def figures(config: Config, rows: Sequence[dict[str, Any]], fits: Sequence[StepFit]) -> dict[str, Any]:
    """Return the figure of ki over the share of the delay."""
    title = f"Integral gain at a peak of {config.peak:g} of |S| and |T|, over that of the search"
    figure, axes = plot.sheet(1, 2, title=title, size=(5.2, 3.4), sharey=True)
    shares = [0.0 if np.isinf(fit.lag) else fit.delay / (fit.delay + fit.lag) for fit in fits]
    panels = {"PI controllers": ("SIMC PI", "AMIGO PI"), "PID controllers": ("AMIGO PID",)}
    for ax, (words, names) in zip(axes, panels.items(), strict=True):
        for i, name in enumerate(names):
            ratios = [row[f"{name}: ki / best"] or np.nan for row in rows]
            ax.plot(shares, ratios, "o^"[i], color=plot.COLOURS[i], markersize=4, label=name)
        ax.axhline(1.0, color="black", linewidth=0.8, linestyle=":")
        plot.label_axes(ax, "delay/(delay + lag) of the step response", "" if ax is axes[1] else "ratio", words)
    axes[0].set_ylim(0.0, 1.05)
    return {"gains": figure}


def main(config: Config | None = None) -> dict[str, Any]:
    """Run, print, save; returns the results."""
    config = config or Config()
    task = Task.of(list(models.list_models())[:: config.every])
    pi = search_all(config, task, [[models.amigo_pi(fit) for fit in task.fits]], 2)
    pid = search_all(config, task, list(zip(*map(list_pid_starts, task.fits), strict=True)), 3)
    print(f"searched {len(task.processes)} models", flush=True)
    columns = zip(task.processes, task.fits, pi.gains, pid.gains, strict=True)
    rows = [compare_model(config, *column) for column in columns]
    for row, agreeing in zip(rows, pid.agreeing.tolist(), strict=True):
        row["PID: starts that agree"] = agreeing
    table = summarise(rows)
    record.print_rows("Integral gains at equal peaks", table)
    results = {
        "table": table,
        "rows": rows,
        "work": {
            "PI: median evaluations": float(np.median(pi.evaluations)),
            "PI: most evaluations": int(pi.evaluations.max()),
            "PID: median evaluations": float(np.median(pid.evaluations)),
            "PID: most evaluations": int(pid.evaluations.max()),
            "PID: models with two agreeing starts": int(np.sum(pid.agreeing > 1)),
            "PI: greatest peak": float(task.measure(pi.gains).max()),
            "PID: greatest peak": float(task.measure(pid.gains).max()),
        },
    }
    print(results["work"])
    return record.experiment(config, results, figures(config, rows, task.fits))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    store_numbers(__file__, main(), tolerance=1e-3)
