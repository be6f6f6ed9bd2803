"""Shapes of arrays in annotations: `Float[Array, "states inputs"]` has the names of jaxtyping, and its meaning.

A name stands for one size in a signature; `*batch` stands for any number of axes, `...` for axes without a name. A
single name begins with a blank, as in `Float[Array, " states"]`, since linters take it for a forward reference. Under
`jax.vmap` and while JAX traces, shapes are those of one lane.

Type checkers and the tests read jaxtyping, and beartype checks the shapes in the tests. Its import takes as long as a
third of NumPy's, so a process that has not imported it has stand-ins: `Float[Array, "n m"]` is `Array` there.
"""

import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Int as Int
    from jaxtyping import Num as Num
    from jaxtyping import Shaped as Shaped
    from jaxtyping import UInt as UInt
else:

    class _AnyShape:
        def __class_getitem__(cls, type_and_shape: tuple[Any, str]) -> Any:
            return type_and_shape[0]

    Bool = Float = Int = Num = Shaped = UInt = _AnyShape
