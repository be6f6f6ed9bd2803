"""Proofs over a box from the loop to the file and back: prove, save, verify.

    proof = prove_box(loop, solver, {"plant.mass": (5.3, 6.2)}, [RunClaim("greatest slip", 0.3)], budget=60.0)
    proof.save("slip.proof")
    verify("slip.proof").proved

The file has the loop as the TOML text of a scenario, so it stands on its own. `verify` also reads certificates of
linear designs.
"""

import dataclasses
import math
import os
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.types import JsonObject
from diffabs.engine.solvers import Solver
from diffabs.host import documents, files
from diffabs.host.values import ScenarioError
from diffabs.loop.closed_loop import Loop
from diffabs.parts.objectives import default_objectives
from diffabs.robust.design.verify import MAX_SECONDS, ClaimVerdict, verify_file
from diffabs.robust.reach.certificate import FORMAT, certificate_document
from diffabs.robust.reach.cover import BoxProof, RunClaim, cover_box
from diffabs.robust.reach.equations import derive_equations
from diffabs.robust.reach.extremes import ExtremeRuns, find_extreme_runs
from diffabs.robust.reach.verification import FileVerdict
from diffabs.scenario.scenario import Scenario, dump, loads

BOX_PROOF = "box proof"  # kind of the documents that `Proof.save` writes
FREQUENCY_PROOF = "frequency proof"  # kind of the documents that `FrequencyProof.save` writes
BOX_SHARE = 0.01  # of the cells of a box, which `verify` checks by default
MAX_PROOF_BYTES = 2**28  # of a file that is read; some million cells

Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True, eq=False)
class Proof:
    """What is proved about all runs of a loop over a box.

    Attributes:
        loop: Loop.
        solver: Solver of the runs with which the proof is compared; its duration is that of every run.
        over: Range (low, high) of each parameter, by path, in SI units.
        claims: Claims of the proof.
        extremes: Extreme runs of a grid over the box.
        cover: Proved cells with their bounds.
    """

    loop: Loop
    solver: Solver
    over: Mapping[str, tuple[float, float]]
    claims: tuple[RunClaim, ...]
    extremes: ExtremeRuns
    cover: BoxProof

    @property
    def verdict(self) -> str:
        """The verdict: proved, refuted or undecided."""
        return self.cover.verdict

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Proved range (low, high) of each quantity; infinite ends where nothing is proved."""
        return self.cover.bounds

    @property
    def share_left(self) -> float:
        """Share of the box, by volume, that is not proved."""
        widths = np.array([high - low for low, high in self.over.values()])
        undecided = self.cover.undecided
        return float(((undecided[:, :, 1] - undecided[:, :, 0]) / np.where(widths > 0, widths, 1)).prod(1).sum())

    @property
    def reason(self) -> str:
        """Why the claims are not proved: the part of the box that refutes one, or is left; empty if they are proved."""
        cover = self.cover
        if self.verdict == "refuted" and cover.refuting is not None:
            return "every run violates the claim where " + ", ".join(
                f"{path} = {low:.6g}" if low == high else f"{path} in [{low:.6g}, {high:.6g}]"
                for path, (low, high) in zip(self.over, cover.refuting, strict=True)
            )
        if self.verdict == "proved" or not len(cover.undecided):
            return "" if self.verdict == "proved" else cover.failure
        cells = "one cell" if len(cover.undecided) == 1 else f"{len(cover.undecided):,} cells"
        failure = f" ({cover.failure})" if cover.failure else ""
        more = "; a greater --budget goes on" if len(cover.cells) else ""
        return f"{100 * self.share_left:.3g} % of the box is left in {cells}{failure}{more}"

    def unit_of(self, quantity: str) -> str:
        """Return the unit of a quantity of the proof, empty if the plant declares none."""
        units = {"stop_time": "s", "stop_distance": "m", **self.loop.plant.shows.units}
        return units.get(quantity.split()[-1], "")

    def record(self) -> JsonObject:
        """Return verdict, claims and bounds as JSON values; a bound that is not proved is None.

        A bound beside extreme runs has these, and `looseness`: by how much the proved bound exceeds the worst run,
        relative to it.
        """
        cover = self.cover
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "over": {path: list(ends) for path, ends in self.over.items()},
            "claims": [claim._asdict() for claim in self.claims],
            "bounds": {name: self._bound_record(name, *ends) for name, ends in self.bounds.items()},
            "refuted_by": None
            if cover.refuting is None
            else dict(zip(self.over, cover.refuting.tolist(), strict=True)),
            "cells": len(cover.cells),
            "left": len(cover.undecided),
            "share_left": self.share_left,
            "tried": cover.tried,
            "seconds": cover.seconds,
        }

    def _bound_record(self, name: str, low: float, high: float) -> JsonObject:
        proved = {end: x if math.isfinite(x) else None for end, x in (("low", low), ("high", high))}
        record = {**proved, "unit": self.unit_of(name)}
        if name in self.extremes.ranges:
            least_run, worst = self.extremes.ranges[name]
            looseness = (high - worst) / worst if worst and math.isfinite(high) else None
            record |= {"least_run": least_run, "worst_run": worst, "looseness": looseness}
        return record

    def save(self, path: str | os.PathLike[str], scenario: Scenario | None = None) -> None:
        """Write the file from which `verify` proves the bounds again, complete or not at all.

        Args:
            path: File to write.
            scenario: Scenario of the loop, for its name and its other sections; by default one of the loop alone.

        Raises:
            OSError: The file cannot be written.
            ScenarioError: A part of the loop has no name in scenarios; `register_parts` gives it one.
        """
        if scenario is None:
            measured = default_objectives(self.loop.plant)
            scenario = Scenario("loop", loop=self.loop, solver=self.solver, objectives=measured)
        document = certificate_document(self.cover, dump(scenario), self.over, self.claims)
        files.write_file(pathlib.Path(path), f"{documents.format_document(document, None)}\n".encode())


def prove_box(
    loop: Loop,
    solver: Solver,
    over: Mapping[str, tuple[float, float]],
    claims: Sequence[RunClaim] = (),
    budget: float = 60.0,
    *,
    signals: Sequence[str] | None = None,
    progress: Progress = lambda line: None,
) -> Proof:
    """Return what can be proved about all runs of a loop over a box within the budget.

    A grid of runs shows first how far the bounds can become narrower, and which cells may violate a claim.

    Args:
        loop: Closed loop with concrete parameters.
        solver: Solver of these runs; a run that has not stopped after its duration is no longer followed.
        over: Range (low, high) of each parameter of the box, by path, in SI units.
        claims: Statements to decide. Without one, the bounds are refined for the whole budget.
        budget: Computing time [s] of the proof.
        signals: Further signals whose range is wanted, by name; by default the slip, if there is one.
        progress: Called with a line about how far the proof is.

    Raises:
        ValueError: A number is out of its range, a claim is about no quantity of the loop, a signal does not exist, or
            there is neither claim nor signal.
        NoRule: A part, an operation or a parameter of the loop has no sound rule.
        NoCompiler: No C++ compiler of this machine works.

    See also:
        `verify`: The proof of a saved file again, by independent code.
        `reach.cover_box`: The proof alone, without runs.
        `tune.worst_case`: The worst run that a search finds, a bound from the other side.

    Notes:
        The runs are those of `reach.extremes.find_extreme_runs`, and the proof that of `reach.cover_box`, which names
        method and source. The bounds hold for the exact solution of the loop, whatever the solver's steps are.

    Examples:
        The published gain of a laboratory brake keeps the slip below 0.31 for all masses of 5.75 to 5.76 kg:

        >>> from diffabs.robust.reach import RunClaim
        >>> from diffabs.scenario import load, prove_box
        >>> scenario = load("slip-lmi", ["solver.duration=2"])
        >>> claims = [RunClaim("greatest slip", 0.31)]
        >>> prove_box(scenario.loop, scenario.solver, {"plant.mass": (5.75, 5.76)}, claims).verdict
        'proved'
    """
    derive_equations(loop, over)  # may refuse the loop, before anything is simulated
    if signals is None:
        signals = [name for name in loop.plant.shows._fields if name == "slip"]
    if not (claims or signals):
        raise ScenarioError(f"a claim is needed: the plant has no slip; it has {', '.join(loop.plant.shows._fields)}")
    extremes = find_extreme_runs(loop, solver, over)
    cover = cover_box(
        loop, over, claims, signals=signals, horizon=solver.duration, budget=budget,
        extremes=extremes.ranges, suspects=extremes.points, progress=progress,
    )  # fmt: skip
    return Proof(loop, solver, over, tuple(claims), extremes, cover)


class Verification(NamedTuple):
    """The findings about a file.

    Attributes:
        claims: A verdict for each statement of the file, in its order.
        complete: Whether everything was proved again, and not only a sample of the cells of a box.
        reason: Why the file is not proved; empty if it is, or if only a sample was proved again.
        scenario: Scenario of a proof over a box; None for a certificate.
        text: TOML text of this scenario.
        over: Ranges of the box by path; empty for a certificate.
    """

    claims: tuple[ClaimVerdict, ...]
    complete: bool
    reason: str
    scenario: Scenario | None = None
    text: str = ""
    over: Mapping[str, tuple[float, float]] = {}

    @property
    def proved(self) -> bool:
        """Whether nothing that was checked failed."""
        return not self.reason

    def record(self) -> JsonObject:
        """Return the findings as JSON values; those about a proof over a box have the box and its scenario, too."""
        box = {}
        if self.scenario:
            over = {path: list(ends) for path, ends in self.over.items()}
            box = {"complete": self.proved and self.complete, "scenario": self.text, "over": over}
        claims = [{**verdict._asdict(), "proved": not verdict.reason} for verdict in self.claims]
        return {"proved": self.proved, **box, "claims": claims}


def verify(
    path: str | os.PathLike[str],
    *,
    share: float | None = None,
    seconds: float = MAX_SECONDS,
    progress: Progress = lambda line: None,
    processes: int = 1,
) -> Verification:
    """Prove a saved proof again, by code that is independent of the code that made it.

    Args:
        path: File of `Proof.save` or `FrequencyProof.save`, or certificate of `design` or `certify`.
        share: Of a box: share of its cells to check, in (0, 1]; by default 0.01, and 1 of a proof over all frequencies.
        seconds: Of a certificate: limit of the computing time [s]; then nothing is proved.
        progress: Called with a line about how far the check is.
        processes: Number of processes that check cells at the same time.

    Raises:
        ValueError: The file is none of these, or is about a loop without rules.
        ModuleNotFoundError: python-flint is not installed, for a proof over a box.

    See also:
        `prove_box`: A proof that can be saved.
        `design.Certificate`: Certificates about linear models.
    """
    document = read_proof_document(path, (BOX_PROOF, FREQUENCY_PROOF))
    if document is not None and documents.kind_of(document) == FREQUENCY_PROOF:
        return _verify_frequency_file(document, pathlib.Path(path).stem, 1.0 if share is None else share, progress)
    if document is not None:
        share = BOX_SHARE if share is None else share
        return _verify_box_file(document, pathlib.Path(path).stem, share, progress, processes)
    verdicts = tuple(verify_file(path, seconds))
    reason = "; ".join(f"{verdict.kind}: {verdict.reason}" for verdict in verdicts if verdict.reason)
    return Verification(verdicts, True, reason if verdicts else "the file has no claims")


def read_proof_document(path: str | os.PathLike[str], kinds: Sequence[str] = (BOX_PROOF,)) -> JsonObject | None:
    """Return the content of a file that `Proof.save` wrote, or of another of `kinds`; None for any other file.

    Raises:
        DocumentError: The file is of a version that this release does not read, or a document of another kind.
    """
    try:
        document = documents.read_document(path, MAX_PROOF_BYTES)
    except documents.DocumentError:
        raise
    except (OSError, ValueError):
        return None
    kind = documents.kind_of(document)
    if kind not in ("", *kinds):
        raise documents.DocumentError(
            f'format = "{document["format"]}" is no proof; "{FORMAT}" or "diffabs certificate" is needed'
        )
    return document if kind else None


def _verify_box_file(document: JsonObject, name: str, share: float, progress: Progress, processes: int) -> Verification:
    """Check a proof over a box. The runs that would show a false bound come first: their cells are proved again."""
    from diffabs.robust.reach import checker as checker  # needs python-flint: refuses before anything is simulated
    from diffabs.robust.reach.verification import read_proof, verify_box

    text: Any = document.get("scenario")
    if not isinstance(text, str):
        raise ValueError("scenario is missing or no text; the TOML text of a scenario is needed")
    scenario = loads(text.encode(), name, "scenario", integrated=False)
    over = read_proof(document).over
    derive_equations(scenario.loop, over)  # refuses a loop or a box without rules before anything is simulated
    extremes = find_extreme_runs(scenario.loop, scenario.solver, over)
    verdict = verify_box(
        scenario.loop, scenario.solver.duration, document, share,
        suspects=extremes.points, extremes=extremes.ranges, progress=progress, processes=processes,
    )  # fmt: skip
    return _describe_cells(verdict, scenario, text, over)


def _verify_frequency_file(document: JsonObject, name: str, share: float, progress: Progress) -> Verification:
    """Check proofs over all frequencies."""
    from diffabs.robust.frequency.certificate import read_frequency_file
    from diffabs.scenario.frequency_proofs import verify_frequency_document

    verdict, scenario, text = verify_frequency_document(document, name, share, progress)
    return _describe_cells(verdict, scenario, text, read_frequency_file(document).over)


def _describe_cells(
    verdict: FileVerdict, scenario: Scenario, text: str, over: Mapping[str, tuple[float, float]]
) -> Verification:
    """Return the findings about a file whose cells were checked."""
    says = f"{verdict.checked:,} of {verdict.cells:,} cells proved again"
    whole = verdict.checked == verdict.cells
    says += "; --share 1 proves all" if not verdict.reason and not whole else ""
    claims = tuple(ClaimVerdict(statement, says, verdict.reason) for statement in verdict.statements)
    return Verification(claims, whole, verdict.reason, scenario, text, over)
