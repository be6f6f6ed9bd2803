"""Why a run diverged."""

import enum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from diffabs.loop.result import Run


class Fault(enum.IntEnum):
    """The reason why a run diverged.

    Attributes:
        NONE: The run has not diverged.
        NUMBER: A number is infinite or invalid, or no step meets its tolerance.
        STEPS: The steps are too many, as of a part that switches in every step.
        LANDING: The last step misses the stop, or the start is beyond it.
        METRIC: A metric is outside its physical range (`Objective.physical`).
        AUDIT: The plant's audit rejects the run, such as one that gains energy.
        SLIDE: The run slides along a switching surface, with adaptive steps.
        REFUSED: The run was not accepted, such as one with an unstable step (`run_batch`).
    """

    NONE, NUMBER, STEPS, LANDING, METRIC, AUDIT, SLIDE, REFUSED = range(8)

    @property
    def text(self) -> str:
        """The reason in words."""
        return FAULT_TEXTS[self]


FAULT_TEXTS = {
    Fault.NONE: "nothing",
    Fault.NUMBER: "a number is infinite or invalid, or no step meets its tolerance",
    Fault.STEPS: "its steps are too many, as if a part switched in every step, or were far faster than the run",
    Fault.LANDING: "its last step misses the stop, or its start is beyond the stop",
    Fault.METRIC: "a metric is outside its physical range",
    Fault.AUDIT: "the plant's audit rejects it, as for a gain of energy",
    Fault.SLIDE: "it slides along a switching surface",
    Fault.REFUSED: "it was not accepted",
}


def describe_faults(run: "Run") -> str:
    """Return why a run diverged, or for a batch each reason with its number of runs; "" for none."""
    if run.fault is None:
        return ""
    faults = np.asarray(run.fault, int)
    codes, counts = np.unique(faults[faults > 0], return_counts=True)
    texts = [(count, Fault(code).text) for code, count in zip(codes.tolist(), counts, strict=True)]
    return "; ".join(f"{count}: {text}" if faults.ndim else text for count, text in texts)
