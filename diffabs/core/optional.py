"""Packages that a user may have or not."""

import importlib
from types import ModuleType


def import_optional(name: str) -> ModuleType:
    """Return a package that no extra of diffabs brings, or raise a ModuleNotFoundError of one line."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or name
        raise ModuleNotFoundError(f"{missing} is not installed: pip install {missing}", name=missing) from error
