"""The summary of made-up sweeps, a manifest and chunks without any run: what a gap, a block without values, and rare
failures leave of it. What the estimates are is said in `test_sweep_statistics`."""

import numpy as np
import pytest
from mutants import killed_by
from scipy import stats
from sweeping import manifest

from diffabs.uncertainty.sweep import Results
from diffabs.uncertainty.sweep.manifest import Seals
from diffabs.uncertainty.sweep.sampling import Saltelli
from diffabs.uncertainty.sweep.seal import encode_chunk
from diffabs.uncertainty.sweep.statistics.summary import summarise_sweep
from diffabs.uncertainty.sweep.store import Store

N, BLOCK = 1024, 64


@pytest.fixture
def made(tmp_path):
    """Write a sweep in eight chunks, of which some are missing; the metric above 1 is a failure."""

    def write(design, variables, metric, missing=(), **flags):
        size = len(metric) // 8
        table = manifest(len(metric), size, variables, ("m",), failures={"m": 1.0})
        table["study"]["space"]["design"] = design
        columns = {"sample": np.arange(len(metric)), **variables, "m": metric}
        columns |= {"stopped": True, "diverged": False, "refused": ""} | flags
        store = Store(tmp_path)
        store.begin(table, resume=False)
        for i in set(range(8)) - set(missing):
            part = {key: np.broadcast_to(x, len(metric))[i * size : (i + 1) * size] for key, x in columns.items()}
            store.write(i, encode_chunk(part, Seals(table).of(i)))
        return Results(tmp_path)

    return write


def in_blocks(made, metric, **flags):
    return made({"type": "sobol", "replicates": N // BLOCK}, {"x": np.arange(float(N))}, metric, **flags)


@killed_by(
    "uncertainty.sweep.statistics.summary",
    'samples // (results.study["samples"] // count), count',
    "samples % count, count",
)
def test_a_replicate_is_a_block_of_samples(made):
    """Blocks of one value each: their spread is that of 16 values, whatever is in a block."""
    values = np.repeat(np.random.default_rng(1).random(N // BLOCK), BLOCK)
    found = summarise_sweep(in_blocks(made, values))["metrics"]["m"]["mean"]
    theirs = stats.ttest_1samp(values[::BLOCK], 0.0).confidence_interval()
    np.testing.assert_allclose([found["low"], found["high"]], theirs, rtol=1e-12)


@pytest.mark.parametrize("failed", [0, 1])
def test_no_failure_is_no_certainty(made, failed):
    found = summarise_sweep(in_blocks(made, 2.0 * (np.arange(N) < failed)))["failures"]["m > 1"]
    theirs = stats.binomtest(failed, N).proportion_ci()
    np.testing.assert_allclose([found["low"], found["high"]], theirs, atol=1e-8)
    assert (found["count"], found["samples"]) == (failed, N)


@pytest.mark.parametrize("lost", ["diverged", "never"])
def test_a_replicate_without_values_leaves_the_value(made, lost):
    first = np.arange(N) < BLOCK
    values = np.where(first, np.inf if lost == "never" else np.nan, np.random.default_rng(2).random(N))
    found = summarise_sweep(in_blocks(made, values, diverged=first & (lost == "diverged")))["metrics"]["m"]
    assert found["mean"]["value"] == pytest.approx(values[BLOCK:].mean(), rel=1e-12)
    assert found["quantile 0.05"]["value"] == pytest.approx(np.quantile(values[BLOCK:], 0.05), rel=1e-12)
    for kind in ("mean", "quantile 0.05", "quantile 0.5", "quantile 0.95", "cvar 0.95"):
        assert (found[kind]["low"], found[kind]["high"], found[kind]["samples"]) == (None, None, N - BLOCK)


GROUPS = 250  # of a Saltelli design of two variables: (A, B, AB_1, AB_2)
POINTS = Saltelli().unit(0, 0, 4 * GROUPS, 2, 4 * GROUPS)


def of_groups(made, metric, **options):
    return made({"type": "saltelli"}, {"a": POINTS[:, 0], "b": POINTS[:, 1]}, metric, **options)


@killed_by(
    "uncertainty.sweep.statistics.rows", "self.samples[good] // self.period", "np.flatnonzero(good) // self.period"
)
@pytest.mark.parametrize(
    ("missing", "lost", "groups"),
    [((), (), 250), ((2,), (), 218), ((2,), (5, 6, 999), 216)],
    ids=["none", "gap", "runs"],
)
def test_indices_are_of_whole_groups(made, missing, lost, groups):
    """y = a + b/10 of uniform a and b: the indices are 1/1.01 and 0.01/1.01. A chunk of
    125 runs has 31 groups at most, and its gap takes 32; of the runs that diverge, two are of one group."""
    diverged = np.isin(np.arange(4 * GROUPS), lost)
    y = np.where(diverged, np.nan, POINTS[:, 0] + POINTS[:, 1] / 10)
    found = summarise_sweep(of_groups(made, y, missing=missing, diverged=diverged))["sensitivity"]["m"]
    for path, index in (("a", 1 / 1.01), ("b", 0.01 / 1.01)):
        for kind in ("first", "total"):
            assert found[path][kind]["value"] == pytest.approx(index, abs=0.03)
            assert found[path][kind]["samples"] == groups


@killed_by(
    "uncertainty.sweep.statistics.rows",
    "self.samples % self.period == 0",
    "np.arange(len(self.samples)) % self.period == 0",
)
def test_failures_are_of_the_runs_a(made):
    """Chunks of 126 samples, no multiple of 4: after a gap the first row is not a run A."""
    y = (np.arange(4 * 252) % 4 == 0) * 2.0
    found = made({"type": "saltelli"}, {"a": y, "b": y}, y, missing=(0,))
    assert summarise_sweep(found)["failures"]["m > 1"]["count"] == len(range(128, 1008, 4))
    assert summarise_sweep(found)["failures"]["any"]["samples"] == len(range(128, 1008, 4))


def test_correlations_say_of_how_many_samples_they_are(made):
    x = np.random.default_rng(3).random(200_008)
    found = summarise_sweep(made({"type": "random"}, {"x": x}, x * 0.9))
    assert found["metrics"]["m"]["mean"]["samples"] == 200_008
    assert {one["samples"] for one in found["sensitivity"]["m"]["x"].values()} == {200_000}
