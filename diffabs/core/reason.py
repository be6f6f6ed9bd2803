"""The reasons for the end of an iteration."""

import enum


class Reason(enum.Enum):
    """The reason for the end of a descent."""

    GRADIENT = "the gradient is zero within its tolerance"
    CHANGE = "steps no longer change the loss within its tolerance"
    STEP = "no shorter step makes the loss smaller"
    JUMP = "the loss jumps up just beyond, twice in a row"
    SLIDE = "runs slide along a switching surface just beyond, and have no derivatives there"
    LIMIT = "the limit of iterations or rounds was reached"
    START = "the start diverged, or the integration step is not stable there"
    KEPT = "the best of its steps that meets all constraints is returned; where it ended is worse"
    INTERRUPTED = "it was interrupted, before it was at a minimum"
