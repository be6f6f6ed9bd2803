"""Fumita, attitude stabilisation of a two-wheeler by an arm: Fig. 3, its refutation, and a machine that works.

The paper leans frame and rider by 0.5 and 0.2 rad and shows that everything returns to 0. This holds for its printed
linear equations, which no mechanism obeys. The reproduction runs the same start in the printed and in the correct
equations. It then bounds the recoverable starts of any control and repeats the study for the same machine with a
hanging arm. An independent solution gives the numbers for comparison.
"""

import dataclasses
import pathlib
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from diffabs.core.numerics import spectral_bound
from diffabs.core.pytree import replace
from diffabs.core.types import AnyArray, JsonObject, Part, PyTree, Table
from diffabs.engine.solvers import Adaptive, FixedStep, describe_solver
from diffabs.host import provenance
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.linearization import StateSpace
from diffabs.linear.recoverable import mode_bounds, transmission_zeros
from diffabs.linear.regulator import lqr
from diffabs.loop.closed_loop import Loop
from diffabs.loop.result import Run
from diffabs.loop.run import rollout
from diffabs.papers import arm_equations, arm_figures, record
from diffabs.papers.digest import Digest, Refuted, digest
from diffabs.parts.controllers import BalanceFeedback
from diffabs.parts.objectives import BALANCE
from diffabs.parts.plants import ACROBOT, ArmBalance, BalanceStart, PrintedArm
from diffabs.robust.design.attraction import Basin, Cells, Reach, largest_recovered_multiples, region_of_attraction
from diffabs.scenario.defaults import balancing

TITLE = "Fumita: a two-wheeler balanced by an arm"
SOLVER = FixedStep(step=1e-3, duration=10.0)
LONG_SOLVER = Adaptive(rtol=1e-6, duration=600.0)  # for counts: a run ends when its outcome is decided
FINE = FixedStep(step=1e-5, duration=0.1, every=10)  # for the start at which the controller applies 14 kV
PAPER_START = np.array([0.5, 0.0, 0.2, 0.0, 0.0, 0.0])  # start of Fig. 3 [rad, rad/s]
HANGING = ArmBalance(arm_length=-0.5)
WEIGHTS, EFFORT = (1.0, 100.0, 1.0, 1.0, 1.0, 1.0), 0.01  # Q and R of the LQR for the hanging arm
# From experiments/two_wheeler: weights tuned by gradients for the largest region of attraction at 48 V.
TUNED = (50466.024, -3214.2056, 20068.574, 17861.686, -92.413308, 7435.5672)
VOLTAGES = (24.0, 48.0, 100.0)
RIDERS = np.linspace(40.0, 100.0, 13)  # kg
MULTIPLES = np.linspace(0.001, 0.12, 120)  # multiples of the start that are tried for recovery
BOX = Cells(-0.1, 0.1, 100)  # box of starts in a map [rad]

# Independent numbers, computed with SymPy and SciPy's DOP853.
POLES = (-108.06522648, -2.79102448, 0.29783666, 2.78790563)
ZERO = 2.6759
PEAKS = (4.37, 479.0)  # of Fig. 3 with the LQR Q = I, R = 1: arm [rad], voltage [V]
PUBLISHED_MULTIPLES = {24.0: 0.046, 48.0: 0.080, 100.0: 0.116}  # multiples recovered by the hanging arm
HANGING_PEAKS = (0.03987, 0.58744)  # rad, from 0.06 of the start
SPONG = (-246.48129, -98.690342, -106.464047, -50.138071)  # -K

