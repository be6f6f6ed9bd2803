"""A chart on the page, and what changes in it."""

import json
from typing import Any

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`


class Canvas:
    """A chart that is changed piece by piece: what is not named in a change stays as it is."""

    def __init__(self, options: dict[str, Any], classes: str, name: str = ""):
        """Put it on the page, where something is open."""
        self.element = ui.echart(options).classes(classes)
        if name:
            self.element.props(f"data-id={name}")

    def change(self, option: dict[str, Any], edit: int = 0) -> None:
        """Change it; `edit` is the browser's number of what a person changed, if this shows it. A change that comes
        before the browser has made the chart waits there."""
        self.send(encode_change(option), edit)

    def send(self, change: str, edit: int = 0) -> None:
        """Change it by what `encoded` has made, in whatever thread."""
        ui.run_javascript(f"explorer.change({self.element.id}, {change}, {int(edit)})")


def encode_change(option: dict[str, Any]) -> str:
    """Return a change as text."""
    return json.dumps(option, separators=(",", ":"), allow_nan=False)
