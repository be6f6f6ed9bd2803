"""Shared code of the commands that prove: a scenario as linear systems, a gain on them, a certificate as JSON.

Everything here needs the extra `design`. Modules that need the extra are imported only when a command runs.
"""

import contextlib
import dataclasses
import itertools
import pathlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.cli import console
from diffabs.config.values import ScenarioError, format_given
from diffabs.controllers import ProportionalFeedback
from diffabs.controllers.sampled import inner_controller
from diffabs.core.loop import Loop
from diffabs.core.protocols import Plant
from diffabs.core.pytree import parameters, replace
from diffabs.core.types import JsonObject, Part, PyTree, Scalar
from diffabs.linear.balance_model import BalanceModel
from diffabs.linear.slip_model import SlipModel
from diffabs.plants import BrakeStart
from diffabs.runtime import provenance
from diffabs.runtime.separated import read_decimal
from diffabs.scenario.scenario import Scenario

if TYPE_CHECKING:
    from diffabs.design import Certificate, Polytope, Spec
    from diffabs.design.frozen import FrozenLoops
    from diffabs.design.state_feedback import ReducedLoop

# Keys of the JSON document; without a certificate most are null.
FROM_PROOF = ("quadratically_stable", "stable", "verified_exactly", "decay_rate", "damping", "trace_cost",
              "guaranteed_cost", "worst_vertex", "margins", "claims")  # fmt: skip
FROM_DESIGN = ("lower_bound", "gap", "residual")
SCHEDULE_CELLS = 8  # cells of the speed range; the Lyapunov matrix is linear in the speed in each cell
# Samples of the friction curve and of the speed, and a factor for a maximum between two samples.
SLIPS, SPEEDS, MARGIN = 2001, 33, 1.01
VERDICT_WORDS = {True: "proved", False: "disproved", None: "undecided"}

Box = dict[str, tuple[float, float]]


class ProofTask(NamedTuple):
    """A scenario reduced to linear systems, with the gain to certify.

    Attributes:
        scenario: Scenario.
        reduced: Linear loop of the scenario, with the gain of its controller.
        gain: Gain to certify, one number per state.
        model: Linear model with one gain; the paths of the box are its parameters.
        states: Names of the model's states.
        over: Ranges (low, high) of the parameters, in SI.
        polytope: Polytope of the systems.
        spec: Specification of the closed loops.
    """

    scenario: Scenario
    reduced: "ReducedLoop"
    gain: np.ndarray
    model: Part
    states: tuple[str, ...]
    over: Box
    polytope: "Polytope"
    spec: "Spec"


def build_proof_task(scenario: Scenario, gain: str | None = None, *, weighed: bool = False) -> ProofTask:
    """Return the linear systems of a scenario with the gain to certify.

    Args:
        gain: `k1,k2,...`; by default the gain of the controller.
    """
    if weighed and scenario.design.Q is None:
        raise ScenarioError("design.Q and design.R are missing: a design minimises the cost that they weigh")
    from diffabs.design import Spec
    from diffabs.design.parameter_box import polytope
    from diffabs.design.parameter_grid import grid_polytope
    from diffabs.design.sdp import solver
    from diffabs.design.state_feedback import reduce_loop

    reduced, design = reduce_loop(scenario.loop), scenario.design
    states = reduced.model.states
    typed = None if gain is None else _read_gain(gain, states)  # refused before anything is computed
    spec = Spec(Q=design.Q, R=design.R, decay=design.decay, damping=design.damping)
    try:
        spec = spec.check(len(states), 1, reduced.model.period)
    except ValueError as error:
        raise ScenarioError(f"design.{error}; the states are {', '.join(states)}") from None
    solver.solvers()  # fails early if no SDP solver is installed
    reduced, model, over = _follow_speed(scenario.loop, reduced, design.box(scenario.loop))
    values = reduced.gain if typed is None else typed
    systems = grid_polytope(model, over) if isinstance(model, BalanceModel) else polytope(model, over)
    return ProofTask(scenario, reduced, values, model, tuple(model.states), over, systems, spec)


def _follow_speed(loop: Loop, reduced: "ReducedLoop", box: Box) -> tuple["ReducedLoop", PyTree, Box]:
    """Return the linear model and its box. A gain that follows the speed gets the model in which it is constant.

    A proof for that model covers every fall of the speed that friction and resistances allow.
    """
    controller = inner_controller(loop.controller)
    if not isinstance(controller, ProportionalFeedback) or not isinstance(reduced.model, SlipModel):
        return reduced, reduced.model, box
    from diffabs.design.speed_scaled import SpeedScaled, greatest_speed_fall
    from diffabs.design.state_feedback import feedback_gain

    model = SpeedScaled(model=reduced.model, reference_speed=controller.reference_speed)
    if model.period is None:
        raise ValueError("controller proportional-feedback: only sampled it can be brought to one gain")
    decelerations = _greatest_decelerations(loop.plant, box, speeds := _speeds(box, float(reduced.model.speed)))
    # The relative fall grows with a/v: friction makes that greatest at the slowest speed, air drag at the fastest.
    i = int(np.argmax(decelerations / speeds))
    falls = (0.0, greatest_speed_fall(float(decelerations[i]), float(speeds[i]), float(model.period)))
    neglected = tuple(line for line in reduced.neglected if "fall of the speed" not in line)
    over = {f"model.{path}": ends for path, ends in box.items()} | {"fall": falls}
    gain = np.asarray(feedback_gain(loop, model.states), float)  # at the reference speed
    return reduced._replace(gain=gain, neglected=neglected), model, over