NOTES = [
    "The paper's potential energy has theta1 - theta2 and theta1 - theta3 where its kinetic energy has the sums, "
    "so that its linear gravity forces, eqs. (8)-(10), come from no potential: in them an arm that leans to one "
    "side is drawn to the other. Fig. 3 is true of these equations only.",
    "Not in the paper and assumed here: K = 1000 N m/rad and d = 100 N m s/rad of the rider, the controller (LQR,"
    " Q = I, R = 1), the voltage limit of 48 V. K_t = K_b = 30 make sense as values behind a gear.",
    "Why the correct machine falls: seen from the frame, the zero of the arm's effect, 2.676, nearly cancels the "
    "unstable pole, 2.788. The arm pushes the frame back as it falls to its side, and its weight, above the "
    "joint, then pulls it on.",
    "What no control can do: the unstable mode s is returned only from |w'x| <= |w'B| U/s. Of the start of Fig. 3"
    " that is 0.0087 at 48 V (a lean of 0.0044 rad); the whole start would need 5.5 kV. A hanging arm has 0.0933.",
    "The independent solution has 0.046 and 0.116 for the recovered multiples at 24 and 100 V; here they are "
    "0.0454 and 0.1146, and SciPy's DOP853 on separately written equations falls from 0.0456 and from 0.1148 too.",
    "Recovered means: the run comes into an ellipsoid from which the nonlinear loop at its voltage limit provably "
    "returns (diffabs.robust.design.capture). A run that neither does so nor falls in time is undecided, and counted "
    "apart. "
    "A multiple counts as recovered if all smaller ones tried are. Shares are by area: starts are centres of cells.",
]


CLAIMS = (
    Refuted(
        "Fig. 3, an arm saves a frame at 0.5 rad",
        "by correct equations it falls",
        [("correct, no limit", "fell"), ("correct, 48 V", "fell")],
        lambda unlimited, limited: unlimited == limited == 1.0,
    ),
)
SHOWN_QUANTITIES = (
    "fell",
    "bound",
    "recovered",
    "share",
    "peak_voltage",
)  # first words of the quantities that the digest shows


def upright_model(plant: Part) -> StateSpace:
    """Return the linear model (A, B) of a plant about the upright position."""
    return BalanceModel(plant=plant).matrices()


def lqr_gain(plant: Part, weights: Sequence[float] = (1.0,) * 6, effort: float = 1.0) -> np.ndarray:
    """Return the LQR gain K of u = K x about the upright position, shape (6,).

    Args:
        weights: Diagonal of Q, 6 numbers.
        effort: R, > 0.
    """
    return np.asarray(lqr(*upright_model(plant), np.diag(weights), effort * np.eye(1)).gain[0])


def loop(plant: Any, gain: Sequence[float] | AnyArray, start: PyTree = PAPER_START, voltage: float = 48.0) -> Loop:
    """Return the closed loop from a start.

    Args:
        start: Angles theta, psi and phi [rad] at the start; further entries have no effect.
        voltage: Limit of the motor voltage [V].
    """
    return dataclasses.replace(
        replace(balancing(), {"actuator.high": voltage}),
        plant=plant,
        initial=BalanceStart(theta=start[0], psi=start[1], phi=start[2]),
        controller=BalanceFeedback(gain=np.asarray(gain)),
    )


def runs() -> dict[str, Run]:
    """Return the five runs by name, as NumPy arrays.

    They are Fig. 3 in the printed equations, its start in the correct model with two voltage limits, and two gains of
    the hanging arm.
    """
    upright, hanging = lqr_gain(ArmBalance()), lqr_gain(HANGING, WEIGHTS, EFFORT)
    cases = {
        "printed": loop(PrintedArm(), lqr_gain(PrintedArm()), voltage=1e6),
        "correct, no limit": loop(ArmBalance(), upright, voltage=1e9),
        "correct, 48 V": loop(ArmBalance(), upright),
        "hanging": loop(HANGING, hanging, 0.06 * PAPER_START),
        "hanging, tuned": loop(HANGING, TUNED, 0.08 * PAPER_START),
    }
    solvers = {"correct, no limit": FINE}
    return {
        name: jax.tree.map(np.asarray, rollout(case, solvers.get(name, SOLVER), BALANCE))
        for name, case in cases.items()
    }


def recovered_multiples(closed_loop: Loop, rows: Table) -> list[Reach]:
    """Return, for each row, the greatest of `MULTIPLES` up to which every multiple of the paper's start is recovered.

    Args:
        rows: Values by parameter path, each of shape (rows,); all paths of a row change together.
    """
    direction = {"initial.theta": PAPER_START[0], "initial.phi": PAPER_START[2]}
    return largest_recovered_multiples(closed_loop, rows, direction, MULTIPLES, LONG_SOLVER)


def largest_possible_multiples(plant: ArmBalance, riders: Any) -> np.ndarray:
    """Return an upper bound of the recoverable multiples of the start for each rider [kg], shape (riders,).

    The bound holds in the linear model for any control of at most 48 V.
    """
    return np.array(
        [
            min(mode_bounds(*upright_model(replace(plant, {"rider_mass": m})), PAPER_START, 48.0).values())
            for m in riders
        ]
    )


