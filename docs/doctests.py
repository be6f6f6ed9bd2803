"""An extension of Griffe: an example in a docstring, `>>> ...` up to the next empty line, is code on the page, and a
part has a table of its parameters."""

import importlib.util
import pathlib
import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?:^>>> .*\n?)(?:^.+\n?)*", re.MULTILINE)
spec = importlib.util.spec_from_file_location("parameters", pathlib.Path(__file__).with_name("parameters.py"))
assert spec
assert spec.loader
parameters = importlib.util.module_from_spec(spec)
spec.loader.exec_module(parameters)


def fenced(text: str) -> str:
    """Return a docstring with its examples as blocks of code."""
    return EXAMPLE.sub(lambda found: f"```pycon\n{found[0].rstrip()}\n```\n", text)


class Doctests(griffe.Extension):
    """Changes the docstrings of what is documented."""

    def on_object(self, *, obj: Any, **given: Any) -> None:
        """Of each object, when its members are known."""
        del given
        if obj.docstring:
            tabled = parameters.table(obj.source) if obj.is_class else ""
            obj.docstring.value = fenced(obj.docstring.value) + (f"\n\n{tabled}" if tabled else "")
