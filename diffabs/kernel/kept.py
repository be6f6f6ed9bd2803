"""Functions that call kernels, traced and compiled once for all processes: kept beside the libraries that they call.

A part may come from outside this package: then it is traced as ever (`core.kept`)."""

import pathlib
import re
from typing import Any

import jax

from diffabs.core.compiling import traced
from diffabs.core.kept import Programs
from diffabs.kernel import compilers, launch

FOLDER = "programs"  # in that of the libraries


class Libraries:
    """The shelf of programs that call libraries."""

    def folder(self) -> pathlib.Path:
        return compilers.cache_folder() / FOLDER

    def around(self) -> Any:
        """Raises NoCompiler."""
        return launch.described(), launch.threads()

    def libraries(self, lowered: jax.stages.Lowered) -> list[str]:
        names = set(re.findall(launch.NAME + r"\w+", lowered.as_text()))
        return [launch.path(name).name for name in sorted(names)]

    def load(self, library: str) -> None:
        try:
            launch.register(compilers.cache_folder() / library)
        except compilers.NoCompiler as error:
            raise OSError(str(error)) from None


class Kept:
    """A function that `jax.jit` made, as one that is traced once for all processes.

    told: everything that decides it besides its arguments, the function of this package that it was made of included"""

    def __init__(self, function: Any, told: Any):
        """`function` has no static arguments."""
        self.function, self._programs = function, Programs(function, told, Libraries())

    def __call__(self, *args: Any) -> Any:
        """Return function(*args)."""
        call = None if traced(args) else self._programs.find(args)
        return self.function(*args) if call is None else call(*args)

    def ready(self, *args: Any) -> None:
        """Have it traced for arguments like these, which are numbers; raises what tracing raises."""
        if self._programs.find(args) is None:
            self.function.lower(*args)

    def forget(self) -> None:
        """As if it had never been called."""
        self._programs.forget()
        self.function.clear_cache()
