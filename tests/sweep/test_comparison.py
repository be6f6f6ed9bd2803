"""Comparisons of two sweeps: which are refused, and what is compared."""

import pathlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mutants import killed_by

from diffabs.uncertainty.sweep import SweepError, compare_sweeps


def invent_sweep(shift: float = 0.0, *, complete: bool = True, seed: int = 0, names: str = "iae") -> Any:
    """Return the results of five samples, of which the last was refused."""
    columns = {name: np.arange(5.0) + shift for name in names.split()} | {"diverged": np.zeros(5, bool)}
    study = {"space": {"variables": {}}, "seed": seed, "samples": 5}
    facts = {"complete": complete, "study": study, "metrics": names.split(), "folder": pathlib.Path("a")}
    return SimpleNamespace(column=columns.__getitem__, accepted=np.arange(5) < 4, **facts)


@killed_by("uncertainty.sweep.statistics.comparison", "compare_pairs(after, before)", "compare_pairs(before, after)")
@killed_by("uncertainty.sweep.statistics.comparison", "| ~a.accepted | ~b.accepted", "")
def test_the_second_sweep_is_compared_with_the_first() -> None:
    found = compare_sweeps(invent_sweep(names="iae slip"), invent_sweep(0.25, names="effort iae"))
    assert (found["samples"], found["left out"], list(found["metrics"])) == (5, 1, ["iae"])
    row = found["metrics"]["iae"]
    assert (row["samples"], row["never"], row["equal"]) == (4, 0, 0)
    assert (row["first"], row["second"]) == (1.5, 1.75)
    assert (row["difference"]["low"], row["difference"]["value"], row["difference"]["high"]) == (0.25, 0.25, 0.25)


@killed_by("uncertainty.sweep.statistics.comparison", "if not results.complete:", "if False:")
@killed_by("uncertainty.sweep.statistics.comparison", "if name not in common", "if False")
@pytest.mark.parametrize(
    ("second", "metrics", "words"),
    [
        ({"complete": False}, (), "a is not complete; diffabs sweep ... --resume completes it"),
        ({"seed": 1}, (), "the samples are not the same: seed is 0 in the first, 1"),
        ({}, ("effort",), "effort is not a metric of both sweeps"),
    ],
)
def test_sweeps_that_have_no_common_samples_or_metric_are_refused(second, metrics, words) -> None:
    with pytest.raises(SweepError) as caught:
        compare_sweeps(invent_sweep(), invent_sweep(**second), metrics)
    assert str(caught.value).startswith(words)
