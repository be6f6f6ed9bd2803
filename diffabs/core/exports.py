"""What a package exports, imported when it is first asked for: whoever needs one module of it does not load all."""

import importlib
import sys
from collections.abc import Callable
from typing import Any


def lazily(package: str, *modules: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package (PEP 562). `modules`: of each its name and what is exported of it, as in
    "diffabs.tune.risk CVaR Mean"."""
    homes = {name: module for module, *names in map(str.split, modules) for name in names}

    def export(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return export
