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


def _beside(name: str) -> Any:
    """Return the module beside this one: MkDocs loads each by its path."""
    spec = importlib.util.spec_from_file_location(name, pathlib.Path(__file__).with_name(f"{name}.py"))
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


parameters = _beside("parameters")
PACKAGE = pathlib.Path(__file__).parents[2] / "diffabs"
# Where `design` of `design.certify` is.
ROOMS = {init.parent.name: f"diffabs.{init.parts[-3]}.{init.parts[-2]}" for init in PACKAGE.glob("*/*/__init__.py")}


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

    def link(name: re.Match) -> str:
        first, dot, rest = name[1].partition(".")
        home = ROOMS.get(first, f"diffabs.{first}") if dot else f"diffabs.{first}"
        return f"[{name[0]}][{home}{dot}{rest}]"

    def entry(line: str) -> str:
        names, _, rest = line.strip().partition(": ")
        return f"    - {NAME.sub(link, names)}: {rest}\n"

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
