"""Write the packaged readings of the rig's figures: of each curve at most 80 points, joined by straight lines.

The finer readings were taken from the vector paths of the manual's figures. Greedy thinning keeps both ends of a curve
and then, one after the other, the reading that is farthest from the lines. The distance of a slip counts less where the
wheel hardly turns, as in the fit. The largest distance that is left is printed. The relay's commands follow from the
finer slips: 1 below the threshold, from the first command on.

    python experiments/measured_rig_readings.py FOLDER diffabs/papers/measured_rig.csv
"""

import csv
import pathlib
import sys

import numpy as np

from diffabs.papers.measured_rig import EXPERIMENTS, RPM, slip_weight

MOST = 80  # readings a curve
HEADER = """\
# Readings from the figures of INTECO, ABS, The laboratory Anti-lock Braking System, user's manual (2014): Fig. 3.11 and
# 3.13 (relay-slip: wheel [rad/s], slip [1], against the drawing's time [s]), 5.5 a to d (coasting [rad/s]), 5.6 a
# (step-braking: rims' speeds [m/s]), 5.6 b (brake torque [N m] against command) and 5.6 c (friction against slip).
# Simulated by the maker, not measured: Fig. 6.5 and 6.6 (maker-simulation), and the slip of the maker's model under the
# command 1 (slip-open-loop; Octavian-Duma/Antilock-Braking-System-Control, DateSlipu0.xlsx). Straight lines between the
# readings follow a curve. The commands are derived: 1 where the slip is below the threshold.
"""


def thin(x: np.ndarray, y: np.ndarray, weight: np.ndarray | float = 1.0) -> tuple[np.ndarray, float]:
    """Return the indices of at most 80 points whose straight lines follow a curve, and the largest weighted distance.

    Args:
        x: Abscissae, increasing, shape (n,).
        y: Values, shape (n,).
        weight: Weights of the distances, shape (n,) or one.
    """
    if len(x) <= MOST:
        return np.arange(len(x)), 0.0
    kept = [0, len(x) - 1]
    while True:
        gap = weight * np.abs(np.interp(x, x[kept], y[kept]) - y)
        if len(kept) >= MOST or gap.max() == 0:
            return np.array(kept), float(gap.max())
        kept = sorted([*kept, int(np.argmax(gap))])


def main(folder: pathlib.Path, target: pathlib.Path) -> None:
    """Read the finer readings, thin them, write the file, and print what each curve loses."""
    curves: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def columns(name: str) -> dict[str, list[str]]:
        with (folder / f"{name}.csv").open() as lines:
            rows = list(csv.DictReader(lines))
        return {key: [row[key] for row in rows] for key in rows[0]}

    for one in EXPERIMENTS:
        table = columns(one.name)
        t, wheel, slip = (np.array(table[key], float) for key in ("time_s", "wheel_speed_rad_per_s", "slip_1"))
        curves |= {f"{one.name} wheel": (t, wheel), f"{one.name} slip": (t, slip)}
        commands = np.where((slip < one.threshold) & (t > one.start - 0.005), 1.0, 0.0)
        changes = np.flatnonzero(np.diff(commands, prepend=-1.0))
        curves[f"{one.name} commands"] = t[changes], commands[changes]
        # the maker's own simulation of the experiment, in rad/s
        name = f"maker-simulation-{one.name.removeprefix('relay-')}"
        table = columns(name)
        t, wheel, slip = (np.array(table[key], float) for key in ("time_s", "wheel_speed_rpm", "slip_1"))
        curves |= {f"{name} wheel": (t, wheel * RPM), f"{name} slip": (t, slip)}
    table = columns("slip-open-loop-u1")
    curves["slip-open-loop"] = np.array(table["time_s"], float), np.array(table["slip_1"], float)
    for name in ("coasting-wheel-1", "coasting-wheel-2", "coasting-drum-1", "coasting-drum-2"):
        table = columns(name)
        curves[name] = np.array(table["time_s"], float), np.array(table["speed_rad_per_s"], float)
    table = columns("step-braking")
    of = list(zip(table["command_1"], table["signal"], strict=True))
    for key in dict.fromkeys(of):
        rows = [i for i, one in enumerate(of) if one == key]
        t, speed = (np.array(table[name], float)[rows] for name in ("time_s", "rim_speed_m_per_s"))
        curves[f"step-braking {key[0]} {key[1]}"] = t, speed
    for name, x, y in (("brake-torque", "command_1", "brake_torque_n_m"), ("friction", "slip_1", "friction_1")):
        table = columns(name)
        curves[name] = np.array(table[x], float), np.array(table[y], float)

    lines = ["curve,x,y"]
    for name, (x, y) in curves.items():
        record, _, column = name.rpartition(" ")
        weight = slip_weight(curves[f"{record} wheel"][1]) if column == "slip" else 1.0
        kept, gap = thin(x, y, weight)
        print(f"{name}: {len(kept)} of {len(x)} readings, largest distance {gap:.3g}")
        lines += [f"{name},{x[i]:.6g},{y[i]:.6g}" for i in kept]
    target.write_text(HEADER + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
