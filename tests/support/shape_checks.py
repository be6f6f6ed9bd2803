"""Checks of shapes: beartype reads those annotations that name shapes, in the process of a test.

JAX calls the constructors of records with tracers and placeholders when it rebuilds them; these are not checked.
A check takes longer than many of the functions, so only the first calls of each are checked.
"""

import functools
import inspect
import itertools
from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import BeartypeConf, beartype
from project import ROOT

CHECK = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float
CHECKED_CALLS = 50  # of each function in a process

_jaxtyped = jaxtyping.jaxtyped


def has_shape(hint: Any) -> bool:
    """Return whether an annotation names a shape, as `Float[Array, "runs"]` or a tuple of such does."""
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(map(has_shape, get_args(hint)))


def check_shapes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with a check of the shapes of its arguments and its result; jaxtyping hands in a copy."""
    function.__annotations__ = {name: hint for name, hint in function.__annotations__.items() if has_shape(hint)}
    return CHECK(function) if function.__annotations__ else function


def check_first_calls(function: Any = None, *, typechecker: Any = None) -> Any:
    """Stand for `jaxtyping.jaxtyped`: a function without shapes stays as it is, another is checked at first."""
    if function is None:
        return functools.partial(check_first_calls, typechecker=typechecker)
    checked = _jaxtyped(function, typechecker=typechecker)
    if not inspect.isfunction(function):
        return checked
    if not any(map(has_shape, function.__annotations__.values())):
        return function
    calls = itertools.count()

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        return (checked if next(calls) < CHECKED_CALLS else function)(*args, **options)

    return call


def modules_with_shapes() -> list[str]:
    """Return the names of the modules that import names of shapes."""
    files = sorted((ROOT / "diffabs").rglob("*.py"))
    texts = {".".join(file.relative_to(ROOT).with_suffix("").parts): file.read_text(encoding="utf-8") for file in files}
    return [name for name, text in texts.items() if "from diffabs.core.shapes import" in text]


def install() -> None:
    """Check the shapes in this process; call it before the package is imported."""
    jaxtyping.jaxtyped = check_first_calls  # the name that the hook writes
    jaxtyping.install_import_hook(modules_with_shapes(), "shape_checks.check_shapes")
