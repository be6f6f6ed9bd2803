"""How a run is: on its way, or over, and why."""

import enum


class Condition(enum.IntEnum):
    """A run goes on, or looks for an event, or for how its margin falls, or is to land on it, or to look around after
    it; or it is over."""

    RUNNING, SEEKING, PROBING, LANDING, REFRESHING, STOPPED, TIMED_OUT, DIVERGED = range(8)
