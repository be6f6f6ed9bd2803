"""The operations of a program in one table: value for constants, symmetry, and text in each language.

A template has the operands {0} and {1}. In C++ and CUDA the functions are those of `native/functions.h` and
`native/lane.h`. In C99, {f} is the suffix of a function's name in single precision, and a template with {f} is for real
numbers only. In Structured Text, {real} is the type of the real numbers and {largest} the largest of them.

An operation without a template in a language has no translation to it. The nodes `const`, `input`, `convert`, `bits`,
`select`, `gate`, `any` and `table` have no row. They need more than operands, so each back end translates them itself.
"""

import functools
from typing import NamedTuple

import numpy as np

from diffabs.core.types import PyTree


class Operation(NamedTuple):
    """An operation on single numbers of one type.

    Attributes:
        fold: Function of constant operands (NumPy) that gives the result; None if constants are not folded.
        cpp: Template in C++ and CUDA C++, for vectors of lanes.
        c99: Template in C99; None without a translation.
        st: Template in Structured Text; None without a translation.
        symmetric: True if the operands may be exchanged.
        compares: True if the result is a boolean.
    """

    fold: PyTree
    cpp: str
    c99: str | None = None
    st: str | None = None
    symmetric: bool = False
    compares: bool = False


def _divide_towards_zero(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the integer quotient x / y, rounded towards zero as in C; NumPy's // rounds down."""
    return x // y + ((x % y != 0) & ((x < 0) != (y < 0)))


def _function(name: str, st: str | None = None, *, arity: int = 1, fold: object = None) -> Operation:
    """Return the row of a function that C99 calls `name` and `native/functions.h` k_`name`.

    ... in `st` stands for the operands. Without `fold`, constants are left to the back end.
    """
    operands = ", ".join(f"{{{i}}}" for i in range(arity))
    return Operation(fold, f"k_{name}({operands})", f"{name}{{f}}({operands})", st and st.replace("...", operands))


# a != a detects NaN in a. For NaN in b the comparison is false, so b is returned: the result is NaN either way.
_C_MIN, _ST_MIN = "{0} != {0} || {0} < {1} ? {0} : {1}", "SEL(({0} <> {0}) OR ({0} < {1}), {1}, {0})"
_C_MAX, _ST_MAX = "{0} != {0} || {0} > {1} ? {0} : {1}", "SEL(({0} <> {0}) OR ({0} > {1}), {1}, {0})"
# The conversion of IEC 61131-3 rounds to the nearest integer, half to even.
_ST_RINT = "LINT_TO_{real}({real}_TO_LINT({0}))"
# Near 0 the differences of exponentials cancel: Lambert's continued fraction and the power series do not.
_ST_TANH = "{0} / " + functools.reduce(lambda tail, k: f"({k}.0 + {{0}} * {{0}} / {tail})", range(11, 0, -2), "13.0")
_ST_SINH = "{0}" + functools.reduce(
    lambda tail, k: f" * (1.0 + {{0}} * {{0}} / {k * (k + 1)}.0{tail})", range(12, 0, -2), ""
)
# (e^x + e^-x)/2 and (e^x - e^-x)/2. Far from 0 the product of two roots does not overflow before its half does.
_ST_EXPONENTIALS = {
    sign: f"SEL(ABS({{0}}) < 80.0, 0.5 * EXP(0.5 * {{0}}) * EXP(0.5 * {{0}}) {sign} 0.5 * EXP(-0.5 * {{0}}) * "
    f"EXP(-0.5 * {{0}}), (EXP({{0}}) {sign} EXP(-{{0}})) / 2.0)"
    for sign in "+-"
}

OPERATIONS: dict[str, Operation] = {
    "add": Operation(np.add, "{0} + {1}", "{0} + {1}", "{0} + {1}", symmetric=True),
    "sub": Operation(np.subtract, "{0} - {1}", "{0} - {1}", "{0} - {1}"),
    "mul": Operation(np.multiply, "{0} * {1}", "{0} * {1}", "{0} * {1}", symmetric=True),
    "div": Operation(np.divide, "{0} / {1}", "{0} / {1}", "{0} / {1}"),
    "quotient": Operation(_divide_towards_zero, "{0} / {1}", "{0} / {1}", "{0} / {1}"),
    "rem": Operation(np.fmod, "rest({0}, {1})", "fmod{f}({0}, {1})"),
    "neg": Operation(np.negative, "-{0}", "-{0}", "-{0}"),
    "abs": Operation(np.abs, "size({0})", "fabs{f}({0})", "ABS({0})"),
    # For NaN `min` and `max` return NaN, `lower` and `higher` the second operand, as the processor's do.
    "min": Operation(np.minimum, "least({0}, {1})", _C_MIN, _ST_MIN),
    "max": Operation(np.maximum, "most({0}, {1})", _C_MAX, _ST_MAX),
    "lower": Operation(None, "lower({0}, {1})", "{0} < {1} ? {0} : {1}", "SEL({0} < {1}, {1}, {0})"),
    "higher": Operation(None, "higher({0}, {1})", "{0} > {1} ? {0} : {1}", "SEL({0} > {1}, {1}, {0})"),
    "eq": Operation(np.equal, "eq({0}, {1})", "{0} == {1}", "{0} = {1}", symmetric=True, compares=True),
    "ne": Operation(np.not_equal, "ne({0}, {1})", "{0} != {1}", "{0} <> {1}", symmetric=True, compares=True),
    "lt": Operation(np.less, "lt({0}, {1})", "{0} < {1}", "{0} < {1}", compares=True),
    "le": Operation(np.less_equal, "le({0}, {1})", "{0} <= {1}", "{0} <= {1}", compares=True),
    "is_finite": Operation(np.isfinite, "finite({0})", "isfinite({0}) != 0", "ABS({0}) <= {largest}", compares=True),
    "and": Operation(np.bitwise_and, "{0} & {1}", "{0} & {1}", "{0} AND {1}", symmetric=True),
    "or": Operation(np.bitwise_or, "{0} | {1}", "{0} | {1}", "{0} OR {1}", symmetric=True),
    "xor": Operation(np.bitwise_xor, "{0} ^ {1}", "{0} ^ {1}", "{0} XOR {1}", symmetric=True),
    "not": Operation(np.invert, "~{0}", "~{0}", "NOT {0}"),
    "shift_left": Operation(np.left_shift, "{0} << {1}", "{0} << {1}"),
    "shift_right_logical": Operation(np.right_shift, "{0} >> {1}", "{0} >> {1}"),
    "sqrt": Operation(np.sqrt, "root({0})", "sqrt{f}({0})", "SQRT({0})"),
    "rint": Operation(np.rint, "whole({0})", "rint{f}({0})", _ST_RINT),
    "floor": Operation(
        np.floor, "down({0})", "floor{f}({0})", f"SEL({_ST_RINT} > {{0}}, {_ST_RINT}, {_ST_RINT} - 1.0)"
    ),
    "ceil": Operation(np.ceil, "up({0})", "ceil{f}({0})", f"SEL({_ST_RINT} < {{0}}, {_ST_RINT}, {_ST_RINT} + 1.0)"),
    "exp": _function("exp", "EXP(...)", fold=np.exp),
    "log": _function("log", "LN(...)", fold=np.log),
    "log1p": _function("log1p"),
    "expm1": _function("expm1"),
    "sin": _function("sin", "SIN(...)"),
    "cos": _function("cos", "COS(...)"),
    "tan": _function("tan", "TAN(...)"),
    "asin": _function("asin", "ASIN(...)"),
    "acos": _function("acos", "ACOS(...)"),
    "atan": _function("atan", "ATAN(...)"),
    "atan2": _function("atan2", "ATAN2(...)", arity=2),
    "pow": _function("pow", "EXPT(...)", arity=2),
    "sinh": _function("sinh", f"SEL(ABS({{0}}) < 0.5, {_ST_EXPONENTIALS['-']}, {_ST_SINH})"),
    "cosh": _function("cosh", _ST_EXPONENTIALS["+"]),
    "tanh": _function("tanh", f"SEL(ABS({{0}}) < 0.5, 1.0 - 2.0 / (EXP(2.0 * {{0}}) + 1.0), {_ST_TANH})"),
}
MIRRORED = {"gt": "lt", "ge": "le"}  # the same comparison with the operands exchanged
NEGATED = {"eq": "ne", "ne": "eq"}  # not "lt" and "ge": both are false for NaN
