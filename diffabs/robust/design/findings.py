"""What is known of a gain besides its certificate: frozen loops and the permitted fall of the speed, in words, too."""

from typing import NamedTuple

import numpy as np

from diffabs.core.types import JsonObject
from diffabs.robust.design import analysis
from diffabs.robust.design.frozen import FrozenLoops, analyse_frozen_loops
from diffabs.robust.design.loop_task import ProofTask, greatest_decelerations, speeds_of_box
from diffabs.robust.design.parameter_box import schedule
from diffabs.robust.design.proof.certificate import Certificate
from diffabs.robust.design.proof.schema import DISPROOF_KINDS
from diffabs.robust.design.spec import Spec

SCHEDULE_CELLS = 8  # cells of the speed range; the Lyapunov matrix is linear in the speed in each cell
VERDICT_WORDS: dict[bool | None, str] = {True: "proved", False: "disproved", None: "undecided"}


class FurtherFindings(NamedTuple):
    """Results on a gain that do not rest on a common Lyapunov matrix.

    Attributes:
        frozen: Poles of the closed loops at fixed parameters.
        fall: Greatest fall of the speed [m/s^2] that friction and resistances allow, if stability is proved for all
            falls up to it. The proof uses a Lyapunov matrix that depends on the speed. None if it fails or does not
            apply.
    """

    frozen: FrozenLoops
    fall: float | None

    def document(self) -> JsonObject:
        """Return the findings as JSON values."""
        return {"frozen": self.frozen._asdict(), "proved_for_a_speed_falling_by": self.fall}


def find_further(task: ProofTask, proof: Certificate) -> FurtherFindings | None:
    """Return results on a gain without a proved common Lyapunov matrix; None with one, because it implies more."""
    if proof.quadratically_stable:
        return None
    loops = analyse_frozen_loops(task.gain, task.model, task.over)
    return FurtherFindings(loops, permitted_speed_fall(task) if loops.stable == loops.systems else None)


def permitted_speed_fall(task: ProofTask) -> float | None:
    """Return the greatest fall of the speed [m/s^2] in the box, if stability is proved for it; else None.

    The Lyapunov matrix of the proof is piecewise linear in the speed. A sampled loop, or a box without a range of the
    speed, has no such proof.
    """
    low, high = task.over.get("speed", (0.0, 0.0))
    if not 0 < low < high or task.polytope.period is not None:
        return None
    fall = float(greatest_decelerations(task.loop.plant, task.over, speeds_of_box(task.over, low)).max())
    cells = schedule(task.model, task.over, along="speed", nodes=SCHEDULE_CELLS)
    return fall if analysis.certify(task.gain, cells, Spec(rates=(-fall, 0.0))).stable else None


def slowest_vertex(proof: Certificate) -> JsonObject:
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


def describe_unproved(proof: Certificate, spec: Spec, further: FurtherFindings | None = None) -> str:
    """Return a sentence on required properties without a proof; empty if all are proved."""
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
