"""What the engine needs to know of a system: a flow between instants, and changes at them.

    between instants   dz/dt = flow(t, state)     z: the integrated part of the state, `state.flow()`
    at instants        state <- change(state)     an instant is a tick of a clock, or an event

An event is the instant at which a margin falls through zero. The flow is smooth between instants but for comparisons,
which the engine finds (`step.comparisons`). Clients: a closed loop (`loop.closed_loop.Loop`), the field of a user
(`field.FieldSystem`). A system without flow is a difference equation, one without clocks and events a smooth field.

A system is a dataclass and a pytree (`core.pytree.pytree`), whose leaves are its parameters. Its state and its signals
are pytrees, too.
"""

from collections.abc import Callable
from typing import Any, Protocol, Self

from diffabs.core.cubic import HermiteStep
from diffabs.core.protocols import Clock, Objective
from diffabs.core.types import Int, PyTree, Scalar

Margins = dict[str, tuple[Any, ...]]  # by name; "stop" has at least one, and each of its margins ends a run
Fired = dict[str, tuple[Any, ...]]  # by the names of the margins: True for each that has fallen through zero
Objectives = dict[str, Objective]
Finish = Callable[[Any, Any, PyTree], tuple[Any, PyTree]]  # of system, objectives, last carry: result, last observation
Observe = Callable[[Any, Scalar, Any, Any], PyTree]  # of system, time, state, and whether the run goes on


class HybridState(Protocol):
    """The state of a system: an integrated part, and a held part that changes at instants only."""

    def flow(self) -> PyTree:
        """Return the integrated part."""
        ...

    def memories(self) -> PyTree:
        """Return the held part."""
        ...

    def with_flow(self, flow: PyTree) -> Self:
        """Return the state with another integrated part."""
        ...


class HybridSample(Protocol):
    """What objectives read of a system at an instant, a pytree."""

    def show(self) -> PyTree:
        """Return the part of it whose rates most objectives need: rates of all signals cost more."""
        ...

    def error_controlled_signals(self) -> PyTree:
        """Return the signals of `HybridSystem.error_controlled_signals`."""
        ...

    def signal_scales(self) -> PyTree:
        """Return the sizes of these signals."""
        ...


class HybridSignals(Protocol):
    """The signals of a system at an instant."""

    @property
    def sample(self) -> HybridSample:
        """What objectives read."""
        ...

    @property
    def recorded(self) -> dict[str, PyTree]:
        """Signals whose cubic over each step `change` receives, by name."""
        ...


class HybridSystem(Protocol):
    """A flow dz/dt, and changes where margins fall through zero or clocks tick."""

    @property
    def changes(self) -> bool:
        """Whether `change` may change a state."""
        ...

    @property
    def ticks(self) -> bool:
        """Whether there is a clock."""
        ...

    @property
    def eventful(self) -> bool:
        """Whether an event can happen, one that ends the run included; a stop that never comes is none."""
        ...

    @property
    def jumps(self) -> bool:
        """Whether a rate of the flow jumps where a comparison changes: then fixed steps end there for values, too."""
        ...

    @property
    def recorders(self) -> tuple[str, ...]:
        """Names of the signals that `change` receives over each step."""
        ...

    def prepare_run(self) -> "tuple[HybridSystem, dict[str, Objective]]":
        """Return the system with all that is constant during a run computed, and further objectives of each run."""
        ...

    def start(self) -> HybridState:
        """Return the state at t = 0, before the first tick."""
        ...

    def signals(self, t: Scalar, state: Any) -> Any:
        """Return the `HybridSignals` at time `t` [s]."""
        ...

    def flow(self, t: Scalar, state: Any, signals: Any) -> PyTree:
        """Return d(state.flow())/dt from the `signals` at (t, state)."""
        ...

    def margins(self, t: Scalar, state: Any, signals: Any, flow: Callable[[], PyTree]) -> Margins:
        """Return the margins of the stop and of the events by name; `flow()` is d(state.flow())/dt."""
        ...

    def change(
        self,
        clock: Clock,
        state: Any,
        before: Any,
        margins: Margins,
        fired: Fired,
        passed: dict[str, HermiteStep] | None = None,
    ) -> Any:
        """Return the state after an instant, of the state, the signals `before` it, and its margins.

        It is evaluated at the end of every attempt, and used if the attempt is accepted and the run goes on. Without a
        tick or a fired margin it returns the state. `passed` has the recorded signals over the step that ends here;
        None at the start of a run.
        """
        ...

    def least_scales(self, state: Any) -> PyTree | None:
        """Return for each number of `state.flow()` the size below which an adaptive step may have an absolute error.

        Without (None) the error is relative to the size from the first step on, even to one near rounding.
        """
        ...

    def next_tick(self, k: Int, h: Scalar) -> Int:
        """Return the number of the first instant after the `k`-th at which a clock ticks, with a grid of `h` [s]."""
        ...

    def project(self, state: Any) -> Any:
        """Return the nearest admissible state, after every step."""
        ...

    def join_state(self, flow: PyTree, held: PyTree) -> Any:
        """Return the state with these two parts."""
        ...

    def error_controlled_signals(self, state: Any) -> PyTree:
        """Return the signals whose errors limit an adaptive step, as do those of the states; () for none."""
        ...
