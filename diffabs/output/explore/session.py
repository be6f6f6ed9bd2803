"""A session of the explorer: a scenario, the edited values, and the scenario that follows. Independent of any page.

`put`, `switch` and `adopt` change a session, in one thread only. `scenario()` and a `Basis` are values: other threads
can compute with them during further edits.
"""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from diffabs.core.pytree import ParameterSpec, get, parameters, replace
from diffabs.core.types import PyTree
from diffabs.core.validity import find_problems
from diffabs.host.separated import read_decimal
from diffabs.host.values import ScenarioError, read_number_in_range, unknown_name_error, wrong_kind_error
from diffabs.loop.admissible import find_mismatches, find_unstable_step
from diffabs.loop.closed_loop import Loop
from diffabs.output.explore import friction, knobs, tuning
from diffabs.output.explore.knobs import Knob
from diffabs.output.explore.panels import Spread
from diffabs.scenario import registry
from diffabs.scenario.proving import certify_result
from diffabs.scenario.scenario import Scenario, load

CERTIFIED, REFUTED, UNDECIDED, NOT_PROVED = "certified", "refuted", "undecided", "unknown"
AS_GIVEN = "as in the scenario"
EXCHANGEABLE_FAMILIES = ("road", "controller")
PERCENT = ParameterSpec("%", low=0.0, high=90.0)


class ProofVerdict(NamedTuple):
    """The verdict of a proof for a loop: "certified", "refuted", "undecided" or "unknown", and a sentence."""

    word: str
    sentence: str


def prove_scenario(scenario: Scenario) -> ProofVerdict:
    """Return the verdict on a scenario's gain over the ranges of its [design], "unknown" without any certificate."""
    outcome = certify_result(scenario)
    sentence = outcome.sentence.partition(": ")[2]
    if not outcome.certified:
        return ProofVerdict(NOT_PROVED, sentence)
    words = {True: CERTIFIED, False: REFUTED, None: UNDECIDED}
    return ProofVerdict(words[outcome.document["quadratically_stable"]], sentence)


class Tools(NamedTuple):
    """The functions that need extras.

    Attributes:
        prove: Returns the verdict of a scenario.
        pose: Returns the runs and constraints of a scenario's [tune].
        judge: Returns the verdict of a proof's file on the values of a session; None without a file.
    """

    prove: Callable[[Scenario], ProofVerdict] = prove_scenario
    pose: Callable[[Scenario], tuning.TuningTask] = tuning.pose_tuning
    judge: "Callable[[Session], ProofVerdict] | None" = None


class Basis(NamedTuple):
    """A loaded scenario with its adjustable numbers, from which a session starts.

    Attributes:
        source: Path or name of the scenario.
        parts: Chosen part of each exchangeable family, or `AS_GIVEN`.
        original: Scenario as loaded.
        base: The same with a friction factor.
        knobs: Numbers by key.
        first: Keys of the numbers that the page shows at once.
    """

    source: str
    parts: dict[str, str]
    original: Scenario
    base: Scenario
    knobs: dict[str, Knob]
    first: list[str]


def load_basis(source: str, parts: Mapping[str, str] = MappingProxyType({})) -> Basis:
    """Return the basis of a session, which may be run unchanged.

    Args:
        parts: Name of a part by exchangeable family; a family that is missing, or `AS_GIVEN`, keeps the scenario's own.
    """
    scenario = dict.fromkeys(EXCHANGEABLE_FAMILIES, AS_GIVEN) | dict(parts)
    original = load(source, [f"{family}={part}" for family, part in scenario.items() if part != AS_GIVEN])
    base = friction.with_factor(original)
    numbers = knobs.knobs(base)
    return Basis(source, scenario, original, base, numbers, knobs.first_knobs(base, numbers))


