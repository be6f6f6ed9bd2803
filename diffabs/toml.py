"""TOML as values and back, no more of it than a scenario needs."""

import dataclasses
import json
import re
import tomllib
from typing import Any

import numpy as np

from diffabs.catalogue import family_of, kebab


def value(text: str) -> Any:
    """The value that a text on the command line means."""
    for candidate in (f"v = {text}", f"v = [{text}]"):
        try:
            read = tomllib.loads(candidate)
        except (ValueError, RecursionError):
            continue
        plain = candidate == f"v = {text}" or all(isinstance(x, int | float) for x in read["v"])
        if read.keys() == {"v"} and plain and text:
            return read["v"]
    return text


def table(family: str, part: Any) -> dict[str, Any]:
    """A part as values of TOML: its type and every field, numbers at full precision."""
    values: dict[str, Any] = {"type": kebab(type(part).__name__)}
    for field in dataclasses.fields(part):
        value, inner = getattr(part, field.name), family_of(field.name, family)
        if "spec" in field.metadata:
            value = np.asarray(value, float).tolist()
        elif isinstance(value, tuple):
            value = [table(inner, item) for item in value]
        elif "part" in field.metadata:
            value = table(inner, value)
        values[field.name] = value
    return values


def document(top: dict[str, Any], sections: dict[str, dict[str, Any]]) -> str:
    """The text of a file with these values, and these sections below them."""
    lines = [f"{_key(key)} = {_written(value)}" for key, value in top.items()]
    for name, values in sections.items():
        lines += ["", f"[{name}]", *(f"{_key(key)} = {_written(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def _written(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_key(key)} = {_written(item)}' for key, item in value.items())}}}"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _written(key)
