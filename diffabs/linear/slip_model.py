"""The slip loop as a linear system: plant, sensor filter, actuator lag and sampling, at a frozen speed.

The feedback u = K x is designed for this model. `SlipModel()` is the model of Maeda and Sugiura, eqs. (15)-(21):
x = (integral of (slip - target), slip - target), u = tau - tau*.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from diffabs.core.blocks import Direct
from diffabs.core.protocols import Plant
from diffabs.core.pytree import canonical_dtypes, param, part, pytree, static
from diffabs.core.rules import Rule
from diffabs.core.types import AnyArray, Bool, PyTree, Scalar
from diffabs.linear.linearization import (
    REMAINING_STATE_ITERATIONS,
    StateSpace,
    as_vectors,
    check_kink,
    independent_components,
    nan_at_kink,
    track_outputs,
    used_leaves,
)
from diffabs.linear.zero_order_hold import discretise_held_input
from diffabs.parts.actuators import Lag
from diffabs.parts.controllers.sampled import sampling_rules
from diffabs.parts.plants import BrakeStart, MirroredRig
from diffabs.parts.plants.wheel import FROZEN_OUTPUTS


@pytree
class LowPass:
    """A first-order low-pass filter of the slip error, as in a PID's derivative term.

        x_f' = cutoff (slip error - x_f)

    x_f is the filtered slip error.
    """

    cutoff: Scalar = param(default=55.0, unit="rad/s", above=0.0)
    """Corner frequency of the low-pass filter."""


@pytree
class Continuous:
    """A controller in continuous time."""


@pytree
class Sampling:
    """A controller that runs every `period`. Its output is held, and changes `delay` after the sample."""

    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    """Period of the samples."""
    delay: Scalar = param(default=0.0, unit="s", low=0.0)
    """Computing time, at most the sampling period."""

    def rules(self) -> Iterator[Rule]:
        """Yield the rule delay <= period."""
        yield from sampling_rules(None, self.delay, self.period)


@pytree
class SlipModel:
    """The slip error at a frozen speed, under u = control - holding control.

    The states have this order; states in brackets exist only in some models:

        [integral of the slip error, x1' = x2], slip error x2 = slip - target,
        [states of the plant besides slip, speed and distance], [actuator],
        [control of the previous sample], [slip error behind `filter`]

    With `Sampling` the model is discrete, as `Sampled` computes. Integral and filter use forward Euler from the sample
    that the control uses; the other states are exact. An `actuator` or `filter` that is `Direct` adds no state.
    """

    plant: Plant = part(default=MirroredRig)
    slip: Scalar = param(default=0.2, unit="1", above=0.0, below=1.0)
    """Slip at which the model is linearised."""
    speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0, high=200.0)
    """Frozen speed of the vehicle."""
    actuator: Direct | Lag = part(default=Direct)
    sampling: Continuous | Sampling = part(default=Continuous)
    filter: Direct | LowPass = part(default=Direct)
    integral: bool = static(default=True)

    @property
    def period(self) -> float | None:
        """Period of the samples [s]; None in continuous time."""
        return float(self.sampling.period) if isinstance(self.sampling, Sampling) else None

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        self._check_supported()
        start = jax.eval_shape(self.plant.start, BrakeStart(speed=self.speed, slip=self.slip))
        paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(start)]
        used = used_leaves(self.plant, start, ("slip", *FROZEN_OUTPUTS))
        remaining = [jax.tree_util.keystr(p, simple=True) for p, u in zip(paths, used, strict=True) if not u]
        return (
            *(["integral of slip error"] if self.integral else []),
            "slip error",
            *remaining,
            *(["actuator torque"] if isinstance(self.actuator, Lag) else []),
            *(["torque of the last sample"] if isinstance(self.sampling, Sampling) else []),
            *(["filtered slip error"] if isinstance(self.filter, LowPass) else []),
        )

    def matrices(self) -> StateSpace:
        """Return A (n, n) and B (n, 1), differentiable in every parameter; they compile once for each kind of model.

        Raises:
            ValueError: The model has a part that a linear slip model does not support, or the slope of the plant jumps
                at the slip, at a kink of the friction. Inside jit A and B are NaN at a kink. In single precision a kink
                is not noticed.
        """
        self._check_supported()
        model, kinked = _matrices(self)
        check_kink(f"{type(self.plant).__name__} at slip {self.slip}", kinked)
        return model

    def point(self) -> tuple[PyTree, PyTree]:
        """Return (state, control) of the linearisation.

        The control holds the slip, and the remaining states are at rest. The speed falls, so this is no equilibrium.
        """
        start = self.plant.start(BrakeStart(speed=self.speed, slip=self.slip))
        control = self.plant.holding(self.plant.output(start), self.slip)
        remaining = independent_components(self.plant, start, ("slip", *FROZEN_OUTPUTS))
        if not len(remaining):
            return start, control
        flow, x, u = as_vectors(self.plant, start, control)

        def rate(z: AnyArray) -> AnyArray:
            return flow(x.at[remaining].set(z), u)[remaining]

        def newton(_: object, z: AnyArray) -> AnyArray:
            return z - jnp.linalg.solve(jax.jacfwd(rate)(z), rate(z))

        # A fixed number of iterations: a loop until convergence has no reverse-mode derivative.
        values = jax.lax.fori_loop(0, REMAINING_STATE_ITERATIONS, newton, x[remaining])
        return ravel_pytree(start)[1](x.at[remaining].set(values)), control

    def controlled_system(self) -> tuple[StateSpace, Bool]:
        """Return plant and actuator, sampled if the controller is, and whether they are at a kink; the slip error is
        the first state.
        """
        system, kinked = track_outputs(self.plant, *self.point())
        if isinstance(self.actuator, Lag):
            system = _behind_lag(system, self.actuator.time_constant)
        if isinstance(self.sampling, Sampling):
            system = discretise_held_input(system, self.sampling.period, self.sampling.delay)
        return system, kinked

    def with_memory(self, system: StateSpace) -> StateSpace:
        """Return a system extended by the controller's states: the integral in front, the filter at the end.

        The first state of `system` is the slip error.
        """
        p, first = len(system.A), int(self.integral)
        n = p + first + isinstance(self.filter, LowPass)
        step, keep = (self.sampling.period, 1.0) if isinstance(self.sampling, Sampling) else (1.0, 0.0)
        a = jnp.zeros((n, n), system.A.dtype).at[first : first + p, first : first + p].set(system.A)
        if self.integral:
            # Continuous: x1' = x2. Sampled: x1+ = x1 + T x2, from the sample at the beginning of the period.
            a = a.at[0, :2].set(jnp.stack([keep, step]))
        if isinstance(self.filter, LowPass):
            rate = step * self.filter.cutoff
            a = a.at[-1, first].set(rate).at[-1, -1].set(keep - rate)
        return StateSpace(a, jnp.zeros((n, 1), a.dtype).at[first : first + p].set(system.B))

    def _check_supported(self) -> None:
        supported = {"actuator": (Direct, Lag), "sampling": (Continuous, Sampling), "filter": (Direct, LowPass)}
        for name, types in supported.items():
            part = getattr(self, name)
            if not isinstance(part, types):
                names = " and ".join(t.__name__ for t in types)
                raise ValueError(f"{name}: a linear slip model knows {names}, not {type(part).__name__}")


@jax.jit
def _matrices(model: SlipModel) -> tuple[StateSpace, Bool]:
    model = canonical_dtypes(model)
    system, kinked = model.controlled_system()
    return nan_at_kink(model.with_memory(system), kinked), kinked


def _behind_lag(system: StateSpace, time_constant: Scalar) -> StateSpace:
    """Return the system behind a lag T x' = u - x, whose state becomes the last one."""
    a, b = system
    n, rate = len(a), 1 / time_constant
    wider = jnp.zeros((n + 1, n + 1), a.dtype).at[:n, :n].set(a).at[:n, n:].set(b).at[n, n].set(-rate)
    return StateSpace(wider, jnp.zeros((n + 1, 1), a.dtype).at[n, 0].set(rate))
