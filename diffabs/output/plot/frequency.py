"""Figure of a loop in the frequency domain: Bode and Nyquist plots and sensitivities, with the band of its box."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes

from diffabs.linear.opened_loop import OpenLoop
from diffabs.linear.robustness import frequencies, loop_responses, sensitivity_gains, shape_bound
from diffabs.linear.stability_margins import Margins
from diffabs.output.plot.style import COLOURS, GREY, Sheet, curve_style, label_axes, make_logarithmic, sheet

if TYPE_CHECKING:
    from diffabs.tune import FrequencyBounds

MAX_NYQUIST_RADIUS = 3.0  # largest real or imaginary part that the Nyquist plot shows
LIGHT = 0.25  # opacity of the band
LEAST_DB = -80.0  # lower end of the magnitude axis; half of it for the sensitivities


def loop_shape(loop: OpenLoop, margins: Margins, band: Sequence[OpenLoop] = (), *, title: str = "") -> Sheet:
    """Return a figure of the open loop L, which includes the controller, and its sensitivities S and T.

    The panels are magnitude and phase of L, its Nyquist plot, and |S| and |T|. For a stable loop the Nyquist plot has a
    circle about -1 that L does not enter. Its radius is 1/Ms, the modulus margin.

    Args:
        band: Loops drawn as a band behind the curves, from the smallest to the largest value at each frequency.
    """
    w = frequencies([loop, *band])
    figure, (magnitude, nyquist, phase, closed) = sheet(2, 2, title=title, size=(5.6, 3.4))
    main, around = _response(loop, w), np.array([_response(open_loop, w) for open_loop in band])
    for ax in (magnitude, phase, closed):
        make_logarithmic(ax, "x")
        ax.set_xlim(w[0], w[-1])
    _draw_band(magnitude, w, _db(main), _db(around), COLOURS[0], "L")
    magnitude.axhline(0, color=GREY, linewidth=0.8)
    magnitude.set_ylim(max(magnitude.get_ylim()[0], LEAST_DB), None)
    label_axes(magnitude, "", "|L| [dB]", legend=False)
    _draw_band(phase, w, _degrees(main), np.array([_degrees(response) for response in around]), COLOURS[0], "L")
    phase.axhline(-180, color=GREY, linewidth=0.8)
    label_axes(phase, "frequency [rad/s]", "phase of L [degrees]", legend=False)
    _nyquist(nyquist, main, around, margins)
    for values, colour, name in ((1 / (1 + main), COLOURS[1], "S"), (main / (1 + main), COLOURS[2], "T")):
        band_values = 1 / (1 + around) if name == "S" else around / (1 + around)
        _draw_band(closed, w, _db(values), _db(band_values), colour, name)
    closed.axhline(0, color=GREY, linewidth=0.8)
    closed.set_ylim(max(closed.get_ylim()[0], LEAST_DB / 2), None)
    label_axes(closed, "frequency [rad/s]", "sensitivities [dB]")
    if np.isfinite(margins.crossover):
        for ax in (magnitude, phase):
            ax.axvline(margins.crossover, color=GREY, linewidth=0.8, linestyle=":")
    return figure


def draw_sensitivities(
    sensitivity: Axes, complementary: Axes, boxes: Mapping[str, Sequence[OpenLoop]], bounds: "FrequencyBounds"
) -> None:
    """Draw the range of |S| and |T| over the loops of each box, and their bounds.

    A box is a band from the least to the greatest value at each frequency; its upper edge is a line. Of a loop with
    several channels the values are the largest singular values.
    """
    w = frequencies([loop for loops in boxes.values() for loop in loops])
    for i, (name, loops) in enumerate(boxes.items()):
        gains = sensitivity_gains(loop_responses(loops, w))
        for ax, values in zip((sensitivity, complementary), gains, strict=True):
            _draw_range(ax, w, values, name, i)
    for ax, bound in ((sensitivity, bounds.sensitivity), (complementary, bounds.complementary)):
        if bound is not None:
            ax.axhline(bound, color=GREY, linewidth=1.2, linestyle=":", label=f"bound {bound:g}")
    if bounds.shape:
        sensitivity.plot(w, shape_bound(bounds.shape, w), color=GREY, linewidth=1.2, linestyle=":", label="shape")
    for ax, name in ((sensitivity, "|S|"), (complementary, "|T|")):
        make_logarithmic(ax, "x")
        ax.set_xlim(w[0], w[-1])
        ax.set_ylim(0, None)
        label_axes(ax, "frequency [rad/s]", f"{name} over the box [1]")


def _draw_range(ax: Axes, w: np.ndarray, values: np.ndarray, name: str, i: int) -> None:
    """Draw the band of some curves (k, n) over the frequencies, with its upper edge as a line."""
    style = curve_style(i)
    ax.fill_between(w, values.min(axis=0), values.max(axis=0), color=style["color"], alpha=LIGHT, linewidth=0)
    ax.plot(w, values.max(axis=0), label=name, **style)


def _response(loop: OpenLoop, w: np.ndarray) -> Any:
    return loop.transfer().response(w)[:, 0, 0]


def _db(values: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):  # a zero of the loop has -inf dB, which matplotlib leaves out
        return 20 * np.log10(np.abs(values))


def _degrees(values: np.ndarray) -> np.ndarray:
    """Return the phase [degrees], continuous, and in (-360, 0] at the frequency where |L| is closest to 1."""
    # unwrap leaves a multiple of 2 pi open; the frequency nearest to the crossover fixes it.
    angles = np.unwrap(np.angle(values))
    near = angles[np.argmin(np.abs(np.log(np.abs(values))))]
    return np.degrees(angles - 2 * np.pi * np.ceil(near / (2 * np.pi)))


def _draw_band(ax: Axes, w: np.ndarray, main: np.ndarray, around: np.ndarray, colour: str, name: str) -> None:
    """Draw a curve over the band between the smallest and the largest value of the other curves."""
    if len(around):
        ax.fill_between(w, around.min(axis=0), around.max(axis=0), color=colour, alpha=LIGHT, linewidth=0)
    ax.plot(w, main, color=colour, label=name)


def _nyquist(ax: Any, main: Any, around: Any, margins: Margins) -> None:
    """Draw L in the complex plane, with the point -1 and the circle that L does not enter."""
    for values in around:
        ax.plot(values.real, values.imag, color=COLOURS[0], alpha=LIGHT, linewidth=0.7)
    ax.plot(main.real, main.imag, color=COLOURS[0], label="L")
    ax.plot([-1], [0], "+", color=COLOURS[1], markersize=10)
    if margins.stable:
        turn = np.linspace(0, 2 * np.pi, 181)
        circle = -1 + margins.modulus * np.exp(1j * turn)
        ax.plot(circle.real, circle.imag, "--", color=COLOURS[1], linewidth=1, label=f"1/Ms = {margins.modulus:.3g}")
    ax.set_xlim(-MAX_NYQUIST_RADIUS, MAX_NYQUIST_RADIUS - 1)
    ax.set_ylim(-MAX_NYQUIST_RADIUS + 0.5, MAX_NYQUIST_RADIUS - 0.5)
    ax.set_aspect("equal", adjustable="box")
    label_axes(ax, "Re L", "Im L")
