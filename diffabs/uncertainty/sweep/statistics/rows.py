"""The rows of a sweep's table that enter its statistics, as Boolean masks."""

import numpy as np

from diffabs.uncertainty.sweep.results import Results


class RowMasks:
    """Masks of the rows of a sweep, each of shape (rows,), and what its design says of the rows.

    A Saltelli design repeats groups of runs (A, B, AB_1, ..., AB_p). Only A is an independent sample.

    Attributes:
        samples: Number of the sample of each row, shape (rows,), without those of missing chunks.
        accepted: Mask of the runs that were not refused.
        good: Mask of the accepted runs that did not diverge.
        rows: Mask of the independent samples: the runs A of a Saltelli design, else all.
        design: Type of the sampling design.
        period: Number of runs in a group of a Saltelli design, else 1.
    """

    def __init__(self, results: Results):
        """Read the masks of a sweep."""
        space = results.study["space"]
        self.design: str = space["design"]["type"]
        self.period: int = len(space["variables"]) + 2 if self.design == "saltelli" else 1
        self.samples: np.ndarray = results.column("sample")
        self.accepted: np.ndarray = results.accepted
        self.good: np.ndarray = self.accepted & ~results.column("diverged")
        self.rows: np.ndarray = self.samples % self.period == 0

    def groups(self, values: np.ndarray) -> np.ndarray:
        """Return a column by groups of runs, shape (groups, period), without groups that miss a good, finite run."""
        good = self.good & np.isfinite(values)
        _, place, count = np.unique(self.samples[good] // self.period, return_inverse=True, return_counts=True)
        return values[good][count[place] == self.period].reshape(-1, self.period)
