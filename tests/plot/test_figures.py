"""What can be told of a figure without looking: labels that do not touch, legends beside the data, shared axes."""

import dataclasses
import importlib

import numpy as np
import pytest
from marks import cases, readable_id
from mutants import killed_by

from diffabs.linear import band, margins, open_loop
from diffabs.output import plot
from diffabs.output.plot.frequency import loop_shape
from diffabs.parts.controllers import HoldingInput, StateFeedback
from diffabs.parts.plants import MirroredRig
from diffabs.parts.references import FixedSlip
from diffabs.scenario.defaults import braking


def boxes(axis):
    """Extents (k, 2, 2) of the labels of an axis that are seen."""
    figure = axis.axes.figure
    figure.draw_without_rendering()
    low, high = sorted(axis.get_view_interval())
    ticks = [*axis.get_major_ticks(), *axis.get_minor_ticks()]
    seen = [tick.label1 for tick in ticks if low <= tick.get_loc() <= high and tick.label1.get_text()]
    return np.array([text.get_window_extent().get_points() for text in seen])


ENDS = [(0.05, 4.0), (3e-7, 2e-6), (1e-5, 1e-3), (2e4, 3e7)]


@killed_by("output.plot.style", "scale_axis.set_minor_formatter(NullFormatter())", "pass", case="0.2, 0.9")
@pytest.mark.parametrize(
    "ends",
    cases([(0.2, 0.9), (1e-9, 1e3), *ENDS], *ENDS),
    ids=readable_id,
)
def test_labels_of_a_logarithmic_axis_do_not_touch(ends):
    _, (ax,) = plot.sheet(size=(2.6, 2.2))
    for axis in "xy":
        plot.make_logarithmic(ax, axis)
    ax.set_xlim(*ends)
    ax.set_ylim(*ends)
    for i, axis in enumerate((ax.xaxis, ax.yaxis)):
        found = boxes(axis)
        assert len(found) >= 2
        order = np.argsort(found[:, 0, i])
        assert (found[order][1:, 0, i] > found[order][:-1, 1, i]).all()


@killed_by("output.plot.style", "few = low > 0 and", "few = low > 0 or")
@killed_by("output.plot.style", "{mantissa:g}", "{mantissa:.0f}")
def test_a_long_axis_has_powers_and_a_short_one_numbers():
    _, (ax,) = plot.sheet()
    plot.make_logarithmic(ax, "x")
    said = ax.xaxis.get_major_formatter()
    ax.set_xlim(1e-6, 1e4)
    assert said(1e-3) == "10⁻³"
    assert said(1.0) == "10⁰"
    ax.set_xlim(0.1, 5.0)
    assert said(0.2) == "0.2"
    ax.set_xlim(1e-7, 5e-6)
    assert said(2e-7) == "2\N{MULTIPLICATION SIGN}10⁻⁷"
    assert said(2.5e-6) == "2.5\N{MULTIPLICATION SIGN}10⁻⁶"


@pytest.mark.slow
@killed_by("output.plot.frequency", "(1 / (1 + main), COLOURS[1]", "(main / (1 + main), COLOURS[1]")
def test_the_curves_of_a_loop_are_its_response():
    loop = braking(plant=MirroredRig(), reference=FixedSlip(), feedforward=HoldingInput(), controller=StateFeedback())
    opened, others = open_loop(loop), band(loop, {"plant.mass": (5.0, 6.5)}, samples=2)
    figure = loop_shape(opened, margins(opened), [one.loop for one in others.systems], title="a loop")
    magnitude, nyquist, phase, closed = figure.axes
    w, db = magnitude.lines[0].get_data()
    response = opened.transfer().response(w)[:, 0, 0]
    np.testing.assert_allclose(db, 20 * np.log10(np.abs(response)), rtol=1e-12)
    np.testing.assert_allclose(np.exp(1j * np.radians(phase.lines[0].get_ydata())), response / np.abs(response))
    np.testing.assert_allclose(closed.lines[0].get_ydata(), -20 * np.log10(np.abs(1 + response)), atol=1e-10)
    at = magnitude.lines[-1].get_xdata()[0]
    assert abs(opened.transfer().response(at)[0, 0, 0]) == pytest.approx(1.0)
    circle = nyquist.lines[-1].get_xydata()
    assert np.hypot(circle[:, 0] + 1, circle[:, 1]) == pytest.approx(margins(opened).modulus)
    assert len(magnitude.collections) == 1
    assert magnitude.get_xscale() == phase.get_xscale() == closed.get_xscale() == "log"


@pytest.mark.slow
def test_the_cure_is_drawn_on_shared_axes_with_its_legend_below():
    cure, cure_figures = (importlib.import_module(f"experiments.overshoot_cured.{name}") for name in ("run", "figures"))
    config = cure.Config()
    loops = cure.contenders(config, cure.start(config), (-8000.0, -100.0))
    few = cure.dataclasses.replace(config, drawn=config.drawn[:2], step=1e-3, longer=0.05)
    figure = cure_figures.before_and_after(few, loops)
    slips, torques = figure.axes[:2], figure.axes[2:]
    assert slips[0].get_xlim() == slips[1].get_xlim() == torques[0].get_xlim()
    assert torques[0].get_ylim() == torques[1].get_ylim()
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert all(legend.get_window_extent().y1 <= ax.get_window_extent().y0 for ax in figure.axes)
    assert not any(ax.get_legend() for ax in figure.axes)


@pytest.mark.slow
def test_all_masses_are_drawn_with_the_worst_of_them():
    cure, cure_figures = (importlib.import_module(f"experiments.overshoot_cured.{name}") for name in ("run", "figures"))
    config = dataclasses.replace(cure.Config(), step=1e-3, duration=0.3)
    figure = cure_figures.all_masses(config, {"it": cure.start(config)})
    panel, bar = figure.axes
    slips = [line.get_ydata() for line in panel.lines[:-1]]
    assert len(slips) == cure_figures.MASSES * cure_figures.STARTS
    assert {line.get_color() for line in panel.lines[:13]} != {panel.lines[0].get_color()}
    worst = 100 * (max(map(max, slips)) / config.slip - 1)
    assert float(panel.get_title().split(": ")[1].split(" %")[0]) == pytest.approx(worst, rel=0.1)
    assert bar.get_ylabel() == "mass [kg]"


def test_a_dollar_sign_begins_no_formula(tmp_path):
    figure, (ax,) = plot.sheet(title="$x^$ costs")
    ax.plot([1.0, 2.0], [1.0, 2.0], label="$a^$")
    ax.set_yticks([1.0, 2.0], ["$b^$", "c"])
    plot.label_axes(ax, "$d^$", "$\\e$", "$f^$")
    plot.save_figure(figure, tmp_path / "figure.png")
    plot.save_figure(figure, tmp_path / "figure.svg")
    assert (tmp_path / "figure.png").stat().st_size > 1000
