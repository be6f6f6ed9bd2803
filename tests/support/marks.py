"""Cases of tests: which are slow, and ids that a reader can type."""

import re

import pytest

MAX_ID_LENGTH = 40


def cases(every, *slow):
    """Return the cases of a test, of which some compile for long and show little that the others do not."""
    return [pytest.param(case, marks=pytest.mark.slow) if case in slow else case for case in every]


def readable_id(value):
    """Return a case's id: the words and numbers of its text, without quotes, brackets and signs that a shell reads."""
    text = re.sub(r"[^A-Za-z0-9_.,:=+/-]+", " ", str(value))
    return text[:MAX_ID_LENGTH].strip()
