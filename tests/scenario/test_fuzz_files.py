"""A few of the mutations of `fuzz_files`, which by hand and every night are thousands."""

import pytest
from fuzz_files import fuzz

pytestmark = pytest.mark.usefixtures("any_step_is_stable", "without_load")


@pytest.mark.slow
def test_changed_files_are_refused_or_change_nothing():
    failures, tally = fuzz(40, seed=1, outsiders=False)
    assert not failures, "\n".join(failures)
    outcomes = {outcome for _, outcome in tally}
    assert {"refused in a line", "the same numbers", "proved, and true", "not proved"} <= outcomes
