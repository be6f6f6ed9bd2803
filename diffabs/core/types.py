"""Type names for annotations. An `Array` may be a tracer; a `pytree.Scalar` is a number or an array."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import numpy as np

Array: TypeAlias = jax.Array
Key: TypeAlias = jax.Array  # a key of jax.random
NumPyArray: TypeAlias = np.ndarray
Bool: TypeAlias = bool | jax.Array  # of one run or of a batch
Int: TypeAlias = int | jax.Array
PyTree: TypeAlias = Any  # with any leaves and structure
Params: TypeAlias = Mapping[str, Any]  # values by dotted path, "plant.mass"
