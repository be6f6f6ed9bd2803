"""The head of the page: its name, the latency of the last curve, and the buttons for the current run."""

from typing import TYPE_CHECKING

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

if TYPE_CHECKING:
    from diffabs.output.explore.page import Page


def add_header(page: "Page") -> None:
    """Put the header into the open element."""
    with ui.element("header"):
        ui.label("diffabs").classes("brand")
        ui.label("explore").classes("brand thin")
        ui.element("div").classes("grow")
        ui.html("", sanitize=False).classes("latency").props("data-id=latency")
        ui.button("fit", on_click=lambda: page.show_until_settled(whole=False)).props(
            "flat dense no-caps data-id=fit"
        ).tooltip("the time axis ends when the transient has")
        ui.button("whole run", on_click=lambda: page.show_until_settled(whole=True)).props(
            "flat dense no-caps data-id=whole"
        )
        ui.button("pin", on_click=lambda: page.pin(page.shown)).props("flat dense no-caps data-id=pin").tooltip(
            "keep this run as a dashed curve to compare with"
        )
        ui.button("unpin", on_click=lambda: page.pin(None)).props("flat dense no-caps")
        ui.button("reset", on_click=page.reset).props("flat dense no-caps data-id=reset").tooltip(
            "all numbers as in the scenario"
        )
        ui.button("tune from here", on_click=lambda: page.tuner.ask()).props(
            "unelevated dense no-caps data-id=tune color=primary"
        )
        ui.button("save", on_click=lambda: page.saver.ask()).props("outline dense no-caps data-id=save color=primary")