def heaviest(plant: ArmBalance, gain: np.ndarray) -> float:
    """Return the mass of the heaviest rider [kg], at most 200, that a gain stabilises in the linear model, to 1 g.

    Args:
        gain: K of u = K x, shape (6,), that is known to stabilise 50 kg.
    """
    low, high = 50.0, 200.0  # kg
    while high - low > 1e-3:
        mass = (low + high) / 2
        a, b = upright_model(replace(plant, {"rider_mass": mass}))
        held = spectral_bound(np.asarray(a + b @ gain[None])) < 0
        low, high = (mass, high) if held else (low, mass)
    return low


def maps(progress: Callable[[str], None]) -> dict[str, Basin]:
    """Return the regions of attraction at 48 V by name of the gain."""
    gains, basins = {"LQR": lqr_gain(HANGING, WEIGHTS, EFFORT), "weights tuned by gradients": TUNED}, {}
    for name, gain in gains.items():
        progress(f"arm-balance: {BOX.number**2} starts, {name}")
        basins[name] = region_of_attraction(loop(HANGING, gain), BOX, BOX, LONG_SOLVER)
    return basins


def robust_gains(progress: Callable[[str], None]) -> JsonObject:
    """Return pairs of a gain and its recovered multiples over the riders, by name of the gain.

    The gains are the LQR of one rider, tuned weights, and the LMI for all riders of 40 to 100 kg. The LMI is left out
    if the extra `design` is not installed.
    """
    gains = {"LQR for 50 kg": lqr_gain(HANGING, WEIGHTS, EFFORT), "weights tuned by gradients": np.array(TUNED)}
    progress("arm-balance: a gain for 40 to 100 kg")
    try:
        from diffabs.robust.design import Spec, design
        from diffabs.robust.design.parameter_grid import grid_polytope

        over = {"plant.rider_mass": (40.0, 100.0), "plant.stiffness": (700.0, 1300.0), "plant.damping": (70.0, 130.0)}
        solution = design(grid_polytope(BalanceModel(plant=HANGING), over), Spec(Q=WEIGHTS, R=EFFORT))
        gains["LMI for 40 to 100 kg"] = solution.gain[0]
    except ModuleNotFoundError:
        pass
    multiples = {}
    for name, gain in gains.items():
        progress(f"arm-balance: {len(RIDERS)} riders, {name}")
        multiples[name] = gain, recovered_multiples(loop(HANGING, gain), {"plant.rider_mass": RIDERS})
    return multiples


def table(runs_by_name: Mapping[str, Run], basins: Mapping[str, Basin]) -> list[JsonObject]:
    """Return the rows that compare our numbers with the independent ones."""
    a, b = upright_model(ArmBalance())
    poles = np.sort_complex(np.linalg.eigvals(np.asarray(a)))
    real = poles[np.abs(poles.imag) < 1e-9].real
    rows = [
        record.computed_row("correct model", "real pole", "1/s", ours, reference=reference)
        for ours, reference in zip(real, POLES, strict=True)
    ]
    zero = np.max(np.real(transmission_zeros(a, b, np.eye(6)[0])))
    rows.append(record.computed_row("correct model", "unstable zero of theta", "1/s", zero, reference=ZERO))
    rows.append(
        record.computed_row(
            "correct model", "bound, multiple at 48 V", "1", largest_possible_multiples(ArmBalance(), [50.0])[0]
        )
    )
    rows.append(
        record.computed_row(
            "hanging arm", "bound, multiple at 48 V", "1", largest_possible_multiples(HANGING, [50.0])[0]
        )
    )
    for name, reference, unit in (("peak_arm_angle", PEAKS[0], "rad"), ("peak_voltage", PEAKS[1], "V")):
        rows.append(
            record.computed_row(
                "printed model, Fig. 3", name, unit, runs_by_name["printed"].metrics[name], reference=reference
            )
        )
    for name, reference in zip(("peak_lean", "peak_arm_angle"), HANGING_PEAKS, strict=True):
        rows.append(
            record.computed_row(
                "hanging arm, 0.06 of it", name, "rad", runs_by_name["hanging"].metrics[name], reference=reference
            )
        )
    for name in ("correct, no limit", "correct, 48 V", "hanging", "hanging, tuned"):
        rows.append(record.computed_row(name, "fell", "1", runs_by_name[name].metrics["fell"]))
    hanging_gain = lqr_gain(HANGING, WEIGHTS, EFFORT)
    rows.append(record.computed_row("hanging arm, LQR", "heaviest rider held", "kg", heaviest(HANGING, hanging_gain)))
    reaches = recovered_multiples(loop(HANGING, hanging_gain), {"actuator.high": np.array(VOLTAGES)})
    for voltage, reach in zip(VOLTAGES, reaches, strict=True):
        words = f"recovered multiple at {voltage:g} V"
        rows.append(
            record.computed_row("hanging arm, LQR", words, "1", reach.multiple, reference=PUBLISHED_MULTIPLES[voltage])
        )
    for name, basin in basins.items():
        rows.append(record.computed_row(f"map, {name}", "share by area", "1", basin.share))
        rows.append(record.computed_row(f"map, {name}", "share undecided", "1", basin.undecided))
    a, b = (np.asarray(x) for x in upright_model(ACROBOT))
    part = [0, 1, 3, 4]
    gain = lqr(a[np.ix_(part, part)], b[part], np.eye(4), np.eye(1)).gain[0]
    names = ("theta", "psi", "theta'", "psi'")
    rows += [
        record.computed_row("Acrobot, LQR", f"-K of {name}", "", -k, published=f)
        for name, k, f in zip(names, gain, SPONG, strict=True)
    ]
    return rows