class Session:
    """A scenario with edited numbers."""

    def __init__(self, source: str):
        """Load the scenario from the path or name `source`."""
        self.spread: Spread = Spread()
        self._begin(load_basis(source))

    def load_part(self, family: str, part: str) -> Basis:
        """Return this session's scenario with another road or controller, `family`; the session stays unchanged.

        `part` is a name, or `AS_GIVEN` for the scenario's own. The new part has its default values.
        """
        return load_basis(self.source, {**self.parts, family: part})

    def switch(self, basis: Basis) -> None:
        """Start again from another `basis`.

        If it is the same scenario with another part, changes of other parameters are kept. `check_edit` must follow.
        """
        changed = self._changed_values() if basis.source == self.source else {}
        replaced = tuple(f"{family}." for family, part in basis.parts.items() if part != self.parts[family])
        self._begin(basis)
        for path, _, _ in parameters(self._base.loop):
            if path in changed and not path.removeprefix("plant.").startswith(replaced):
                self._values[path] = changed[path]
        self.edited = next((knob for knob in self.knobs.values() if knob.path in self._values), None)

    def choices(self, family: str) -> list[str]:
        """Return the parts of a `family` that can be chosen, the scenario's own first.

        The list is empty if the loop has no part of this family.
        """
        has_family = family == "controller" or hasattr(self.original.loop.plant, family)
        return [AS_GIVEN, *sorted(registry.family_types(family))] if has_family else []

    def put(self, key: str, value: object) -> None:
        """Set the number `key` to `value` in its displayed unit; the loop is not checked.

        `check_edit` checks the loop and takes some milliseconds. `accept` or `withdraw` must follow it.
        """
        if key not in self.knobs:
            raise unknown_name_error(f"{key!r} is no number of this loop", key, self.knobs)
        self._put(key, self.knobs[key].read(value))

    def accept(self, loop: Loop) -> None:
        """Store the numbers of the `loop` as the state to which `withdraw` returns."""
        self._accepted = loop

    def withdraw(self) -> list[str]:
        """Return to the last accepted numbers, and return the keys of the numbers that changed."""
        before = {key: self.value(key) for key in self.knobs}
        self.adopt(self._accepted)
        return [key for key, value in before.items() if value != self.value(key)]

    def widen(self, name: str, percent: PyTree) -> None:
        """Set the spread of the fan's members in `name` ("mass" or "road") in percent."""
        try:
            value = read_decimal(percent) if isinstance(percent, str) else float(percent)
        except (TypeError, ValueError):
            raise wrong_kind_error(f"fan.{name}", percent, f"a number in {PERCENT.interval()}") from None
        self.spread = dataclasses.replace(
            self.spread, **{name: read_number_in_range(value, PERCENT, f"fan.{name}") / 100}
        )

    def adopt(self, loop: Loop) -> None:
        """Set all parameters to those of another `loop` with the same parts, and accept them."""
        self._start(loop, {path: np.asarray(value, float) for path, _, value in parameters(loop)})

    def reset(self) -> None:
        """Return to the numbers of the scenario."""
        self._start(self._base.loop, {})

    def scenario(self) -> Scenario:
        """Return the scenario with the current numbers."""
        values = {path: value if value.ndim else float(value) for path, value in self._values.items()}
        return dataclasses.replace(self._base, loop=replace(self._base.loop, values)) if values else self._base

    def to_save(self) -> Scenario:
        """Return the scenario for a file, without a friction factor of 1."""
        now = self.scenario()
        changed = bool(self._changed_values()) or any(part != AS_GIVEN for part in self.parts.values())
        return friction.without_factor(now.with_loop(now.loop, "explored") if changed else now, self.original)

    def value(self, key: str) -> float:
        """Return the current value of the number `key` in SI."""
        knob = self.knobs[key]
        value = self._values.get(knob.path)
        return knob.pick(get(self._base.loop, knob.path) if value is None else value)

    def _begin(self, basis: Basis) -> None:
        self.source: str = basis.source
        self.parts: dict[str, str] = basis.parts
        self.original: Scenario = basis.original
        self._base: Scenario = basis.base
        self.knobs: dict[str, Knob] = basis.knobs
        self.first: list[str] = basis.first
        self.reset()

    def _start(self, accepted: Loop, values: dict[str, np.ndarray]) -> None:
        self.accept(accepted)
        self._values = values
        self.edited: Knob | None = None  # number edited last since then

    def _put(self, key: str, value: float) -> None:
        knob = self.knobs[key]
        values = self._values.get(knob.path)
        new = np.array(get(self._base.loop, knob.path) if values is None else values, float)
        new[() if knob.place is None else knob.place] = value
        # A new dict and a new array: threads may still use the old ones.
        self._values, self.edited = {**self._values, knob.path: new}, knob

    def _changed_values(self) -> dict[str, np.ndarray]:
        """Return the parameters [SI] that differ from the scenario's, by path."""
        loop = self._base.loop
        return {path: value for path, value in self._values.items() if not np.array_equal(value, get(loop, path))}


def check_edit(knob: Knob, scenario: Scenario) -> None:
    """Check that a scenario may be run."""
    if lines := objections(scenario):
        raise ScenarioError(f"{knob.name} = {knob.words(knob.pick(get(scenario.loop, knob.path)))}: {lines[0]}")


def objections(scenario: Scenario) -> list[str]:
    """Return the reasons why a scenario must not be run, one line each; empty if it may be run.

    The command line would give the same lines.
    """
    lines = list(find_problems(scenario.loop)) or list(find_mismatches(scenario.loop, scenario.solver))
    return lines or list(find_unstable_step(scenario.loop, scenario.solver))
