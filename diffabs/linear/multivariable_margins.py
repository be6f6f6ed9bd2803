"""Margins of a loop with several channels together, by singular values.

    L  the open loop, a matrix, closed by negative feedback;   S = (I + L)^-1,   T = L (I + L)^-1

The least singular value of the return difference I + L is the smallest ||E|| with I + L + E singular, at a frequency.
Its least value over all frequencies is the reciprocal of the peak of S. At the plant's input L = K G is opened at all
commands, at the output L = G K at all measured outputs that the controller uses.

A frequency is found on a grid with points between neighbours with different S, and then by golden-section search.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from diffabs.core.jax_flags import default_flags
from diffabs.core.types import JsonObject
from diffabs.linear.channel_loop import check_closable, sample_channels
from diffabs.linear.opened_loop import OpenLoop
from diffabs.linear.stability_margins import (
    GRID_DECADES,
    MAX_GRID_FREQUENCIES,
    MAX_GRID_REFINEMENTS,
    NEIGHBOUR_DISTANCE,
    PER_DECADE,
    Margins,
    closed_loop_poles,
    find_peak,
    json_number,
    margins,
)
from diffabs.linear.transfer import Transfer, check_transfer

MAX_SCALING = 1e6  # of a channel by which the disk margin is balanced
BALANCINGS = 20  # passes over the channels; one is enough for two

MULTIVARIABLE_UNITS = {"smallest": "1", "sensitivity": "1", "complementary": "1", "disk": "1"} | dict.fromkeys(
    ("sensitivity_at", "complementary_at", "disk_at"), "rad/s"
)

Response = Callable[[np.ndarray], np.ndarray]


class ReturnDifference(NamedTuple):
    """Margins at one place of a loop with several channels; NaN for an unstable closed loop.

    In continuous time a frequency may be infinite: the limit of L counts. Singular values depend on the units of the
    signals; the disk margin does not.

    Attributes:
        sensitivity: Ms, the largest singular value of S over all frequencies.
        sensitivity_at: Its frequency [rad/s].
        complementary: Mt, the largest singular value of T.
        complementary_at: Its frequency [rad/s].
        disk: Disk margin a: the closed loop stays stable if all channels are multiplied at once by any complex
            factors (1 + d/2)/(1 - d/2) with |d| < a, each its own. It is a lower bound.
        disk_at: Its frequency [rad/s].
    """

    sensitivity: float
    sensitivity_at: float
    complementary: float
    complementary_at: float
    disk: float
    disk_at: float

    @property
    def smallest(self) -> float:
        """The least singular value of I + L over all frequencies, 1/Ms; it is at `sensitivity_at`."""
        return 1 / self.sensitivity

    @property
    def gain(self) -> tuple[float, float]:
        """Factors (low, high) between which the gains of all channels may be, each its own, by the disk margin."""
        high = (2 + self.disk) / (2 - self.disk) if self.disk < 2 else math.inf
        return (2 - self.disk) / (2 + self.disk) if self.disk < 2 else 0.0, high

    @property
    def phase(self) -> float:
        """Angle by which the phases of all channels may change, each its own, by the disk margin [rad]."""
        return 2 * math.atan(self.disk / 2)

    def record(self) -> JsonObject:
        """Return the numbers, `smallest` included, as JSON values, in the units of `MULTIVARIABLE_UNITS`."""
        return {name: json_number(getattr(self, name)) for name in MULTIVARIABLE_UNITS}


class MultivariableMargins(NamedTuple):
    """Margins of a loop with several channels.

    Attributes:
        stable: Whether the closed loop is stable.
        poles: Poles of the closed loop, in z if it is sampled, else in s.
        channels: Margins of each channel by name, with the others closed; empty for a `Transfer`.
        input: Margins at the plant's input, opened at all commands.
        output: Margins at the measured outputs that the controller uses; None for a `Transfer`, and for a controller
            whose feed-forward depends on what is measured.
    """

    stable: bool
    poles: np.ndarray
    channels: dict[str, Margins]
    input: ReturnDifference
    output: ReturnDifference | None

    def record(self) -> JsonObject:
        """Return the margins as JSON values."""
        return {
            "stable": self.stable,
            "channels": {name: single.record() for name, single in self.channels.items()},
            "input": self.input.record(),
            "output": self.output.record() if self.output else None,
        }


@default_flags()
def multivariable_margins(loop: OpenLoop | Transfer) -> MultivariableMargins:
    """Return the margins of a loop with several channels: of each channel, and of all together by singular values.

    Args:
        loop: Open loop with as many inputs as outputs, without a delay in continuous time.

    Raises:
        ValueError: The loop is no open loop, is not square, has a field that `check_transfer` refuses, or has a delay
            in continuous time.

    See also:
        `linear.margins`: Margins of one channel.
        `linear.open_loop`: The loop of a plant and a controller, opened at the controls.

    Notes:
        With the largest singular value s, and D a diagonal scaling of the channels that balances rows and columns

            sensitivity     max s(S)                the peak; 1/Ms is the least singular value of I + L
            complementary   max s(T)
            disk            1/max s(D (S - I/2) D^-1)

        over all frequencies. The disk margin is a bound by Safonov's method: the scaling does not change what diagonal
        factors do, and the small-gain theorem does the rest (P. Seiler, A. Packard and P. Gahinet, An introduction to
        disk margins, IEEE Control Systems Magazine 40 (2020), pp. 78-95).

    Examples:
        Two equal channels L = 1/(s + 1) that do not meet have the margins of one:

        >>> import numpy as np
        >>> from diffabs.linear import Transfer, multivariable_margins
        >>> both = multivariable_margins(Transfer(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))))
        >>> both.stable, both.input.smallest, both.input.disk
        (True, 1.0, 2.0)
    """
    if not isinstance(loop, OpenLoop | Transfer):
        raise ValueError(
            f"loop = {type(loop).__name__} is no OpenLoop or Transfer: open_loop(loop) makes one of a Loop"
        )
    if isinstance(loop, OpenLoop):
        check_closable(loop)
        system = loop.transfer().without_delay()
    else:
        system = check_transfer(loop).without_delay()
    if np.shape(system.D)[0] != np.shape(system.D)[1]:
        raise ValueError(f"L has the shape {np.shape(system.D)}; as many outputs as inputs are needed")
    poles = closed_loop_poles(system)
    stable = bool(np.all((np.real(poles) if system.period is None else np.abs(poles) - 1) < 0))  # NaN is not stable
    names = loop.channels if isinstance(loop, OpenLoop) else ()
    at_output = respond_at_output(loop) if isinstance(loop, OpenLoop) else None
    grid = _frequency_grid(system, poles)
    ends = system.period is None
    return MultivariableMargins(
        stable,
        poles,
        {name: margins(loop, name) for name in names},
        _return_difference(system.response, grid, stable, system.D if ends else None),
        _return_difference(at_output, grid, stable, 0.0 if ends else None) if at_output else None,
    )


def respond_at_output(loop: OpenLoop) -> Response | None:
    """Return the response of L = G K at the measured outputs that the controller uses, or None.

    None says that the feed-forward depends on what is measured. The last inputs of the controller are the feed-forward.
    """
    plant, controller = loop.plant, loop.controller
    used = (plant.C != 0).any(axis=1) & ((controller.B != 0).any(axis=0) | (controller.D != 0).any(axis=0))
    if used[-controller.D.shape[0] :].any():
        return None
    if loop.period is not None:
        plant = sample_channels(plant, loop.period, np.full(plant.B.shape[1], loop.delay))
    plant = plant._replace(C=plant.C[used], D=plant.D[used])
    controller = controller._replace(B=controller.B[:, used], D=controller.D[:, used])
    return lambda w: -plant.response(w) @ controller.response(w)


def _return_difference(
    respond: Response, w: np.ndarray, stable: bool, at_infinity: np.ndarray | float | None
) -> ReturnDifference:
    """Return the margins of an open loop; `at_infinity` is the limit of L in continuous time."""
    if not stable:
        return ReturnDifference(*(math.nan,) * 6)
    w = np.concatenate([[0.0], _refine_grid(respond, w)])
    peaks = []
    for measure in (_sensitivity, _complementary, _balanced_disk):
        peak, at = find_peak(lambda w, measure=measure: measure(_sensitivities(respond(w))), w)
        if at_infinity is not None:
            far = at_infinity * np.eye(respond(w[:1]).shape[1]) if np.ndim(at_infinity) == 0 else at_infinity
            peak, at = max((peak, at), (float(measure(_sensitivities(np.asarray(far)[None]))[0]), math.inf))
        peaks += [peak, at]
    ms, ms_at, mt, mt_at, disk, disk_at = peaks
    return ReturnDifference(ms, ms_at, mt, mt_at, 1 / disk if disk else math.inf, disk_at)


def _sensitivities(values: np.ndarray) -> np.ndarray:
    """Return S = (I + L)^-1, (k, m, m); NaN at a pole of L."""
    identity = np.eye(values.shape[1])
    finite = np.isfinite(values).all(axis=(1, 2))
    s = np.zeros_like(values)
    s[finite] = np.linalg.inv(identity + values[finite])
    s[~finite] = math.nan
    return s


def _sensitivity(s: np.ndarray) -> np.ndarray:
    return _largest_singular_values(s)


def _complementary(s: np.ndarray) -> np.ndarray:
    return _largest_singular_values(np.eye(s.shape[1]) - s)


def _balanced_disk(s: np.ndarray) -> np.ndarray:
    """Return the largest singular value of D (S - I/2) D^-1, with a D that balances rows and columns."""
    m = s - 0.5 * np.eye(s.shape[1])
    for _ in range(BALANCINGS if m.shape[1] > 2 else 1):
        for i in range(m.shape[1]):
            others = np.arange(m.shape[1]) != i
            row, column = np.linalg.norm(m[:, i, others], axis=1), np.linalg.norm(m[:, others, i], axis=1)
            with np.errstate(all="ignore"):
                scale = np.nan_to_num(np.sqrt(column / row), nan=1.0, posinf=MAX_SCALING)
            scale = np.clip(scale, 1 / MAX_SCALING, MAX_SCALING)[:, None]
            m[:, i, :] *= scale
            m[:, :, i] /= scale
    return _largest_singular_values(m)


def _largest_singular_values(matrices: np.ndarray) -> np.ndarray:
    """Return the largest singular value of each matrix; NaN where an entry is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    values = np.full(len(matrices), math.nan)
    values[finite] = np.linalg.svd(matrices[finite], compute_uv=False)[:, 0]
    return values


