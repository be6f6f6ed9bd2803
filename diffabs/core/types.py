"""Names of types for annotations: the type tells the kind of a value, the name its shape.

    Scalar    a real number of a single run: a float, an array of shape (), a tracer (under `vmap` its shape is ())
    Numbers   real numbers of any shape: of a run or a batch of runs, of an array's elements
    Vector    an array with at least one axis, the last one of which counts
    Matrix    an array whose last two axes are rows and columns; further axes are a batch
    Array     an array of JAX, for what asks for its type or updates it: `x.dtype`, `x.at[i]`
    AnyArray  an array of JAX or NumPy
    Int, Bool the same as Numbers, for integers and truth values
    Rows      a matrix as nested lists, from the top
    Key       a key of `jax.random`
    PyTree    a tree whose structure is the caller's; a TypeVar is better where a tree returns as it came
    Part      a plant, controller, ... of unknown contract; a name of `core.protocols` is better

A value that may be anything is an `object`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from diffabs.core.shapes import Num, Shaped

Array: TypeAlias = jax.Array
AnyArray: TypeAlias = jax.Array | np.ndarray
Bool: TypeAlias = bool | np.bool_ | np.ndarray | jax.Array
Int: TypeAlias = int | np.integer | np.ndarray | jax.Array
Key: TypeAlias = jax.Array
Scalar: TypeAlias = float | Num[jax.Array, ""] | Num[np.ndarray, ""]
Numbers: TypeAlias = float | np.number | np.ndarray | jax.Array
Vector: TypeAlias = Shaped[jax.Array, "... _"] | Shaped[np.ndarray, "... _"]
Rows: TypeAlias = Sequence[Sequence[Scalar]]  # of a matrix, from the top
Matrix: TypeAlias = Shaped[jax.Array, "... _ _"] | Shaped[np.ndarray, "... _ _"]
Equation: TypeAlias = Any  # of a jaxpr: jax.extend.core.JaxprEqn, whose type does not tell the shapes of its variables
Source: TypeAlias = Any  # JAX's record of the line of Python that wrote an operation
PyTree: TypeAlias = Any
Part: TypeAlias = Any
Params: TypeAlias = Mapping[str, Any]  # values by dotted path, "plant.mass", or by name
Table: TypeAlias = Mapping[str, Any]  # of TOML: numbers, texts, lists and tables by key
JsonObject: TypeAlias = dict[str, Any]  # for JSON
