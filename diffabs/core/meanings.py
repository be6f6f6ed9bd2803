"""The meaning of a field is the string below it, as editors and Griffe read it. Help and tables take it from there."""

import ast
import dataclasses
import functools
import inspect
import itertools
import sys
from typing import TypeVar

ClassT = TypeVar("ClassT", bound=type)


@functools.cache
def field_meanings(cls: type) -> dict[str, str]:
    """Return the strings below the fields of a class and its bases, by field; none where the source is not at hand."""
    meanings: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        try:
            lines, _ = inspect.findsource(sys.modules[base.__module__])
            meanings |= _meanings_by_class("".join(lines)).get(base.__qualname__, {})
        except (KeyError, OSError, TypeError, SyntaxError):
            continue
    return meanings


@functools.cache
def _meanings_by_class(source: str) -> dict[str, dict[str, str]]:
    """Return the strings below the fields of all classes of a module, by qualified name of the class and by field."""
    # Each module is parsed once; `inspect.getsource` of a class would parse and tokenise it again for each class.
    classes: dict[str, dict[str, str]] = {}

    def visit(statements: list[ast.stmt], prefix: str) -> None:
        for statement in statements:
            match statement:
                case ast.ClassDef(name=name, body=body):
                    classes[prefix + name] = _meanings_in(body)
                    visit(body, f"{prefix}{name}.")
                case ast.FunctionDef(name=name, body=body):
                    visit(body, f"{prefix}{name}.<locals>.")
                case ast.If() | ast.Try():
                    visit([*statement.body, *statement.orelse], prefix)

    visit(ast.parse(source).body, "")
    return classes


def _meanings_in(body: list[ast.stmt]) -> dict[str, str]:
    meanings = {}
    for field, text in itertools.pairwise(body):
        match field, text:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(str(meaning))):
                meanings[name] = " ".join(meaning.split())
    return meanings


def document_fields(cls: ClassT) -> ClassT:
    """Return the dataclass with the meaning of every field, and the range of a parameter, added to its docstring."""
    cls.__doc__ = _Docstring(cls.__doc__ or "")  # pyright: ignore[reportAttributeAccessIssue]  # it returns a text
    return cls


@dataclasses.dataclass(frozen=True)
class _Docstring:
    """A docstring that is completed when it is read, so that no import waits for the source."""

    text: str

    def __get__(self, instance: object, owner: type) -> str:
        meanings, lines = field_meanings(owner), []
        for field in dataclasses.fields(owner):
            spec = field.metadata.get("spec")
            words = [meanings.get(field.name, ""), f"In {spec.interval()}." if spec else ""]
            if any(words):
                lines.append(f"    {field.name}: {' '.join(filter(None, words))}")
        return "\n".join([inspect.cleandoc(self.text), *(["", "Attributes:"] if lines else []), *lines])
