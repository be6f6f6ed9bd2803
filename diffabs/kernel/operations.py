"""NumPy's function for each operation that the graph folds, and the algebraic symmetries of operations."""

import numpy as np

from diffabs.core.types import PyTree

COMPARISONS: dict[str, PyTree] = {
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
}
FOLDABLE: dict[str, PyTree] = COMPARISONS | {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "rem": np.fmod,
    # Rounded towards zero as in C, unlike NumPy's //.
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
MIRRORED = {"gt": "lt", "ge": "le"}  # the same comparison with the operands exchanged
NEGATED = {"eq": "ne", "ne": "eq"}  # not "lt" and "ge": both are false for NaN
