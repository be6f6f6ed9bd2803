"""JAX's flags for the search of faults, and the values that this package computes with.

`jax_debug_nans` stops at any NaN, but NaN is the value of a run that diverged and of a row that is not reached.
Strict promotion refuses a count times a time, rank promotion a matrix times a vector, and the transfer guard every
Python number. Such a flag judges its user's program, not the insides of a run.
"""

import contextlib
from collections.abc import Iterator
from types import MappingProxyType

import jax

# Each name is a flag `jax_<name>` and a context manager `jax.<name>`.
DEFAULTS = MappingProxyType(
    {
        "debug_nans": False,
        "debug_infs": False,
        "numpy_dtype_promotion": "standard",
        "numpy_rank_promotion": "allow",
        "transfer_guard": "allow",
    }
)


@contextlib.contextmanager
def default_flags() -> Iterator[None]:
    """Set this thread's flags to `DEFAULTS`, in a `with` or as a decorator of a function.

    A thread that is started inside does not inherit them.
    """
    with contextlib.ExitStack() as stack:
        for name, default in DEFAULTS.items():
            if getattr(jax.config, f"jax_{name}") not in (default, None):  # None: a transfer guard that nobody has set
                stack.enter_context(getattr(jax, name)(default))
        yield
