"""Error against time per run, one panel for each problem, from what bench_work_precision.py has written. The panel of
[lmi] is that of bench_peers.py, with the peers, if that has been run with as many lanes.

    python benchmarks/draw_work_precision.py [--lanes 4096] [--dtype float64] [--out docs/figures/work-precision.png]
"""

import argparse
import json
import pathlib
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import record

OURS = {"fixed": ("diffabs, FixedStep", "C0", "o"), "adaptive": ("diffabs, Adaptive", "C3", "s")}
PEERS = {
    "diffabs_fixed": OURS["fixed"],
    "diffabs_adaptive": OURS["adaptive"],
    "c_adaptive": ("C, adaptive", "black", "^"),
    "numba_adaptive": ("Numba, adaptive", "C4", "v"),
    "diffrax_event": ("diffrax Tsit5", "C2", "D"),
    "jaxonomy_event": ("jaxonomy Dopri5", "C5", "P"),
    "scipy_loop": ("SciPy RK45", "C1", "X"),
    "torchdiffeq_event": ("torchdiffeq", "C7", "*"),
}
COLUMNS = 3


def curve(axes: Any, points: list[dict[str, Any]], seconds: list[float], look: tuple[str, str, str]) -> None:
    """Draw the points of a solver: error against seconds of a run."""
    name, colour, marker = look
    drawn = [(t, point["error"]) for t, point in zip(seconds, points, strict=True) if 0 < point["error"] < 1]
    if drawn:
        axes.loglog(*zip(*drawn, strict=True), color=colour, marker=marker, ms=4, lw=1.2, label=name)


def panels(found: dict[str, Any], peers: dict[str, Any] | None, lanes: int, dtype: str) -> Any:
    """Return the figure. Raises ValueError for lanes that were not run."""
    problems = found["found"][dtype]
    if lanes not in found["lanes"]:
        raise ValueError(f"{lanes} lanes were not run, but {', '.join(map(str, found['lanes']))}")
    rows = -(-len(problems) // COLUMNS)
    size = {"figsize": (10, 3.1 * rows), "layout": "constrained"}
    figure, grid = plt.subplots(rows, COLUMNS, squeeze=False, sharex=True, sharey=True, **size)
    for axes, (name, problem) in zip(grid.flat, problems.items(), strict=False):
        beside = peers if name == "lmi" else None  # then all curves of a panel are of one run
        for kind, look in OURS.items():
            mine = [p for p in problem["points"] if p["solver"] == kind and p["lanes"] == lanes and not beside]
            curve(axes, mine, [p["run_s"] / lanes for p in mine], look)
        for peer, look in PEERS.items():
            points = beside["points"].get(peer, []) if beside else []
            curve(axes, points, [1 / p["runs_per_s"] for p in points], look)
        axes.axhline(found["asked"], color="0.6", lw=0.8, ls="--")
        title = f"{problem['title']}: {beside['threads']} threads" if beside else problem["title"]
        axes.set(title=title, ylim=(1e-9, 0.1))
        axes.grid(alpha=0.3)
    for axes in grid.flat[len(problems) :]:
        axes.remove()
    figure.supxlabel(f"time per run [s], {lanes:,} runs at once, {dtype}")
    figure.supylabel("worst relative error of all metrics and runs")
    legend = {line.get_label(): line for axes in figure.axes for line in axes.lines if line.get_marker() != "None"}
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=4, frameon=False)
    return figure


def main() -> None:
    """Read, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float64")
    parser.add_argument("--records", type=pathlib.Path, default=record.OUT)
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("docs/figures/work-precision.png"))
    options = parser.parse_args()
    found = json.loads((options.records / "work-precision.json").read_text(encoding="utf-8"))
    beside = options.records / f"peers-{options.lanes}-{options.dtype}.json"
    peers = json.loads(beside.read_text(encoding="utf-8")) if beside.exists() else None
    options.out.parent.mkdir(parents=True, exist_ok=True)
    panels(found, peers, options.lanes, options.dtype).savefig(options.out, dpi=110)
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
