"""An extension of Griffe: an example in a docstring, `>>> ...` up to the next empty line, is code on the page."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?:^>>> .*\n?)(?:^.+\n?)*", re.MULTILINE)


def fenced(text: str) -> str:
    """Return a docstring with its examples as blocks of code."""
    return EXAMPLE.sub(lambda found: f"```pycon\n{found[0].rstrip()}\n```\n", text)


class Doctests(griffe.Extension):
    """Changes the docstrings of what is documented."""

    def on_object(self, *, obj: Any, **given: Any) -> None:
        """Of each object, when its members are known."""
        del given
        if obj.docstring:
            obj.docstring.value = fenced(obj.docstring.value)
