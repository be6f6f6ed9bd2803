"""Lazy exports of packages: each exported name is imported on its first use, without the package's other modules."""

import ast
import functools
import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from diffabs.core.types import PyTree


class CallablePackage(ModuleType):
    """A package whose call is that of its function of the same name: `diffabs.tune(...)` is `diffabs.tune.tune(...)`.

    Python binds an imported package to its name in the parent package. A function of the parent could not keep the
    name. A package becomes callable by `sys.modules[__name__].__class__ = CallablePackage`, as the Python reference
    describes it in "Customizing module attribute access".
    """

    def __call__(self, *args: PyTree, **options: PyTree) -> PyTree:
        """Return the result of the package's function."""
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **options)


def lazy_getattr(package: str) -> Callable[[str], PyTree]:
    """Return the `__getattr__` of a package (PEP 562) that imports an exported name on its first use.

    `dir` and `import *` list the exports, too.

    The exports are the package's imports of the form `from m import x as x`, which only type checkers execute. The
    function reads them from the package's source, so that each export is listed once. If m is the package itself, x is
    a package in it.

    Args:
        package: Name of the package.
    """

    @functools.cache
    def homes() -> dict[str, str]:
        loader: Any = vars(sys.modules[package])["__loader__"]
        imports = (x for x in ast.walk(ast.parse(loader.get_source(package))) if isinstance(x, ast.ImportFrom))
        return {alias.name: str(x.module) for x in imports for alias in x.names if alias.asname == alias.name}

    def export(name: str) -> Any:
        if name == "__all__":
            return list(homes())
        if name.startswith("__") or name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = homes()[name]
        inner = home == package
        value = importlib.import_module(f"{home}.{name}") if inner else getattr(importlib.import_module(home), name)
        setattr(sys.modules[package], name, value)
        return value

    vars(sys.modules[package])["__dir__"] = lambda: sorted({*vars(sys.modules[package]), *homes()})
    return export