def compact(summary: Table) -> Digest:
    """Return the digest: falls, bounds of any control, and recovered starts of the hanging arm."""
    rows = summary["rows"]
    lines = []
    for row in rows:
        nothing = row["quantity"] == "share undecided" and row["ours"] == 0
        if (first := re.split(r"\W", row["quantity"])[0]) in SHOWN_QUANTITIES and not nothing:
            quantity = row["quantity"] if row["unit"] == "1" else f"{row['quantity']} [{row['unit']}]"
            number = ("no", "yes")[int(row["ours"])] if first == "fell" else f"{row['ours']:.4g}"
            lines.append((row["name"], quantity, number, "" if row["reference"] is None else f"{row['reference']:.4g}"))
    printed = [row for row in rows if row["published"] is not None]
    independent = [row for row in rows if row["reference"] is not None]
    where = "Spong's Acrobot"
    return digest(summary, ("", "quantity", "ours", "known"), lines, CLAIMS, (where, printed), independent)


def reproduce(folder: pathlib.Path, progress: Callable[[str], None]) -> JsonObject:
    """Write figures and `summary.json` into the folder, and return the summary."""
    progress("arm-balance: Fig. 3, printed and correct equations")
    runs_by_name = runs()
    basins = maps(progress)
    over_riders = robust_gains(progress)
    progress(f"arm-balance: starts recovered at {', '.join(f'{volts:g}' for volts in VOLTAGES)} V")
    rows = table(runs_by_name, basins)
    progress("arm-balance: figures")
    limit = largest_possible_multiples(HANGING, RIDERS)
    drawn = arm_figures.figures(runs_by_name, basins, RIDERS, over_riders, limit, PAPER_START, upright_model(HANGING))
    summary = {
        "paper": "arm-balance",
        "title": TITLE,
        "rows": rows,
        "judged": arm_equations.judge_equations(ArmBalance()),
        "figures": record.save_figures(drawn, folder),
        "notes": NOTES,
        "gains": {name: np.asarray(gain).tolist() for name, (gain, _) in over_riders.items()},
        "riders": {
            "mass": RIDERS.tolist(),
            "bound": limit.tolist(),
            **{name: [reach.multiple for reach in reaches] for name, (_, reaches) in over_riders.items()},
        },
        "riders undecided": {
            name: [float(m) for m, reach in zip(RIDERS, reaches, strict=True) if reach.undecided]
            for name, (_, reaches) in over_riders.items()
        },
        "solver": record.solver_settings(SOLVER, counted=describe_solver(LONG_SOLVER)),
        "made": provenance.describe_making(("reproduce", "arm-balance")),
        "versions": record.origin_of_numbers(),
    }
    return record.write_summary(folder, summary, compact)
