"""Draw which package imports which, layer by layer: docs/figures/packages.png.

    python docs/_build/packages.py [folder of another checkout]

Prints how many packages (or loose modules), arrows and arrows upwards there are. Needs the groups `lint` and `plot`."""

import pathlib
import sys
import tomllib
from collections import defaultdict

import grimp
from matplotlib.figure import Figure

ROOT = pathlib.Path(__file__).parent.parent.parent
HEIGHT, WIDTH = 0.8, 11.0  # of a layer, of the figure [inch]


def arrows(folder: pathlib.Path) -> dict[tuple[str, str], int]:
    """How many imports there are from a package to another, by (importer, imported)."""
    sys.path.insert(0, str(folder))
    graph = grimp.build_graph("diffabs", cache_dir=None)
    found: dict[tuple[str, str], int] = defaultdict(int)
    for module in graph.modules:
        for other in graph.find_modules_directly_imported_by(module):
            ends = tuple((name.split(".") + ["diffabs"])[1] for name in (module, other))
            if ends[0] != ends[1] and "diffabs" not in ends:
                found[ends] += 1
    return dict(found)


def layers(folder: pathlib.Path) -> list[list[str]]:
    """The rows of the contract, from the top."""
    with (folder / "pyproject.toml").open("rb") as file:
        contracts = tomllib.load(file)["tool"]["importlinter"]["contracts"]
    return [[name.strip() for name in row.replace(":", "|").split("|")] for row in contracts[0]["layers"]]


def drawn(found: dict[tuple[str, str], int], rows: list[list[str]]) -> Figure:
    """Packages in rows, an arrow for each that imports another, the thicker the more often."""
    figure = Figure(figsize=(WIDTH, HEIGHT * len(rows)), layout="constrained")
    ax = figure.subplots()
    aside = [0.09 * (1, -1)[y % 2] if len(row) == 1 else 0.0 for y, row in enumerate(rows)]  # or arrows hide arrows
    place = {
        name: ((i + 1) / (len(row) + 1) + aside[y], len(rows) - y)
        for y, row in enumerate(rows)
        for i, name in enumerate(row)
    }
    for (a, b), count in found.items():
        if a in place and b in place:
            style = {"arrowstyle": "->", "color": "#0072B2", "alpha": 0.35, "lw": 0.4 + 0.25 * min(count, 12)}
            ax.annotate(
                "",
                place[b],
                place[a],
                arrowprops=style | {"shrinkA": 9, "shrinkB": 9, "connectionstyle": "arc3,rad=0.1"},
            )
    for name, (x, y) in place.items():
        ax.text(x, y, name, ha="center", va="center", bbox={"boxstyle": "round", "fc": "white", "ec": "#767676"})
    ax.set(xlim=(0, 1), ylim=(0.5, len(rows) + 0.5))
    ax.axis("off")
    return figure


def main() -> None:
    """Count, and draw this checkout."""
    folder = pathlib.Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT
    found, rows = arrows(folder), layers(folder)
    level = {name: i for i, row in enumerate(rows) for name in row}
    upwards = sum(level.get(a, 0) > level.get(b, 99) for a, b in found)
    names = {name for pair in found for name in pair}
    print(f"{len(names)} packages and loose modules in {len(rows)} rows, {len(found)} arrows, {upwards} upwards")
    if folder == ROOT:
        drawn(found, rows).savefig(ROOT / "docs" / "figures" / "packages.png", dpi=110)


if __name__ == "__main__":
    main()