def _frequency_grid(system: Transfer, closed: np.ndarray) -> np.ndarray:
    """Return frequencies (k,) [rad/s] from well below to well above the poles of open and closed loop."""
    poles = np.concatenate([system.poles, closed[np.isfinite(closed)]]).astype(complex)
    if system.period is not None:
        poles = np.log(poles[np.abs(poles) > 1e-12]) / system.period
    half = math.pi / system.period if system.period else math.inf
    sizes = np.abs(poles)
    sizes = sizes[sizes > 1e-9 * np.max(sizes, initial=0.0)] if len(sizes) else np.array([min(1.0, half)])
    low, high = min(sizes.min(), half) * 10.0**-GRID_DECADES, min(sizes.max() * 10.0**GRID_DECADES, half)
    w = np.geomspace(low, high, int(PER_DECADE * math.log10(high / low)) + 2)
    around = [abs(p.imag) + abs(p.real) * np.linspace(-5, 5, 41) for p in poles if p.imag > 0]
    w = np.unique(np.concatenate([w, *around]))
    return w[(w >= low) & (w <= high)]


def _refine_grid(respond: Response, w: np.ndarray) -> np.ndarray:
    """Return the grid with points added between neighbours with different S."""
    for _ in range(MAX_GRID_REFINEMENTS):
        s = np.nan_to_num(_sensitivities(respond(w)))
        sizes = np.maximum(1.0, np.linalg.norm(s, axis=(1, 2)))
        change = np.linalg.norm(np.diff(s, axis=0), axis=(1, 2))
        wide = change > NEIGHBOUR_DISTANCE * np.minimum(sizes[1:], sizes[:-1])
        wide &= np.diff(w) > 1e-9 * w[1:]
        if not wide.any() or len(w) > MAX_GRID_FREQUENCIES:
            break
        w = np.insert(w, np.flatnonzero(wide) + 1, np.sqrt(w[:-1][wide] * w[1:][wide]))
    return w
