"""Names, shapes and ranges of the data of each kind of claim."""

from collections.abc import Callable

import numpy as np

from diffabs.core.types import Params, PyTree, Scalar
from diffabs.robust.design.polytopes import Polytope, Schedule

# A letter for each axis: n states, m inputs, V vertices, N nodes, others free; "|" separates alternatives. A field with
# "?" is optional.
FIELD_SHAPES = {
    "decay": {"P": "nn", "rate?": "", "factor?": ""},
    "cost": {"P": "nn", "Q": "nn", "R": "mm", "x0?": "n"},
    "damping": {"P": "nn", "cot": "", "zeta": ""},
    "l2": {"P": "nn", "gamma": "", "Bw": "nw|Vnw", "C": "zn", "D": "zm"},
    "input": {"P": "nn", "limit": "m", "points": "kn"},
    "infeasible": {"W": "Vnn", "rate?": "", "factor?": ""},
    "unstable": {"P": "nn", "x": "n", "vertex": "", "rate?": "", "factor?": ""},
    "scheduled": {"P": "Nnn", "rates": "2", "rate?": "", "Q?": "nn", "R?": "mm"},
}
FIELD_RANGES: dict[str, tuple[str, Callable[[PyTree], PyTree]]] = {
    "rate": ("not be negative", lambda value: value >= 0),
    "factor": ("lie in (0, 1]", lambda value: 0 < value <= 1),
    "zeta": ("lie in [0, 1)", lambda value: 0 <= value < 1),
    "cot": ("not be negative", lambda value: value >= 0),
    "gamma": ("be positive", lambda value: value > 0),
    "limit": ("be positive", lambda value: value > 0),
    "rates": ("increase", lambda value: value[0] <= value[1]),
}
# A disproof may also concern growth: a factor above 1 or a negative rate.
DISPROOF_KINDS = ("infeasible", "unstable")
DISPROOF_RANGES = {"factor": ("be positive", FIELD_RANGES["gamma"][1])}


def check_claim(kind: str, system: Polytope | Schedule, gain: np.ndarray, data: Params) -> None:
    """Check that a claim fits the system and the gain."""
    cell = system.cells[0] if isinstance(system, Schedule) else system
    if (kind == "scheduled") != isinstance(system, Schedule) or kind not in FIELD_SHAPES:
        raise ValueError(
            f"kind {kind!r} is no claim about a {type(system).__name__.lower()}; known: {', '.join(FIELD_SHAPES)}"
        )
    if cell.period is not None and kind in ("scheduled", "damping"):
        raise ValueError(f"{kind} claims are for continuous time")
    sizes = check_gain(system, gain)
    fields = {key.rstrip("?"): (shape, "?" in key) for key, shape in FIELD_SHAPES[kind].items()}
    fields.pop("rate" if cell.period is not None else "factor", None)
    if unknown := sorted(set(data) - set(fields)):
        raise ValueError(f"{kind}.{unknown[0]} is not a field of the claim; known: {', '.join(fields)}")
    for name, (shape, optional) in fields.items():
        if name not in data and not optional:
            raise ValueError(f"{kind}.{name} is missing")
        if name not in data:
            continue
        if not any(matches_shape(data[name], each, sizes) for each in shape.split("|")):
            raise ValueError(f"{kind}.{name} has shape {np.shape(data[name])}; needed: {shape or 'a number'}, {sizes}")
        if not np.isfinite(data[name]).all():
            raise ValueError(f"{kind}.{name} has an entry that is not finite")
        says, holds = (DISPROOF_RANGES if kind in DISPROOF_KINDS else FIELD_RANGES).get(
            name, ("be finite", np.isfinite)
        )
        if not np.all(holds(data[name])):
            raise ValueError(f"{kind}.{name} must {says}; got {data[name]}")
    if kind == "unstable" and data["vertex"] not in range(sizes["V"]):
        raise ValueError(f"unstable.vertex must be one of 0 to {sizes['V'] - 1}; got {data['vertex']}")


def check_gain(system: Polytope | Schedule, gain: np.ndarray) -> dict[str, int]:
    """Return sizes by letter (`FIELD_SHAPES`) after a check of the gain, (N, m, n) for N nodes, else (m, n)."""
    cell = system.cells[0] if isinstance(system, Schedule) else system
    sizes = {"n": cell.order, "m": cell.inputs, "2": 2}
    sizes |= {"N": len(system.nodes)} if isinstance(system, Schedule) else {"V": system.vertices}
    shapes = ("mn", "Nmn") if isinstance(system, Schedule) else ("mn",)
    if not any(matches_shape(gain, each, sizes) for each in shapes) or not np.isfinite(gain).all():
        raise ValueError(f"gain must be finite, {cell.inputs} by {cell.order}; has shape {np.shape(gain)}")
    return sizes


def matches_shape(value: Scalar, letters: str, sizes: dict[str, int]) -> bool:
    """Return whether the axes of `value` have the sizes of the letters; a new letter is added to `sizes`."""
    shape = np.shape(value)
    return len(shape) == len(letters) and all(
        0 < size == sizes.setdefault(letter, size) for letter, size in zip(letters, shape, strict=True)
    )
