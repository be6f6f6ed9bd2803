"""A chart on the page, and the messages that change it."""

import json

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.core.types import JsonObject


class Canvas:
    """A chart that changes piece by piece: a change keeps everything that it does not name."""

    def __init__(self, options: JsonObject, classes: str, name: str = ""):
        """Put a chart with these `options` and CSS `classes` into the open element; `name` is its data-id."""
        self.element: ui.echart = ui.echart(options).classes(classes)
        if name:
            self.element.props["data-id"] = name

    def change(self, option: JsonObject, edit: int = 0) -> None:
        """Apply the change `option` to the chart.

        `edit` is the browser's number of the user's edit that this change shows, or 0. If the chart does not exist yet,
        the browser applies the change later.
        """
        self.send(encode_change(option), edit)

    def send(self, change: str, edit: int = 0) -> None:
        """Apply a `change` encoded by `encode_change`; `edit` is as in `change`."""
        ui.run_javascript(f"explorer.change({self.element.id}, {change}, {int(edit)})")


def encode_change(option: JsonObject) -> str:
    """Return a change as JSON text."""
    return json.dumps(option, separators=(",", ":"), allow_nan=False)


def merge_change(option: JsonObject, change: JsonObject) -> JsonObject:
    """Return the options of a chart that has this change from its first frame.

    The change has all datasets, and otherwise only limits of axes.
    """
    axes = {
        name: [axis | limits for axis, limits in zip(_as_list(option[name]), parts, strict=True)]
        for name, parts in change.items()
        if name != "dataset"
    }
    return option | {"dataset": change["dataset"]} | axes


def _as_list(axes: JsonObject | list[JsonObject]) -> list[JsonObject]:
    return axes if isinstance(axes, list) else [axes]
