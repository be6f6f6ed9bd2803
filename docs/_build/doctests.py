"""An extension of Griffe: an example in a docstring, `>>> ...` up to the next empty line, is code on the page; a part
has a table of its parameters, another class its signature; lines `name: what it is` are a list; and the names below
`See also:` are links."""

import importlib.util
import pathlib
import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?:^>>> .*\n?)(?:^.+\n?)*", re.MULTILINE)
SEE_ALSO = re.compile(r"^See also:\n((?:    `.*\n?)+)", re.MULTILINE)
NAME = re.compile(r"`([\w.]+)`")
spec = importlib.util.spec_from_file_location("parameters", pathlib.Path(__file__).with_name("parameters.py"))
assert spec
assert spec.loader
parameters = importlib.util.module_from_spec(spec)
spec.loader.exec_module(parameters)


def fenced(text: str) -> str:
    """Return a docstring with its examples as blocks of code."""
    return EXAMPLE.sub(lambda found: f"```pycon\n{found[0].rstrip()}\n```\n", text)


def listed(text: str, names: set[str]) -> str:
    """Return a docstring whose lines `name: what it is`, of a parameter or field, are a list. Without that, the parser
    of docstrings takes such a line for the head of a section and drops the name."""
    found: list[str] = []
    within = False
    for line in text.splitlines():
        head, colon, rest = line.partition(": ")
        if colon and not line.startswith(" ") and set(head.split(", ")) <= names:
            found += ([] if within else [""]) + [f"- {', '.join(f'`{name}`' for name in head.split(', '))}: {rest}"]
            within = True
        else:
            within = within and line.startswith(" ")
            found.append(line)
    return "\n".join(found)


def linked(text: str) -> str:
    """Return a docstring whose section `See also:` is a list of links; its names are those below `diffabs`."""

    def entry(line: str) -> str:
        names, _, rest = line.strip().partition(": ")
        return f"    - {NAME.sub(lambda name: f'[{name[0]}][diffabs.{name[1]}]', names)}: {rest}\n"

    return SEE_ALSO.sub(lambda found: "See also:\n" + "".join(map(entry, found[1].splitlines())), text)


class Doctests(griffe.Extension):
    """Changes the docstrings of what is documented."""

    def on_object(self, *, obj: Any, **given: Any) -> None:
        """Of each object, when its members are known."""
        del given
        if obj.docstring:
            text = linked(listed(fenced(obj.docstring.value), _names(obj)))
            parts = [text]
            if obj.is_class:
                text, mark, rest = text.partition("See also:\n")
                parts = [text.rstrip(), parameters.table(obj.source), mark + rest]
                if not parameters.parameters(obj.source):
                    parts.insert(0, parameters.signature(obj.source))
            for name in parameters.meanings(obj.source) if obj.is_class else ():
                obj.members[name].docstring = None  # the table has it
            obj.docstring.value = "\n\n".join(part for part in parts if part)


def _names(obj: Any) -> set[str]:
    """Of a function's parameters, or of a class's fields."""
    if obj.is_function:
        return {one.name for one in obj.parameters}
    return {name for name, one in obj.members.items() if one.is_attribute} if obj.is_class else set()
