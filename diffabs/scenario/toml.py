"""Reading and writing of the subset of TOML that a scenario needs."""

import json
import re
import tomllib

from diffabs.core.types import JsonObject, PyTree
from diffabs.host.values import ScenarioError, format_given

MOST_LEVELS = 50  # of nested tables and lists; a scenario has fewer than 5
MAX_INTEGER = 2**63  # bound of whole numbers: TOML has 64 bits
MAX_MESSAGE_LENGTH = 200  # characters
# What separates the keys of a text: each match is a string, a comment, a dot, or the end of a key. The search is
# linear: the parts of a string begin with different signs, and an unclosed one ends with the text. No quantifier is
# possessive: Python before 3.11.5 matches a possessive group wrongly.
KEY_TOKENS = re.compile(
    r'''"""[^"\\]*(?:(?:\\.|"(?!""))[^"\\]*)*(?:"{3,5}|\\?\Z)|"[^"\\\n]*(?:\\.[^"\\\n]*)*[\\"]?'''
    r"""|'''[^']*(?:'(?!'')[^']*)*(?:'{3,5}|\Z)|'[^'\n]*'?|#[^\n]*|(?P<dot>\.)|(?P<end>[=,\[\]{}\n])""",
    re.DOTALL,
)


def parse_toml(text: str) -> JsonObject:
    """Return the table that a TOML text describes."""
    if _has_long_key(text):
        raise ScenarioError(f"a key is nested more than {MOST_LEVELS} deep")
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise ScenarioError("its values are nested too deeply") from None
    except ValueError as error:
        if "integer string conversion" in str(error):  # the limit of digits that Python converts
            raise ScenarioError("a whole number is outside [-2^63, 2^63)") from None
        raise ValueError(_shorten(str(error))) from None  # the parser repeats a key at any length
    # A loop with its own stack: recursion would fail on the deep nesting that it must refuse. A path is a tuple until
    # a message needs it: as texts, the paths below one long key would take more memory than there is.
    pending: list[tuple[tuple[str | int, ...], PyTree]] = [((key,), item) for key, item in table.items()]
    while pending:
        where, item = pending.pop()
        if len(where) > MOST_LEVELS:
            raise ScenarioError(f"{format_given(where[0])} is nested more than {MOST_LEVELS} deep")
        if isinstance(item, dict | list):
            inside = item.items() if isinstance(item, dict) else enumerate(item)
            pending += [((*where, key), each) for key, each in inside]
        elif isinstance(item, int) and not -MAX_INTEGER <= item < MAX_INTEGER:
            raise ScenarioError(f"{format_given('.'.join(map(str, where)))} is a whole number outside [-2^63, 2^63)")
    return table


def _shorten(message: str) -> str:
    """Return a message of bounded length; its end tells the line."""
    return message if len(message) <= MAX_MESSAGE_LENGTH else f"{message[:100]} ... {message[-40:]}"


def _has_long_key(text: str) -> bool:
    """Return True if a key has more than `MOST_LEVELS` words; `tomllib` takes a time quadratic in their number."""
    dots = 0
    for token in KEY_TOKENS.finditer(text):
        dots = 0 if token["end"] else dots + bool(token["dot"])
        if dots >= MOST_LEVELS:
            return True
    return False


def parse_value(text: str) -> object:
    """Return the value that a text on the command line stands for.

    A TOML value is read as such, `1,2` is a list of numbers, and any other text is itself.
    """
    for candidate in (f"v = {text}", f"v = [{text}]"):
        try:
            read = parse_toml(candidate)
        except ScenarioError as error:
            raise ScenarioError(str(error).replace('"v"', "its value").replace("its values are", "is")) from None
        except ValueError:
            continue
        plain = candidate == f"v = {text}" or all(isinstance(x, int | float) for x in read["v"])
        if read.keys() == {"v"} and plain and text:
            return read["v"]
    return text


def write_toml(top: JsonObject, sections: dict[str, JsonObject]) -> str:
    """Return the text of a TOML file."""
    lines = [f"{_write_key(key)} = {_write_value(value)}" for key, value in top.items()]
    for name, values in sections.items():
        lines += ["", f"[{name}]", *(f"{_write_key(key)} = {_write_value(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def _write_value(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return f"[{', '.join(map(_write_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_write_key(key)} = {_write_value(item)}' for key, item in value.items())}}}"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _write_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _write_value(key)
