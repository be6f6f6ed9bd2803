"""Names of types for annotations. An array may be a tracer, and under `vmap` a number stands for a batch of numbers.

An alias of Any tells a reader the kind of value. A part satisfies a contract by its methods and attributes. The
structure of a pytree is the caller's.
"""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import numpy as np

Array: TypeAlias = jax.Array
AnyArray: TypeAlias = jax.Array | np.ndarray
Bool: TypeAlias = bool | np.bool_ | np.ndarray | jax.Array  # of one run, or of a batch
Int: TypeAlias = int | np.integer | np.ndarray | jax.Array
Key: TypeAlias = jax.Array  # a key of jax.random
Scalar: TypeAlias = Any  # a float, a NumPy or JAX scalar, a tracer; a batch of them under vmap
Vector: TypeAlias = Any  # the same with one axis
Matrix: TypeAlias = Any  # with two
Equation: TypeAlias = Any  # of a jaxpr: jax.extend.core.JaxprEqn, whose type does not tell the shapes of its variables
Source: TypeAlias = Any  # JAX's record of the line of Python that wrote an operation
PyTree: TypeAlias = Any  # leaves and structure are the caller's
Part: TypeAlias = Any  # a plant, controller, sensor, ... of `core.protocols`, or a whole loop
Params: TypeAlias = Mapping[str, Any]  # values by dotted path, "plant.mass", or by name
Table: TypeAlias = Mapping[str, Any]  # of TOML: numbers, texts, lists and tables by key
JsonObject: TypeAlias = dict[str, Any]  # for JSON
