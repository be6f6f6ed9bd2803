"""The operations that can be folded: NumPy's function of each, and which of them are others with operands exchanged."""

from typing import Any

import numpy as np

COMPARISONS: dict[str, Any] = {
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
}
FOLDABLE: dict[str, Any] = COMPARISONS | {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "rem": np.fmod,
    "quotient": lambda x, y: (np.abs(x) // np.abs(y)) * np.sign(x) * np.sign(y),
    "max": np.maximum,
    "min": np.minimum,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "neg": np.negative,
    "abs": np.abs,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "floor": np.floor,
    "ceil": np.ceil,
    "rint": np.rint,
    "is_finite": np.isfinite,
    "shift_left": np.left_shift,
    "shift_right_logical": np.right_shift,
}
SYMMETRIC = {"add", "mul", "and", "or", "xor", "eq", "ne"}
MIRRORED = {"gt": "lt", "ge": "le"}  # of the other operands in turn
NEGATED = {"eq": "ne", "ne": "eq"}  # of the ordered ones NaN is not the contrary
