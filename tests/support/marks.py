"""Which cases of a test are left to `make test-slow`."""

import pytest


def cases(every, *slow):
    """Return the cases of a test, of which some compile for long and show little that the others do not."""
    return [pytest.param(case, marks=pytest.mark.slow) if case in slow else case for case in every]
