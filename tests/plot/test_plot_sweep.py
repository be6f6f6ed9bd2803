"""Figures of sweeps: what is drawn are the columns. The sweeps are made up, a manifest and chunks without any run."""

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.text import Text
from mutants import killed_by
from scipy.stats import beta
from seams import replace_seam
from sweeping import manifest

from diffabs.engine.solvers import FixedStep
from diffabs.output.plot import sweeps as plots
from diffabs.scenario.defaults import balancing
from diffabs.uncertainty.sweep import Results, Space, Study, Uniform
from diffabs.uncertainty.sweep.manifest import Seals
from diffabs.uncertainty.sweep.seal import encode_chunk as chunk
from diffabs.uncertainty.sweep.statistics.summary import summarise_sweep
from diffabs.uncertainty.sweep.store import Store

N = 1200
A, B, C = np.random.default_rng(5).random((3, N))
OVERSHOOT = (B - 0.5) ** 2 + 0.1 * C + 1e-3 * A  # worst at both ends of b, which no correlation sees
DIVERGED = np.isin(np.arange(N), (7, 500, 1100))


@pytest.fixture
def made(tmp_path):
    """Write a sweep of two chunks; columns that are not given are those of runs that all ended well."""

    def write(variables, metrics, *, design="random", failures=None, stopped=True, diverged=False, name="", **study):
        n = len(next(iter(variables.values())))
        flags = {"stopped": np.full(n, stopped), "diverged": np.full(n, diverged), "refused": np.full(n, "", object)}
        metrics = {key: np.where(flags["diverged"], np.nan, column) for key, column in metrics.items()}
        columns = {"sample": np.arange(n), **variables, **metrics, **flags}
        store, size = Store(tmp_path / str(len(list(tmp_path.iterdir())))), -(-n // 2)
        store.folder.mkdir()
        own = {"locked_time": 0.0} if "locked_time" in metrics else {}  # as a study writes what objectives say
        table = manifest(n, size, variables, metrics, failures=own | (failures or {}), **study)
        table["source"] = {"name": name}
        table["study"]["space"]["design"] = {"type": design, **({"levels": n} if design == "grid" else {})}
        store.begin(table, resume=False)
        for i in range(-(-n // size)):
            part = {key: column[i * size : (i + 1) * size] for key, column in columns.items()}
            store.write(i, chunk(part, Seals(table).of(i)))
        return Results(store.folder)

    return write


@pytest.fixture
def found(made):
    """Three variables, a metric that varies and one that does not; three runs diverged, some did not stop."""
    metrics = {"locked_time": np.zeros(N), "overshoot": OVERSHOOT, "effort": 5 + A}
    variables = {"plant.a": A, "initial.speed": B, "plant.c": C}
    bound = {"overshoot": 0.3}
    return made(variables, metrics, failures=bound, stopped=C > 0.1, diverged=DIVERGED, name="rig")


UNITS = {"initial.speed": "m/s", "plant.c": "kg", "overshoot": "1"}


def panels(figure):
    return {ax.get_xlabel().split(" [")[0]: ax for ax in figure.axes}


def lines(ax):
    return {line.get_label(): np.array(line.get_data(), float) for line in ax.get_lines()}


def test_histograms_are_those_of_the_runs_that_did_not_diverge(found):
    figure = plots.draw_distributions(found, UNITS)
    assert list(panels(figure)) == ["overshoot", "effort"]  # locked_time is constant
    ax, values = panels(figure)["overshoot"], OVERSHOOT[~DIVERGED]
    counts, edges, _ = ax.patches[0].get_data()
    np.testing.assert_array_equal(counts, np.histogram(values, edges)[0])
    assert counts.sum() == N - 3
    assert (edges[0], edges[-1]) == (values.min(), values.max())
    marked = [line.get_xdata()[0] for line in ax.get_lines()]
    assert marked == pytest.approx([*np.quantile(values, (0.5, 0.05, 0.95)), 0.3], rel=1e-14)
    assert ax.get_xlabel() == "overshoot [1]"
    assert figure.get_suptitle() == "rig: distributions of 1,197 runs (3 diverged)"


def test_outliers_are_counted_beside_the_histogram(made):
    values = np.r_[A, 1e3, 2e3]
    ax = plots.draw_distributions(made({"a": np.r_[A, 0, 1]}, {"effort": values})).axes[0]
    counts, edges, _ = ax.patches[0].get_data()
    assert counts.sum() == N
    assert edges[-1] < 4
    assert ax.get_ylabel() == "runs (2 more outside)"


def test_a_bound_far_from_the_data_does_not_press_them_together(made):
    near, far = (
        plots.draw_distributions(made({"a": A}, {"effort": A}, failures={"effort": bound})).axes[0]
        for bound in (1.5, 30.0)
    )
    assert near.get_xlim()[1] > 1.5
    assert far.get_xlim()[1] < 1.1
    assert "bound 30" in lines(far)


@killed_by("output.plot.sweeps", "ax.plot(x, counts / n,", "ax.plot(x, 1 - counts / n,")
def test_exceedance_is_one_minus_the_empirical_distribution(found):
    figure = plots.draw_exceedance(found, UNITS, confidence=0.9)
    ax, values = panels(figure)["overshoot"], OVERSHOOT[~DIVERGED]
    x, share = lines(ax)["runs"]
    inner = x[1:-1].reshape(-1, 2)
    assert len(inner) > 60
    np.testing.assert_array_equal(inner[:, 0], inner[:, 1])
    for at, (before, after) in zip(inner[:, 0], share[1:-1].reshape(-1, 2), strict=True):
        assert (before, after) == (np.mean(values >= at), np.mean(values > at))
    assert np.isin(np.sort(values)[-20:], inner).all()  # near its end, step by step
    assert (share[0], share[-1], ax.get_yscale()) == (1, 0, "log")
    assert lines(ax)["bound 0.3"][0, 0] == 0.3


@killed_by("output.plot.sweeps", "Count(int(k), n)", "Count(int(n - k), n)")
def test_the_band_is_that_of_clopper_and_pearson(found):
    ax, n = panels(plots.draw_exceedance(found, confidence=0.9))["overshoot"], N - 3
    x, share = lines(ax)["runs"]
    k = np.round(share * n)
    low = np.where(k > 0, beta.ppf(0.05, np.maximum(k, 1), n - k + 1), 0.0)
    high = np.where(k < n, beta.ppf(0.95, k + 1, np.maximum(n - k, 1)), 1.0)
    (band,) = ax.collections
    drawn = band.get_paths()[0].vertices
    assert band.get_label() == "90 % band"
    for at, *ends in zip(x, low, high, strict=True):
        assert all(np.isclose(drawn, (at, end), rtol=1e-12, atol=0).all(axis=1).any() for end in ends)


@pytest.mark.parametrize(("design", "label"), [("sobol", "95 % band (as if independent)"), ("grid", None)])
def test_a_band_says_what_it_takes_for_granted(made, design, label):
    (ax,) = plots.draw_exceedance(made({"a": A}, {"effort": A}, design=design)).axes
    assert [band.get_label() for band in ax.collections] == ([label] if label else [])


def test_of_a_saltelli_design_the_rows_a_are_drawn(made):
    sweep = made({"a": A, "b": B}, {"effort": A}, design="saltelli")
    (ax,) = plots.draw_exceedance(sweep).axes
    x, share = lines(ax)["runs"]
    assert set(x[1:-1]) <= set(A[::4])
    assert share[2] == 1 - 4 / N
    counts, *_ = plots.draw_distributions(sweep).axes[0].patches[0].get_data()
    assert counts.sum() == N / 4


@killed_by("output.plot.sweeps", 'results.column("sample")[good]\n', "np.arange(np.sum(good))\n")
def test_the_worst_are_marked_and_named(found):
    figure = plots.draw_worst(found, UNITS, count=6)
    ax = figure.axes[0]
    values = np.where(DIVERGED, -np.inf, OVERSHOOT)
    ends = np.argsort(-values)[:6]
    np.testing.assert_allclose(lines(ax)["the worst 6, sample: value"], [3.6 * B[ends], C[ends]], rtol=1e-14)
    assert {text.get_text() for text in ax.texts} == {f"{i}: {values[i]:.4g}" for i in ends}
    for text in ax.texts:
        i = int(text.get_text().split(":")[0])
        assert text.xy == pytest.approx((3.6 * B[i], C[i]))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("initial.speed [km/h]", "plant.c [kg]")
    (dots,) = ax.collections
    assert len(dots.get_offsets()) == N - 3
    assert figure.axes[1].get_ylabel() == "overshoot [1], line: bound 0.3"


def test_names_of_the_worst_do_not_overlap(found):
    figure = plots.draw_worst(found)
    figure.draw_without_rendering()
    ax = figure.axes[0]
    boxes = [Text.get_window_extent(text) for text in ax.texts]  # without the line to the point
    assert len(boxes) == 10
    heights = sorted((box.y0, box.y1) for box in boxes)
    assert all(below[1] <= above[0] for below, above in itertools.pairwise(heights))
    assert all(box.x0 > ax.bbox.x1 and box.x1 < figure.axes[1].bbox.x0 for box in boxes)


def test_of_many_runs_some_are_drawn_and_the_worst_of_all(made):
    n = 40_000
    x, y = np.random.default_rng(1).random((2, n))
    metric = np.where(np.isin(np.arange(n), (17, 39_000)), 2 + x, y)
    ax = plots.draw_worst(made({"x": x, "y": y}, {"effort": metric}), count=2).axes[0]
    points = ax.collections[0].get_offsets()
    assert 4900 < len(points) <= 5000
    drawn = set(map(tuple, points.tolist()))
    assert drawn <= set(zip(x.tolist(), y.tolist(), strict=True)) | set(zip(y.tolist(), x.tolist(), strict=True))
    marks = np.array(lines(ax)["the worst 2, sample: value"])
    assert set(map(tuple, marks.T.tolist())) <= drawn
    assert {text.get_text().split(":")[0] for text in ax.texts} == {"17", "39000"}


@killed_by("output.plot.sweeps", " + view.never(metric, view.good)", "")
@killed_by("output.plot.sweep_view", "np.sum(rows & ~self.known_rows(name, rows))", "np.sum(self.rows & ~rows)")
@pytest.mark.parametrize("design", ["random", "saltelli"])
def test_the_worst_runs_that_never_settle_are_counted(made, design):
    """They are the worst of all, and have no place on the scale of colours."""
    never = A > 0.9
    sweep = made({"a": A, "b": B}, {"settling_time": np.where(never, np.inf, A + B)}, design=design)
    title = " ".join(plots.draw_worst(sweep).get_suptitle().split())
    assert title == f"greatest settling_time of {N - never.sum():,} runs ({never.sum()} never: left out)"


def test_a_metric_that_varies_is_taken_where_none_has_a_bound(made):
    sweep = made({"a": A}, {"locked_time": 0 * A, "effort": A**2})
    (ax, _) = plots.draw_worst(sweep, {"effort": "J"}).axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("a", "effort [J]")
    np.testing.assert_allclose(
        sorted(map(tuple, ax.collections[0].get_offsets().tolist())), np.c_[A, A**2][A.argsort()]
    )


DOCUMENT = {
    "confidence": 0.9,
    "sensitivity": {
        "effort": {
            "a": {"spearman": {"value": 0.1, "low": -0.1, "high": 0.3, "samples": N}},
            "b": {"spearman": {"value": -0.8, "low": -0.9, "high": -0.7, "samples": N}},
            "c": {"spearman": {"value": None, "low": None, "high": None, "samples": N}},
        },
        "locked_time": {path: {"spearman": {"value": None, "low": None, "high": None, "samples": N}} for path in "abc"},
    },
}


def test_rank_correlations_have_bars_and_intervals(made):
    sweep = made({"a": A, "b": B, "c": 0 * C}, {"effort": A, "locked_time": 0 * A})
    (ax,) = plots.draw_sensitivity(sweep, DOCUMENT).axes
    assert [text.get_text() for text in ax.get_yticklabels()] == ["b", "a"]
    assert [bar.get_width() for bar in ax.patches] == [-0.8, 0.1]
    centres = [bar.get_y() + bar.get_height() / 2 for bar in ax.patches]
    assert centres == pytest.approx([0, 1])
    drawn = [line.get_xydata().tolist() for line in ax.get_lines() if len(set(line.get_ydata())) == 1]
    assert drawn == [[[-0.9, centres[0]], [-0.7, centres[0]]], [[-0.1, centres[1]], [0.3, centres[1]]]]


@killed_by("output.plot.sweeps", "default=0) * view.period", "default=0)", case="saltelli-2,700")
@killed_by("output.plot.sweeps", 'kinds[-1]]["samples"] for', "kinds[-1]] and 1200 for", case="random-900")
@pytest.mark.parametrize(("design", "runs"), [("random", "900"), ("saltelli", "2,700")])
def test_the_title_counts_the_runs_behind_the_bars(made, design, runs):
    """Correlations may be of fewer runs than there are; an index is of groups of a variable's three runs."""
    one = {"value": 0.5, "low": 0.4, "high": 0.6, "samples": 900}
    table = {"effort": {"a": {"spearman": one, "first": one, "total": one}}}
    sweep = made({"a": A}, {"effort": A}, design=design)
    title = plots.draw_sensitivity(sweep, {"confidence": 0.9, "sensitivity": table}).get_suptitle()
    assert " ".join(title.split()).endswith(f"with 90 % intervals, {runs} runs")


def test_sobol_bars_have_no_interval_if_there_is_none(made):
    one = {"value": 0.6, "low": 0.5, "high": 0.7, "samples": N // 4}
    rows = {"a": {"first": one, "total": {**one, "value": 0.9}}, "b": {"first": one, "total": {**one, "low": None}}}
    sweep = made({"a": A, "b": B}, {"effort": A}, design="saltelli")
    figure = plots.draw_sensitivity(sweep, {"confidence": 0.95, "sensitivity": {"effort": rows}})
    ax = figure.axes[0]
    assert [bar.get_width() for bar in ax.patches] == [0.6, 0.6, 0.9, 0.6]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["first", "total"]
    assert sum(len(set(line.get_ydata())) == 1 for line in ax.get_lines()) == 3


def test_no_sensitivities_no_figure(made):
    assert (
        plots.draw_sensitivity(made({"a": A}, {"effort": A}, design="grid"), {"confidence": 0.95, "sensitivity": {}})
        is None
    )


def shares(x, y, edges, failed):
    """By looking at each cell."""
    table = np.full([len(edge) - 1 for edge in edges], np.nan)
    for i, j in np.ndindex(table.shape):
        right, top = i == table.shape[0] - 1, j == table.shape[1] - 1
        across = (x >= edges[0][i]) & ((x < edges[0][i + 1]) | right)
        up = (y >= edges[1][j]) & ((y < edges[1][j + 1]) | top)
        table[i, j] = np.mean(failed[across & up]) if np.any(across & up) else np.nan
    return table


def mesh(ax):
    """Edges across and upward, and the table (across, upward) with NaN for masked cells."""
    drawn = ax.collections[0]
    corners = drawn.get_coordinates()
    return (corners[0, :, 0], corners[:, 0, 1]), np.ma.filled(drawn.get_array().astype(float), np.nan).T


@killed_by("output.plot.sweeps", "lanes == 0, table).T, **colours", "lanes == 0, table), **colours")
def test_the_map_has_the_share_of_failed_runs(found):
    figure = plots.draw_failure_map(found, UNITS)
    ax = figure.axes[0]
    edges, table = mesh(ax)
    failed = DIVERGED | (C <= 0.1) | (OVERSHOOT > 0.3)
    np.testing.assert_allclose(table, shares(C, 3.6 * B, edges, failed), rtol=1e-14)
    assert table.shape == (10, 10)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("plant.c [kg]", "initial.speed [km/h]")
    assert ax.get_title() == "failed: diverged, not stopped, locked_time > 0, overshoot > 0.3"
    assert figure.get_suptitle() == f"rig: {failed.sum()} failed of 1,200 runs (3 diverged)"


@killed_by("uncertainty.sweep.study", '"diverged": column("diverged"),', '"diverged": ~run,')
@pytest.mark.parametrize("kind", ["diverged", "stopped", "locked", "bound"])
def test_each_kind_of_failure_is_in_the_map(made, kind):
    bad = A > 0.7
    sweep = made(
        {"a": A, "b": B},
        {"locked_time": np.where(bad & (kind == "locked"), 0.01, 0.0), "effort": B + 2 * (bad & (kind == "bound"))},
        failures={"effort": 1.5},
        stopped=~bad | (kind != "stopped"),
        diverged=bad & (kind == "diverged"),
    )
    ax = plots.draw_failure_map(sweep).axes[0]
    edges, table = mesh(ax)
    assert ax.get_xlabel() == "a"
    np.testing.assert_allclose(table, shares(A, B, edges, bad), rtol=1e-14)


def test_cells_without_a_run_are_empty(made):
    """On a triangle of levels."""
    x, y = (np.repeat(level, 4) for level in np.tril_indices(6))
    ax = plots.draw_failure_map(
        made({"x": x + 0.0, "y": y + 0.0}, {"effort": x + 0.5 * y}, failures={"effort": 4.2})
    ).axes[0]
    edges, table = mesh(ax)
    np.testing.assert_array_equal(edges, [np.arange(-0.5, 6)] * 2)
    np.testing.assert_array_equal(np.isnan(table), np.triu(np.ones((6, 6)), 1) > 0)
    assert table[4, 0] == 0
    assert table[4, 1] == table[5, 0] == 1


@killed_by("output.plot.sweeps", "(lanes > 0) & ~np.isfinite(table)", "(lanes < 0) & ~np.isfinite(table)", case="some")
@pytest.mark.parametrize("cells", ["some", "all"])
def test_cells_of_runs_that_never_settle_have_a_colour(made, cells):
    """On a triangle of levels, so that other cells have no run and stay grey."""
    x, y = (np.repeat(level, 4) for level in np.tril_indices(6))
    settling = np.where((x == 5) & (y == 2) | (cells == "all") & (np.arange(x.size) % 4 == 0), np.inf, 1 + x + 0.5 * y)
    figure = plots.draw_failure_map(made({"x": x + 0.0, "y": y + 0.0}, {"settling_time": settling}))
    figure.draw_without_rendering()
    colours = {}
    for drawn in figure.axes[0].collections:
        for place, colour in zip(np.ndindex(6, 6), drawn.get_facecolors(), strict=True):  # row by row upward
            if colour[3] > 0:
                colours[place[::-1]] = to_hex(colour)
    (entry,) = figure.legends[0].get_patches()
    assert figure.legends[0].get_texts()[0].get_text() == "settling_time: never in a run"
    assert set(colours) == set(zip(x.tolist(), y.tolist(), strict=True))
    own = {place for place, colour in colours.items() if colour == to_hex(entry.get_facecolor())}
    assert own == ({(5, 2)} if cells == "some" else set(colours))


@killed_by("output.plot.sweeps", "np.maximum.at(greatest, cell, values)", "greatest[:] = values.max()")
def test_a_map_without_failures_shows_the_strongest_inputs(found, made):
    metrics = {"overshoot": OVERSHOOT, "effort": 5 + A}
    sweep = made({"a": A, "b": B, "c": C}, metrics, failures={"overshoot": 9.0})
    ax = plots.draw_failure_map(sweep).axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("b", "c")
    edges, table = mesh(ax)
    across, upward = (np.clip(np.digitize(x, edge) - 1, 0, 9) for x, edge in zip((B, C), edges, strict=True))
    for i, j in [(0, 0), (3, 7), (9, 2)]:
        np.testing.assert_array_equal(table[i, j], OVERSHOOT[(across == i) & (upward == j)].max())
    assert ax.figure.axes[1].get_ylabel() == "greatest overshoot, fails beyond 9"
    assert np.ptp(table) > 0  # a map of one colour says nothing


def test_names_are_cells_upward(made):
    roads = np.array(["wet", "dry", "snow"])[np.random.default_rng(6).integers(3, size=N)]
    failed = (roads == "snow") & (A > 0.5)
    sweep = made({"road": roads, "a": A, "b": B}, {"effort": failed + 0.1 * B}, failures={"effort": 0.5})
    ax = plots.draw_failure_map(sweep).axes[0]
    edges, table = mesh(ax)
    order = ["dry", "snow", "wet"]
    assert [text.get_text() for text in ax.get_yticklabels()] == order
    assert ax.get_xlabel() == "a"
    expected = shares(A, np.array([order.index(name) for name in roads]), edges, failed)
    np.testing.assert_allclose(table, expected, rtol=1e-14)
    scatter = plots.draw_worst(sweep).axes[0]
    assert {scatter.get_xlabel(), scatter.get_ylabel()} == {"a", "b"}  # numbers first


def test_with_one_variable_the_map_is_a_strip(made):
    ax = plots.draw_failure_map(made({"a": A}, {"effort": A}, failures={"effort": 0.6})).axes[0]
    (across, _), table = mesh(ax)
    assert table.shape == (len(across) - 1, 1) == (24, 1)
    np.testing.assert_allclose(table[:, 0], shares(A, 0 * A, (across, np.array([0, 1])), A > 0.6)[:, 0], rtol=1e-14)
    assert not ax.yaxis.get_visible()


def test_a_number_of_a_list_has_its_own_unit(made):
    """Of the gains of six states, three are of angles and three of rates; there are only two units for them."""
    gains = [f"controller.gain.{k}" for k in range(6)]
    space = Space({gain: Uniform(0.0, 1.0) for gain in gains})
    units = Study(loop=balancing(), space=space, samples=8, solver=FixedStep(1e-3, 1.0)).units()
    assert [units[gain] for gain in gains] == ["V/rad"] * 3 + ["V s/rad"] * 3
    sweep = made({gains[1]: A, gains[3]: B}, {"effort": A + 2 * B})
    ax = plots.draw_worst(sweep, units).axes[0]
    assert {ax.get_xlabel(), ax.get_ylabel()} == {f"{gains[1]} [V/rad]", f"{gains[3]} [V s/rad]"}


@pytest.mark.slow
def test_draw_writes_what_there_is(found, tmp_path):
    paths = plots.draw_sweep(found, summarise_sweep(found), tmp_path, UNITS)
    names = ["distributions", "exceedance", "worst", "sensitivity", "failure_map"]
    assert [path.name for path in paths] == [f"{name}.png" for name in names]
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 10_000


ODD = {
    "one run": ({"a": A[:1]}, {"effort": A[:1]}, {}, []),
    "two runs": ({"a": A[:2]}, {"effort": A[:2]}, {}, ["distributions", "exceedance", "worst", "failure_map"]),
    "all diverged": ({"a": A}, {"effort": A}, {"diverged": True}, ["failure_map"]),
    "none stopped": ({"a": A, "b": B}, {"effort": 0 * A}, {"stopped": False}, ["failure_map"]),
    "nothing varies": ({"a": 0 * A}, {"effort": 0 * A}, {}, []),
    "rounding": ({"a": A}, {"effort": 1 + 4e-16 * (A > 0.5)}, {}, []),
    "names": (
        {"road": np.array(["x", "y"])[(A > 0.5) * 1], "tyre": np.array(["u", "v"])[(B > 0.5) * 1]},
        {"effort": (A > 0.5) + C},
        {},
        ["distributions", "exceedance", "worst", "failure_map"],
    ),
    "corners": (
        {"a": np.array([0.0, 0, 1, 1]), "b": np.array([0.0, 1, 0, 1])},
        {"effort": np.array([0.0, 1, 2, 4])},
        {"design": "corners"},
        ["distributions", "exceedance", "worst", "failure_map"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(ODD))
def test_odd_sweeps_are_drawn_without_a_warning(made, tmp_path, monkeypatch, kind):
    variables, metrics, given, names = ODD[kind]
    replace_seam(monkeypatch, "save_figure", lambda figure, path: (figure.draw_without_rendering(), path)[1])
    sweep = made(variables, metrics, **given)
    assert [path.stem for path in plots.draw_sweep(sweep, summarise_sweep(sweep), tmp_path, {})] == names
