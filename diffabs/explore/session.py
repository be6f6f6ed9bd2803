"""What one person explores: a scenario, the values that were turned, and what follows from them. Knows no page.

A session is changed by `turn`, `choose` and `adopt`; `scenario()` is what it stands for at that moment, a value that
threads may compute with while one goes on turning."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from diffabs.core.loop import Loop
from diffabs.core.pytree import Spec, get, replace
from diffabs.core.validity import find_problems
from diffabs.core.values import ScenarioError, read_number_in_range, unknown_name_error, wrong_kind_error
from diffabs.explore import friction, knobs, tuning
from diffabs.explore.curves import Spread
from diffabs.explore.knobs import Knob
from diffabs.scenario import registry
from diffabs.scenario.scenario import Scenario, load
from diffabs.simulate.admissible import find_mismatches, find_unstable_step

CERTIFIED, REFUTED, UNDECIDED, NOT_PROVED = "certified", "refuted", "undecided", "unknown"
AS_GIVEN = "as in the scenario"
EXCHANGEABLE_FAMILIES = ("road", "controller")
PERCENT = Spec("%", low=0.0, high=90.0)


class ProofVerdict(NamedTuple):
    """What can be proved of a loop: one of the four words above, and a sentence."""

    word: str
    sentence: str


class Tools(NamedTuple):
    """What needs extras: a proof of a scenario; the lanes and constraints of its [tune]."""

    prove: Callable[[Scenario], ProofVerdict]
    pose: Callable[[Scenario], tuning.TuningTask]


class Session:
    """A scenario with its numbers turned."""

    def __init__(self, source: str):
        """The scenario in a file, or a packaged one. Raises ScenarioError."""
        self.spread = Spread()
        self.open(source)

    def open(self, source: str) -> None:
        """Begin anew with another scenario. Raises ScenarioError, and then nothing has changed."""
        self._begin(source, {}, load(source))

    def choose(self, family: str, part: str) -> None:
        """Put another road or controller into the loop, with its usual numbers, or that of the scenario; other numbers
        stay as they were turned. Raises ScenarioError for one that does not fit, and then nothing has changed."""
        chosen = {**self.parts, family: part}
        overrides = [f"{name}={kind}" for name, kind in chosen.items() if kind != AS_GIVEN]
        turned = self._turned()
        self._begin(self.source, chosen, load(self.source, overrides))
        for key, value in turned.items():
            if key in self.knobs and not key.startswith((f"{family}.", f"plant.{family}.")):
                self._put(key, value)
        self.accept(self.scenario().loop)

    def choices(self, family: str) -> list[str]:
        """Return the parts that can be chosen, that of the scenario first; none where the loop has no such part."""
        there = family == "controller" or hasattr(self.given.loop.plant, family)
        return [AS_GIVEN, *sorted(registry.family_types(family))] if there else []

    def turn(self, key: str, given: Any) -> float:
        """Give a number another value, as it is shown, and return it in SI. Raises ScenarioError that names the field,
        and then nothing has changed."""
        value = self.put(key, given)
        now = self.scenario()
        try:
            self.judge(key, now)
        except ScenarioError:
            self.withdraw()
            raise
        self.accept(now.loop)
        return value

    def put(self, key: str, given: Any) -> float:
        """The same, but only look at the value itself; `judge` takes some milliseconds, and `accept` or `withdraw` must
        follow it."""
        if key not in self.knobs:
            raise unknown_name_error(f"{key!r} is no number of this loop", key, self.knobs)
        value = self.knobs[key].read(given)
        self._put(key, value)
        return value

    def judge(self, key: str, chosen: Scenario) -> None:
        """Raises ScenarioError for a scenario of this session that must not be run, which names the number that was
        turned last."""
        if lines := objections(chosen):
            knob = self.knobs[key]
            text = knob.text(_value(get(chosen.loop, knob.path), knob))
            raise ScenarioError(f"{knob.name} = {text} {knob.spec.unit}: {lines[0]}".replace(" 1:", ":"))

    def accept(self, loop: Loop) -> None:
        """Let `withdraw` come back to these numbers."""
        self._accepted = loop

    def withdraw(self) -> list[str]:
        """Go back to what was accepted last, and return the numbers that changed by that."""
        before = {key: self.value(key) for key in self.knobs}
        self.adopt(self._accepted)
        return [key for key, value in before.items() if value != self.value(key)]

    def widen(self, name: str, given: Any) -> None:
        """Say how far the members of the fan differ in "mass" or "road" [%]. Raises ScenarioError."""
        try:
            value = float(given)
        except (TypeError, ValueError):
            raise wrong_kind_error(f"fan.{name}", given, f"a number in {PERCENT.interval()}") from None
        self.spread = dataclasses.replace(
            self.spread, **{name: read_number_in_range(value, PERCENT, f"fan.{name}") / 100}
        )

    def adopt(self, loop: Loop) -> None:
        """Take over the numbers of another loop of the same parts."""
        self.accept(loop)
        self._values = {knob.path: np.asarray(get(loop, knob.path), float) for knob in self.knobs.values()}

    def reset(self) -> None:
        """Go back to the numbers of the scenario."""
        self._values = {}
        self.accept(self._base.loop)

    def scenario(self) -> Scenario:
        """Return the scenario with the numbers as they were turned."""
        values = {path: value if value.ndim else float(value) for path, value in self._values.items()}
        return dataclasses.replace(self._base, loop=replace(self._base.loop, values)) if values else self._base

    def to_save(self) -> Scenario:
        """Return the scenario as it is written to a file; a friction factor of one is left out. Raises ScenarioError
        for one that must not be run."""
        now = self.scenario()
        if lines := objections(now):
            raise ScenarioError(lines[0])
        changed = bool(self._turned()) or any(part != AS_GIVEN for part in self.parts.values())
        return friction.without_factor(now.with_loop(now.loop, "explored") if changed else now, self.given)

    def value(self, key: str) -> float:
        """Return a number in SI."""
        knob = self.knobs[key]
        value = self._values.get(knob.path)
        return _value(get(self._base.loop, knob.path) if value is None else value, knob)

    def _begin(self, source: str, parts: Mapping[str, str], given: Scenario) -> None:
        self.source, self.given = source, given
        self.parts = dict.fromkeys(EXCHANGEABLE_FAMILIES, AS_GIVEN) | dict(parts)
        self._base = friction.with_factor(given)
        self.knobs: dict[str, Knob] = knobs.knobs(self._base)
        self.first = knobs.first_knobs(self._base, self.knobs)
        self._values: dict[str, np.ndarray] = {}
        self.accept(self._base.loop)

    def _put(self, key: str, value: float) -> None:
        knob = self.knobs[key]
        there = self._values.get(knob.path)
        new = np.array(get(self._base.loop, knob.path) if there is None else there, float)
        new[() if knob.place is None else knob.place] = value
        self._values = {**self._values, knob.path: new}

    def _turned(self) -> dict[str, float]:
        """The numbers that are not the scenario's, by their paths."""
        loop = self._base.loop
        changed = {path for path, value in self._values.items() if not np.array_equal(value, get(loop, path))}
        return {key: self.value(key) for key, knob in self.knobs.items() if knob.path in changed}


def _value(value: Any, knob: Knob) -> float:
    return float(np.asarray(value, float)[() if knob.place is None else knob.place])


def objections(chosen: Scenario) -> list[str]:
    """Return why a scenario must not be run, a line each: as a file with these numbers would be refused."""
    lines = list(find_problems(chosen.loop)) or list(find_mismatches(chosen.loop, chosen.solver))
    return lines or list(find_unstable_step(chosen.loop, chosen.solver))
