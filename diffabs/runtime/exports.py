"""Lazy exports of packages: each exported name is imported on its first use, without the package's other modules."""

import ast
import functools
import importlib
import sys
from collections.abc import Callable
from typing import Any

from diffabs.core.types import PyTree


def lazy_getattr(package: str) -> Callable[[str], PyTree]:
    """Return the `__getattr__` of a package (PEP 562) that imports an exported name on its first use.

    `dir` and `import *` list the exports, too.

    The exports are the package's imports of the form `from m import x as x`, which only type checkers execute. The
    function reads them from the package's source, so that each export is listed once.

    Args:
        package: Name of the package.
    """

    @functools.cache
    def homes() -> dict[str, str]:
        loader: Any = vars(sys.modules[package])["__loader__"]
        imports = (x for x in ast.walk(ast.parse(loader.get_source(package))) if isinstance(x, ast.ImportFrom))
        return {one.name: str(x.module) for x in imports for one in x.names if one.asname == one.name}

    def export(name: str) -> Any:
        if name == "__all__":
            return list(homes())
        if name.startswith("__") or name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(homes()[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    vars(sys.modules[package])["__dir__"] = lambda: sorted({*vars(sys.modules[package]), *homes()})
    return export
