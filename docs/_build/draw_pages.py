"""Draw the figures of the pages that teach, by the commands and the code that the pages show.

python docs/_build/draw_pages.py        writes docs/figures/<page>.png"""

import contextlib
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
FIGURES = ROOT / "docs" / "figures"
NOISE = "--set solver.step=1e-3 --set sensor=noise --set sensor.slip=0.005"
SWEEP = f"sweep slip-lmi --samples 1000 {NOISE} --figures --out noisy"
ROBUST = "tune slip-cured --set tune.constraints.sensitivity=1.7 --set tune.constraints.delay_margin=5e-3 --plot robust.png"
# page: (folder in which it begins, command, the file that it draws)
COMMANDS = {
    "first-run": (".", "simulate slip-cured --plot run.png", "run.png"),
    "margins": (".", "margins slip-cured --plot loop.png", "loop.png"),
    "plant-in-15-minutes": ("examples/dc-servo", "simulate servo.toml --parts dc_servo --plot run.png", "run.png"),
    "robustness": (".", ROBUST, "robust.png"),
    "sweeps": (".", SWEEP, "noisy/figures/distributions.png"),
}


# pages whose code saves a figure, and under which name
PAGES = {
    "quick-start": "run.png",
    "identify": "fit.png",
    "journeys/own-plant": "run.png",
    "journeys/own-reference": "run.png",
    "journeys/own-actuator": "run.png",
}


def main() -> None:
    """Draw all of them, each in a folder that goes away."""
    sys.path.insert(0, str(ROOT / "tests" / "support"))
    os.environ["MPLBACKEND"] = "Agg"
    import pages

    for page, (source, command, picture) in COMMANDS.items():
        with tempfile.TemporaryDirectory() as folder:
            shutil.copytree(ROOT / source, folder, dirs_exist_ok=True) if source != "." else None
            subprocess.run([sys.executable, "-m", "diffabs", *command.split(), "--quiet"], cwd=folder, check=True)
            shutil.copy(pathlib.Path(folder) / picture, FIGURES / f"{page}.png")
    for page, picture in PAGES.items():
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            pages.printed((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"), f"{page}.md")
            shutil.copy(picture, FIGURES / f"{pathlib.Path(page).name}.png")


if __name__ == "__main__":
    main()
