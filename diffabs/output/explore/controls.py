"""The left column: choice of scenario, road and controller, and a slider and a field for each number."""

import pathlib
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from typing import Any

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.core.types import JsonObject, Scalar
from diffabs.output.explore.knobs import SLIDER_STEPS, Knob, unit_words
from diffabs.output.explore.panels import Fan
from diffabs.output.explore.session import AS_GIVEN, EXCHANGEABLE_FAMILIES, Basis, Session, load_basis
from diffabs.scenario.scenario import names

CHANGE_INTERVAL_S = 0.016  # interval between events of a slider, one frame of the screen
MASS, ROAD = "mass", "road"

Turned = Callable[[str, Any, int], None]
Replaced = Callable[[Callable[[], Basis]], Awaitable[None]]
Widened = Callable[[str, Any], bool]


class Controls:
    """Sliders and fields of a session's numbers.

    `turned` is called for each changed number, and `replaced` for a change that rebuilds all numbers. `widened` is
    called for another spread of the fan, and returns whether it is valid.
    """

    def __init__(self, session: Session, turned: Turned, replaced: Replaced, widened: Widened):
        """Prepare the controls of a `session` with their callbacks; the page stays unchanged."""
        self.session = session
        self._change = turned
        self._replaced = replaced
        self._widen = widened
        self.fields: JsonObject = {}
        self.sliders: JsonObject = {}
        self.refused: dict[str, Callable[[], None]] = {}  # by name of a marked field: shows its valid value again
        self.sources: list[str] = list(dict.fromkeys([session.source, *names()]))

    def build(self) -> None:
        """Put the controls into the open column."""
        self.message: ui.label = ui.label().classes("refused").props("data-id=refused")
        self.message.set_visibility(False)
        self.inside: ui.element = ui.element("div").classes("rows")
        self._fill()

    def rebuild(self, fan: str = "") -> None:
        """Fill the column again from the session: with other numbers, or with the old choice after a refused one.

        `fan` is the line about the fan.
        """
        self.inside.clear()
        self._fill()
        self.fan_note.set_text(fan)

    def show(self, key: str) -> None:
        """Show the current value of the number `key` in its field and slider."""
        knob, value = self.session.knobs[key], self.session.value(key)
        self.refused.pop(key, None)
        if key in self.fields:
            self.fields[key].props(remove="error")
            self.fields[key].set_value(knob.text(value))
        if key in self.sliders and abs(self.sliders[key].value - knob.place_of(value)) > 0.5:
            self.sliders[key].set_value(knob.place_of(value))

    def show_all(self) -> None:
        """Show the current value of every number."""
        for key in self.fields:
            self.show(key)

    def show_refusal(self, line: str) -> None:
        """Show why an input was refused; an empty `line` hides the message and the refused values."""
        self.message.set_text(line)
        self.message.set_visibility(bool(line))
        if not line:
            for show_valid in [*self.refused.values()]:
                show_valid()

    def wrong(self, key: str) -> None:
        """Mark the field of the refused number `key`."""
        if key in self.fields:
            self.fields[key].props("error")
            self.refused[key] = partial(self.show, key)

    def fan(self, fan: Fan | None) -> None:
        """Show the number of members of the fan, and the parameters that differ between them."""
        if fan is None:
            self.fan_note.set_text("no fan: nothing differs between its runs")
            return
        lost = [f"; {n} {words}" for n, words in ((fan.refused, "refused"), (fan.diverged, "diverged")) if n]
        self.fan_note.set_text(f"{fan.members} members, {fan.words}{''.join(lost)}")

    def _fill(self) -> None:
        self.fields, self.sliders, self.refused = {}, {}, {}
        with self.inside:
            # A choice of scenario, road or controller replaces all numbers.
            labels = {source: pathlib.Path(source).name for source in self.sources}
            self._chooser("scenario", labels, self.session.source, load_basis)
            for family in EXCHANGEABLE_FAMILIES:
                if choices := self.session.choices(family):
                    self._chooser(family, choices, self.session.parts[family], partial(self.session.load_part, family))
            for note in self.session.original.notes:
                ui.label(note).classes("note")
            # How far the members of the fan spread around the current values.
            ui.label("fan of 200 runs").classes("group")
            words = {MASS: "masses differ by ±", ROAD: "friction differs by ±"}
            spreads = [MASS, ROAD] if AS_GIVEN in self.session.choices("road") else [MASS]
            for name in spreads:
                with ui.element("div").classes("spread"):
                    ui.label(words[name])
                    field = ui.input(value=self._spread(name)).props("dense outlined")
                    field.props["data-id"] = f"fan-{name}"
                    field.on("change", lambda _, name=name, field=field: self._take_spread(name, field))
                    ui.label("%").classes("unit")
            self.fan_note = ui.label().classes("note").props("data-id=fan")
            # Few numbers at first, to keep the page light: rows of the others are built when they are first opened.
            self._rows(self.session.first)
            hidden_keys = [key for key in self.session.knobs if key not in self.session.first]
            more = (
                ui.expansion(f"all other numbers ({len(hidden_keys)})").classes("w-full").props("dense data-id=others")
            )

            def open_rest(event: Any) -> None:
                if event.value and not any(key in self.fields for key in hidden_keys):
                    with more:
                        self._rows(hidden_keys)

            more.on_value_change(open_rest)

    def _chooser(self, name: str, choices: Any, value: str, load: Callable[[str], Basis]) -> None:
        """Add a list of `choices`; `load` loads the part of a choice."""
        field = (
            ui.select(choices, value=value, label=name).classes("w-full chooser").props("dense outlined options-dense")
        )
        field.props["data-id"] = name
        field.on_value_change(lambda event: self._replaced(partial(load, event.value)))

    def _spread(self, name: str) -> str:
        return f"{100 * getattr(self.session.spread, name):g}"

    def _take_spread(self, name: str, field: Any) -> None:
        if self._widen(name, field.value):
            self._show_spread(name, field)
        else:
            field.props("error")
            self.refused[name] = partial(self._show_spread, name, field)

    def _show_spread(self, name: str, field: Any) -> None:
        self.refused.pop(name, None)
        field.props(remove="error")
        field.set_value(self._spread(name))

    def _rows(self, keys: Iterable[str]) -> None:
        group = ""
        for key in keys:
            knob = self.session.knobs[key]
            if knob.group != group:
                group = knob.group
                ui.label(group).classes("group")
            self._row(key, knob)

    def _row(self, key: str, knob: Knob) -> None:
        value = self.session.value(key)
        with ui.element("div").classes("knob"):
            ui.label(knob.label).classes("name").tooltip(f"{knob.meaning} {knob.name} in {knob.spec.interval()}")
            field = ui.input(value=knob.text(value)).props("dense outlined hide-bottom-space")
            field.props["data-field"], field.props["aria-label"] = key, knob.name
            field.on("change", lambda _: self._change(key, str(field.value), 0))
            self.fields[key] = field
            ui.label(unit_words(knob.spec.unit)).classes("unit")
            if knob.low is not None:
                slider = ui.slider(min=0, max=SLIDER_STEPS, step=1, value=knob.place_of(value)).props("dense")
                slider.props["data-slider"], slider.props["aria-label"] = key, knob.name
                slider.on(
                    "update:model-value",
                    lambda event: self._take_slider(key, *event.args),
                    throttle=CHANGE_INTERVAL_S,
                    js_handler="(place) => emit(place, explorer.edited())",
                )
                self.sliders[key] = slider

    # The arguments come from the browser, so their types are checked.
    def _take_slider(self, key: str, place: Scalar, edit: object) -> None:
        knob = self.session.knobs.get(key)
        if knob is None or knob.low is None or not isinstance(place, int | float) or not 0 <= place <= SLIDER_STEPS:
            return
        self._change(key, knob.text(knob.value_at(place)), edit if isinstance(edit, int) else 0)
