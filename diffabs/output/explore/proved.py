"""A proof's file and the values on the page: whether they lie in its box, and the bounds proved there."""

import functools
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from diffabs.core.pytree import get, parameters, replace
from diffabs.core.types import JsonObject
from diffabs.loop.closed_loop import Loop
from diffabs.output.explore import friction
from diffabs.output.explore.knobs import unit_words
from diffabs.output.explore.session import CERTIFIED, NOT_PROVED, ProofVerdict, Session
from diffabs.robust.reach.verification import ProofFile, read_proof
from diffabs.scenario.proofs import read_proof_document
from diffabs.scenario.scenario import Scenario, loads


class ProvedBox(NamedTuple):
    """A proof's file, which nobody has verified here.

    Attributes:
        name: Name of the file, for the page.
        content: Box, cells and bounds.
        scenario: Scenario of the file.
    """

    name: str
    content: ProofFile
    scenario: Scenario


def load_judge(path: pathlib.Path) -> Callable[[Session], ProofVerdict]:
    """Return the function that judges a session by a proof's file. Raises ValueError for another file."""
    document = read_proof_document(path)
    if document is None:
        raise ValueError("is no certificate of prove" if path.exists() else "there is no such file")
    return functools.partial(judge_values, load_proved_box(path, document))


def load_proved_box(path: pathlib.Path, document: JsonObject) -> ProvedBox:
    """Return the content of a proof's file."""
    content = read_proof(document)
    return ProvedBox(
        str(path), content, loads(str(document.get("scenario")).encode(), path.stem, str(path), integrated=False)
    )


def judge_values(proved: ProvedBox, session: Session) -> ProofVerdict:
    """Return whether the current values of a session lie in the box of a proof: "certified", else "unknown".

    They do if each of the box's parameters lies in its range. The duration and the rest of the loop must be those of
    the file's scenario. The sentence gives the file's bounds, or the value that differs.
    """
    now = friction.without_factor(session.scenario(), session.original)
    here, proved_loop, over = now.loop, proved.scenario.loop, proved.content.over
    if differs := _find_difference(here, proved_loop, over) or _compare_durations(now, proved.scenario):
        return ProofVerdict(NOT_PROVED, f"{proved.name} is about {differs}")
    for path, (low, high) in over.items():
        if not low <= (value := float(np.asarray(get(here, path)))) <= high:
            sentence = (
                f"outside of the proved box: {_show(session, path, value)} is not in {_range(session, path, low, high)}"
            )
            return ProofVerdict(NOT_PROVED, f"{sentence}, by {proved.name}")
    box = ", ".join(f"{path} {_range(session, path, *ends)}" for path, ends in over.items())
    stated = ", ".join(proved.content.statements)
    return ProofVerdict(CERTIFIED, f"{stated} for {box}, by {proved.name}; verify with diffabs verify {proved.name}")


def _find_difference(here: Loop, proved_loop: Loop, over: dict[str, tuple[float, float]]) -> str:
    """Return in which value outside of the box two loops differ, empty if in none."""
    fixed = {path: low for path, (low, _) in over.items()}
    paths = {path for path, _, _ in parameters(here)}
    if not fixed.keys() <= paths or jax.tree.structure(replace(here, fixed)) != jax.tree.structure(
        replace(proved_loop, fixed)
    ):
        return "another loop"
    for path, spec, value in parameters(here):
        proved_value = get(proved_loop, path)
        if path not in over and not np.array_equal(np.asarray(value, float), np.asarray(proved_value, float)):
            proved_text, shown = (
                f"{_text(number)} {unit_words(spec.unit)}".rstrip() for number in (proved_value, value)
            )
            return f"{path} = {proved_text}, here it is {shown}"
    equal_leaves = (
        np.array_equal(a, b)
        for a, b in zip(*map(jax.tree.leaves, (replace(here, fixed), replace(proved_loop, fixed))), strict=True)
    )
    return "" if all(equal_leaves) else "another loop"


def _compare_durations(now: Scenario, proved: Scenario) -> str:
    """Return the difference of two durations, empty if there is none."""
    ends = float(now.solver.duration), float(proved.solver.duration)
    return "" if ends[0] == ends[1] else f"runs of {ends[1]:g} s, here they last {ends[0]:g} s"


def _text(value: object) -> str:
    return ", ".join(f"{x:.6g}" for x in np.ravel(np.asarray(value, float)))


def _show(session: Session, path: str, value: float) -> str:
    """Return a parameter with its value in the displayed unit."""
    knob = session.knobs.get(path)
    return f"{path} = {knob.words(value)}" if knob else f"{path} = {value:.6g}"


def _range(session: Session, path: str, low: float, high: float) -> str:
    """Return a range in the displayed unit."""
    knob = session.knobs.get(path)
    return f"{knob.text(low)} to {knob.words(high)}" if knob else f"{low:.6g} to {high:.6g}"
