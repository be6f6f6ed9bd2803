"""One channel of an open loop with several: opened there, while the other channels are closed.

With L = C (s - A)^-1 B, and no direct path, the other channels v_o = -C_o x close to A - B_o C_o. A sampled loop has
the delays of the closed channels as states. The delay of the open channel stays a pure delay, as in `OpenLoop`.
"""

from typing import NamedTuple

import numpy as np

from diffabs.linear.opened_loop import OpenLoop, drop_unobserved_states, in_series, sample_plant, split_delay
from diffabs.linear.transfer import Transfer


class ChannelLoop(NamedTuple):
    """One channel of an open loop, from its command to minus the same command, with the other channels closed.

    Attributes:
        whole: Open loop of all channels.
        number: Number of the open channel, from 0.
    """

    whole: OpenLoop
    number: int

    @property
    def plant(self) -> Transfer:
        """The plant with the open channel as its only input."""
        plant, only = self.whole.plant, slice(self.number, self.number + 1)
        return plant._replace(B=plant.B[:, only], D=plant.D[:, only])

    @property
    def period(self) -> float | None:
        """Sampling period of the controller [s]; None in continuous time."""
        return self.whole.period

    @property
    def delay(self) -> float:
        """Pure delay of the open channel [s]."""
        return self.whole.delay

    def transfer(self, more: float = 0.0) -> Transfer:
        """Return the open loop of the channel, with `more` delay in this channel alone [s].

        Raises:
            ValueError: The loop has a delay in continuous time.
        """
        check_closable(self.whole)
        if self.period is None:
            return drop_unobserved_states(close_others(self.whole.transfer(), self.number))._replace(delay=more)
        whole, rest = split_delay(self.delay + more, self.period)
        opened = close_others(self._sample(rest), self.number)
        return drop_unobserved_states(opened)._replace(delay=whole * self.period)

    def respond_to_state(self, w: np.ndarray) -> np.ndarray:
        """Return the response (k, n) from a change of the plant's state to minus the command, if it is sampled."""
        closed = close_others(self._sample(0.0), self.number)
        n = len(self.whole.plant.A)
        return closed._replace(B=np.eye(len(closed.A), n), D=np.zeros((1, n))).rational_response(w)[:, 0]

    def _sample(self, delay: float) -> Transfer:
        """Return the whole sampled loop with this delay of the open channel, 0 to a period [s], and all others'."""
        delays = np.full(len(self.whole.channels), self.delay)
        delays[self.number] = delay
        return in_series(sample_channels(self.whole.plant, float(self.period or 0.0), delays), self.whole.controller)


def select_loop(loop: object, name: str) -> ChannelLoop:
    """Return a channel of an open loop with several. Raises ValueError if there is none with this name."""
    channels = getattr(loop, "channels", ())
    if not isinstance(loop, OpenLoop) or name not in channels:
        names = ", ".join(channels) or "none: it has one control"
        raise ValueError(f"channel = {name!r} is no channel of the loop; its channels are {names}")
    return ChannelLoop(loop, channels.index(name))


def close_others(system: Transfer, index: int) -> Transfer:
    """Return a square system with negative feedback of all channels but one; it has no direct path and no delay."""
    others = np.arange(len(system.C)) != index
    only = slice(index, index + 1)
    return system._replace(
        A=system.A - system.B[:, others] @ system.C[others], B=system.B[:, only], C=system.C[only], D=np.zeros((1, 1))
    )


def sample_channels(plant: Transfer, period: float, delays: np.ndarray) -> Transfer:
    """Return the sampled plant with a delay of each input, (m,) [s], as states after those of the plant."""
    n, columns = len(plant.A), []
    for i, delay in enumerate(delays.tolist()):
        whole, rest = split_delay(delay, period)
        column = sample_plant(plant._replace(B=plant.B[:, i : i + 1], D=plant.D[:, i : i + 1]), period, rest)
        columns.append(column._replace(delay=whole * period).without_delay())
    order = n + sum(len(column.A) - n for column in columns)
    a, b, start = np.zeros((order, order)), np.zeros((order, len(columns))), n
    for i, column in enumerate(columns):
        end = start + len(column.A) - n
        rows = np.r_[:n, start:end]
        a[np.ix_(rows, rows)] = column.A
        b[rows, i], start = column.B[:, 0], end
    return Transfer(a, b, np.pad(plant.C, ((0, 0), (0, order - n))), plant.D, period)


def check_closable(loop: OpenLoop) -> None:
    """Raise ValueError for a delay in continuous time, which has no finite state."""
    if loop.period is None and loop.delay:
        raise ValueError(
            f"delay = {loop.delay:g} s: margins of several channels in continuous time need a loop without delay; "
            "put the controller into a sampled one"
        )