def _speeds(box: Box, speed: float) -> np.ndarray:
    """Return the ends of the box in the speed [m/s] and speeds between them, shape (SPEEDS,).

    The ends suffice for friction and air drag: a = f + c v^2 and a/v are convex. Friction may depend on the speed.
    """
    return np.linspace(*box.get("speed", (speed, speed)), SPEEDS)


def _greatest_decelerations(plant: Plant, box: Box, speeds: np.ndarray) -> np.ndarray:
    """Return an upper bound of the deceleration [m/s^2] at each speed, over the corners of the box.

    The maximum over `SLIPS` slips times `MARGIN` allows for a greater value between two slips.
    """
    inside = {path.removeprefix("plant."): ends for path, ends in box.items() if path.startswith("plant.")}

    @jax.jit
    def greatest(plant: Plant) -> Any:
        def deceleration(speed: Scalar, slip: Scalar) -> Any:
            return plant.output(plant.start(BrakeStart(speed=speed, slip=slip))).deceleration

        every = jax.vmap(jax.vmap(deceleration, (None, 0)), (0, None))
        return jnp.max(every(speeds, np.linspace(0.0, 1.0, SLIPS)), axis=1)

    plants = (replace(plant, dict(zip(inside, corner, strict=True))) for corner in itertools.product(*inside.values()))
    return MARGIN * np.max([np.asarray(greatest(corner_plant)) for corner_plant in plants], axis=0)


def certify_gain(task: ProofTask) -> "Certificate":
    """Return the certificate of the gain, with the largest decay rate that a common Lyapunov matrix proves.

    A property without a proof raises no error: the certificate leaves it out.
    """
    from diffabs.design import analysis

    return analysis.certify(task.gain, task.polytope, task.spec, fastest=True)


def _read_gain(text: str, states: Sequence[str]) -> np.ndarray:
    words = text.strip().removeprefix("[").removesuffix("]").split(",")
    try:
        values = np.array([read_decimal(word) for word in words])
    except ValueError:
        raise ScenarioError(f"--gain {format_given(text)}: numbers are needed, as in --gain=-11753,-48") from None
    if not np.isfinite(values).all():
        raise ScenarioError(f"--gain {format_given(text)} is outside (-inf, inf): a gain is finite")
    if len(values) != len(states):
        raise ScenarioError(
            f"--gain {format_given(text)} has {len(values)} of {len(states)} numbers, one for each of"
            f" {', '.join(states)}"
        )
    return values


class FurtherFindings(NamedTuple):
    """Results on a gain that do not rest on a common Lyapunov matrix.

    Attributes:
        frozen: Poles of the closed loops at fixed parameters.
        fall: Greatest fall of the speed [m/s^2] that friction and resistances allow, if stability is proved for all
            falls up to it. The proof uses a Lyapunov matrix that depends on the speed. None if it fails or does not
            apply.
    """

    frozen: "FrozenLoops"
    fall: float | None

    def document(self) -> JsonObject:
        """Return the findings as JSON values."""
        return {"frozen": self.frozen._asdict(), "proved_for_a_speed_falling_by": self.fall}


def find_further(task: ProofTask, proof: "Certificate") -> FurtherFindings | None:
    """Return results on a gain without a proved common Lyapunov matrix; None with one, because it implies more."""
    from diffabs.design.frozen import analyse_frozen_loops

    if proof.quadratically_stable:
        return None
    loops = analyse_frozen_loops(task.gain, task.model, task.over)
    return FurtherFindings(loops, _permitted_fall(task) if loops.stable == loops.systems else None)


def _permitted_fall(task: ProofTask) -> float | None:
    """Return the greatest fall of the speed [m/s^2] in the box, if stability is proved for it; else None.

    The Lyapunov matrix of the proof is piecewise linear in the speed.
    """
    from diffabs.design import Spec, analysis
    from diffabs.design.parameter_box import schedule

    low, high = task.over.get("speed", (0.0, 0.0))
    if not 0 < low < high or task.polytope.period is not None:
        return None
    fall = float(_greatest_decelerations(task.scenario.loop.plant, task.over, _speeds(task.over, low)).max())
    cells = schedule(task.model, task.over, along="speed", nodes=SCHEDULE_CELLS)
    return fall if analysis.certify(task.gain, cells, Spec(rates=(-fall, 0.0))).stable else None


