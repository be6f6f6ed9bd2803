"""The dialog that saves the explored scenario."""

import pathlib
import shlex

from nicegui import ui  # pyright: ignore[reportMissingImports]  # the extra `explore`

from diffabs.host.values import ScenarioError
from diffabs.output.explore import saving
from diffabs.output.explore.session import Session


class Saver:
    """A dialog that asks for a file name and writes the current scenario into the folder of the command."""

    def __init__(self, session: Session, folder: pathlib.Path):
        """Prepare the dialog for a `session`, whose files are written into `folder`; the page stays unchanged."""
        self.session = session
        self.folder = folder

    def build(self) -> None:
        """Put the closed dialog on the page."""
        self.dialog: ui.dialog = ui.dialog()

    def ask(self) -> None:
        """Open the dialog."""
        name = saving.free_name(self.folder, f"{self.session.original.name}-explored")
        self.dialog.clear()
        with self.dialog, ui.card().style("min-width: 440px").props("data-id=saving"):
            ui.label("Save the scenario with these numbers").style("font-weight:600; font-size:15px")
            ui.label(f"in {self.folder}").classes("note")
            self.name = ui.input("file", value=name).classes("w-full").props("dense outlined data-id=file")
            self.replacing = ui.checkbox("replace a file of this name").props("dense data-id=replace")
            self.refusal = ui.label("").classes("refused").props("data-id=save-refused")
            self.refusal.set_visibility(False)
            with ui.row().classes("w-full justify-end"):
                ui.button("cancel", on_click=self.dialog.close).props("flat no-caps")
                ui.button("save", on_click=self._save).props("unelevated no-caps data-id=write")
        self.dialog.open()

    def _save(self) -> None:
        try:
            scenario = self.session.to_save()
            path = saving.save_scenario(
                scenario, self.folder, str(self.name.value), replacing=bool(self.replacing.value)
            )
        except ScenarioError as error:
            self.refusal.set_text(str(error))
            self.refusal.set_visibility(True)
            return
        self.dialog.close()
        ui.notify(
            f"written: {path}; run it with: diffabs simulate {shlex.quote(path.name)}",
            type="positive",
            position="bottom",
            timeout=12_000,
            close_button=True,
        )