def proof_document(
    task: ProofTask,
    proof: "Certificate | None" = None,
    out: pathlib.Path | None = None,
    reason: str | None = None,
    further: FurtherFindings | None = None,
    **numbers: float | None,
) -> JsonObject:
    """Return the JSON document of a proof, whose parameters have the names of the linear model and SI units.

    Args:
        **numbers: Further values by key: "lower_bound", "gap", "residual" and "trace_cost" of a design.
    """
    summary: JsonObject = proof.summary() if proof else {}
    if proof:
        summary["worst_vertex"] = summary["worst_vertex"] or slowest_vertex(proof)
    coverage = task.polytope.coverage
    return {
        **console.describe_source(task.scenario),
        "gain": np.ravel(proof.gain).tolist() if proof else None,  # one input: the row is the gain
        "states": list(task.states),
        **{name: summary.get(name) for name in FROM_PROOF},
        **dict.fromkeys(FROM_DESIGN),
        **numbers,
        "reason": reason,
        "besides": further.document() if further else None,
        "period": task.polytope.period,
        "over": {path: list(ends) for path, ends in task.over.items()},
        "units": {path: spec.unit for path, spec, _ in parameters(task.model) if path in task.over},
        "vertices": task.polytope.vertices,
        "corners": [dict(corner) for corner in task.polytope.corners],
        "poles": list(proof.frozen) if proof else None,
        "coverage": dataclasses.asdict(coverage) if coverage else None,
        "exact": task.reduced.exact,
        "neglected": list(task.reduced.neglected),
        "versions": provenance.versions("cvxpy", "clarabel", "scipy"),
        "files": {"out": str(out)} if out and proof else {},
    }


def slowest_vertex(proof: "Certificate") -> JsonObject:
    """Return the vertex with the slowest pole, in the form of `worst_vertex` in the summary of a certificate.

    It stands in for `worst_vertex` where a proof about all vertices together has no worst vertex of its own. The keys
    are "index", "cell", "corner", "claim" and "margin". The margin is the distance [1/s] of that pole from the
    imaginary axis. For a sampled loop it is 1 - |z|.
    """
    index = int(np.argmax(proof.frozen))
    margin = (0.0 if proof.period is None else 1.0) - proof.frozen[index]
    corners = proof.cells[0].corners
    corner = dict(corners[index]) if corners else None
    return {"index": index, "cell": 0, "corner": corner, "claim": "poles", "margin": margin}


def describe_unproved(proof: "Certificate", spec: "Spec", further: FurtherFindings | None = None) -> str:
    """Return a sentence on required properties without a proof; empty if all are proved."""
    from diffabs.design.proof.schema import DISPROOF_KINDS

    stable, refuted = proof.quadratically_stable, any(proof.proved_data(*DISPROOF_KINDS))
    requirements = {
        "decay": (spec.decay > 0, f"decay = {spec.decay:g} 1/s", not refuted),
        "cost": (spec.Q is not None, "a guaranteed cost", True),
        "damping": (spec.damping > 0, f"damping = {spec.damping:g}", True),
    }
    unproved = [] if stable else [f"quadratic stability is {VERDICT_WORDS[stable]}"]
    if stable is False:
        unproved[0] += f": no common Lyapunov matrix exists for the {proof.cells[0].vertices} vertices"
        unproved[0] += ", so no Q and R give this gain by a design over these ranges"
    else:
        for kind, (required, words, still_open) in requirements.items():
            if required and not any(proof.proved_data(kind)):
                unproved.append(f"{words} is {VERDICT_WORDS[None if still_open else False]}")
    if not unproved:
        return ""
    if further and further.frozen.stable == further.frozen.systems:
        return f"{', '.join(unproved)}; that is not instability: {describe_frozen_stability(further)}"
    worst = slowest_vertex(proof)
    where = ", ".join(f"{name} {value:.6g}" for name, value in (worst["corner"] or {}).items())
    kind = "is unstable even with fixed parameters" if worst["margin"] <= 0 else "has the slowest pole"
    return f"{', '.join(unproved)}; vertex {worst['index']}{f' ({where})' if where else ''} {kind}"


def describe_frozen_stability(further: FurtherFindings) -> str:
    """Return a sentence on a gain whose frozen loops are all stable."""
    loops = further.frozen
    where = ", ".join(f"{name} {value:.6g}" for name, value in loops.at.items())
    sentence = f"each of {loops.systems} frozen systems is stable by its poles"
    sentence += f", the slowest decays at {loops.slowest:.4g} 1/s{f' ({where})' if where else ''}"
    if further.fall is None:
        return sentence
    return (
        f"{sentence}, and a Lyapunov matrix that follows the speed proves stability while the speed falls by at most"
        f" {further.fall:.4g} m/s^2, the most that friction allows"
    )


@contextlib.contextmanager
def report_design_errors() -> Iterator[None]:
    """Turn errors of `diffabs.design` into one line."""
    try:
        yield
    except ModuleNotFoundError as error:
        console.fail(" ".join(str(error).split()))
    except np.linalg.LinAlgError as error:
        console.fail(f"the linear algebra failed: {error}", console.FAILED)
    except ValueError as error:
        raise ScenarioError(str(error)) from None
