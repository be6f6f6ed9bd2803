"""Linear models of a braking wheel, by automatic differentiation.

    linearize    x' = f(x, u) at any point:  A = df/dx, B = df/du
    tracking     the dynamics of a tracked output while other outputs are frozen
    SlipModel    the slip error of a plant with what is around it, the model a feedback u = K x is designed for

Maeda and Sugiura, eqs. (15)-(21), are `SlipModel()`: x = (integral of (slip - target), slip - target), tau - tau* = u.
Speed is frozen, so a fall of the speed is a change of the model's parameter, not of its state.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

from diffabs.actuators import Lag
from diffabs.blocks import Direct
from diffabs.plants import BrakeStart, MirroredRig
from diffabs.protocols import Plant
from diffabs.pytree import Scalar, param, part, pytree, static, strong

FROZEN = ("speed", "distance")
TERMS, SQUARINGS = 14, 16  # of the matrix exponential
NEWTON = 10  # iterations for the rest of the remaining states; one is enough where their equation is linear


class StateSpace(NamedTuple):
    """x' = A x + B u, or x+ = A x + B u: A (n, n), B (n, m)."""

    A: Any
    B: Any


def linearize(plant: Plant, state: Any, control: Any) -> StateSpace:
    """df/dx (n, n) and df/du (n, m) at a state and a control, which need not be an equilibrium. The state's components
    are in the order of its leaves."""
    flow, x, u = _flat(plant, state, control)
    return StateSpace(*jax.jacfwd(flow, (0, 1))(x, u))


def tracking(
    plant: Plant, state: Any, control: Any, tracked: Sequence[str] = ("slip",), frozen: Sequence[str] = FROZEN
) -> StateSpace:
    """The linear dynamics of outputs `tracked` and of the remaining states, with the outputs `frozen` held.

        xi = F(x) = (h(x), remaining, w(x)),  xi' = DF(x) f(x, u) =: G(x, u),  A = (dG/dx) DF^-1,  B = dG/du

    and of these the rows and columns of (h, remaining). Remaining are the state's components on which neither h nor w
    depends. Exact at any point: where f is not zero, dG/dx contains the second derivative of F times f.

    Raises:
        ValueError: the outputs and the remaining states are no coordinates: too many, too few, or dependent (this last
            only outside of jit; inside, the matrices are not finite).
    """
    plant, state, control = strong((plant, state, control))
    flow, x, u = _flat(plant, state, control)
    unravel = ravel_pytree(state)[1]
    kept = _kept(plant, state, (*tracked, *frozen))

    def chart(x: Any) -> Any:
        y = plant.output(unravel(x))
        h, w = ([jnp.ravel(getattr(y, name)) for name in names] for names in (tracked, frozen))
        return jnp.concatenate([*h, x[kept], *w])

    by_x = jax.jacfwd(chart)(x)
    _check_chart(by_x, (*tracked, *frozen))
    a, b = jax.jacfwd(lambda x, u: jax.jvp(chart, (x,), (flow(x, u),))[1], (0, 1))(x, u)
    n = len(x) - sum(np.size(getattr(jax.eval_shape(plant.output, state), name)) for name in frozen)
    return StateSpace(jnp.linalg.solve(by_x.T, a.T).T[:n, :n], b[:n])


def _flat(plant: Plant, state: Any, control: Any) -> Any:
    """f(x, u) on vectors, and the vectors x and u."""
    plant, state, control = strong((plant, state, control))
    (x, unravel), (u, unravel_control) = ravel_pytree(state), ravel_pytree(control)

    def flow(x: Any, u: Any) -> Any:
        return ravel_pytree(plant.derivative(0.0, unravel(x), unravel_control(u)))[0]

    return flow, x, u


def _check_chart(by_x: Any, outputs: Sequence[str]) -> None:
    """Outputs and remaining states must be as many as the states, and independent."""
    rows, columns = by_x.shape
    named = ", ".join(outputs)
    if rows != columns:
        raise ValueError(f"{named} and the states they do not depend on are {rows} coordinates of {columns} states")
    if not isinstance(by_x, Tracer):
        unit = by_x / np.maximum(np.linalg.norm(by_x, axis=1, keepdims=True), 1e-300)
        if np.linalg.matrix_rank(unit) < rows:
            raise ValueError(f"{named} are no coordinates here: they depend on each other (singular Jacobian)")


def _kept(plant: Plant, state: Any, outputs: Sequence[str]) -> np.ndarray:
    """Places in the raveled state of the components that none of the outputs depends on."""
    used = _used(plant, state, outputs)
    sizes = [np.size(leaf) for leaf in jax.tree.leaves(state)]
    return np.flatnonzero(np.repeat([not u for u in used], sizes))


def _used(plant: Plant, state: Any, outputs: Sequence[str]) -> list[bool]:
    """Of each leaf of the state, whether some output is computed from it. From the traced program, not from values: it
    must be known while the parameters are tracers."""
    leaves, tree = jax.tree.flatten(state)

    def select(*leaves: Any) -> Any:
        y = plant.output(jax.tree.unflatten(tree, leaves))
        return [getattr(y, name) for name in outputs]

    program = jax.make_jaxpr(select)(*leaves).jaxpr
    needed = {id(v) for v in program.outvars}
    for equation in reversed(program.eqns):
        if needed & {id(v) for v in equation.outvars}:
            needed |= {id(v) for v in equation.invars}
    return [id(v) in needed for v in program.invars]


@pytree
class LowPass:
    """x_f' = cutoff (slip error - x_f): what a PID's derivative is taken from."""

    cutoff: Scalar = param(default=55.0, unit="rad/s", above=0.0)


@pytree
class Continuous:
    """The controller runs in continuous time."""


@pytree
class Sampling:
    """The controller runs every `period`; its output is held, and changes `delay` after the sample was taken."""

    period: Scalar = param(default=1e-3, unit="s", above=0.0, tunable=False)
    delay: Scalar = param(default=0.0, unit="s", low=0.0)

    def problems(self) -> Iterator[str]:
        """A computation that takes longer than the period."""
        if not self.delay <= self.period:
            yield f"delay = {self.delay:g} s exceeds the period of {self.period:g} s"


@pytree
class SlipModel:
    """The slip error at a frozen speed, under u = control - holding control.

    States in this order, those in brackets where they exist: [integral of the slip error, x1' = x2], slip error x2 =
    slip - target, [what the plant has besides slip, speed and distance], [actuator], [previous sample's control], [slip
    error behind `filter`]. Discrete in time if `sampling` says so: integral and filter by forward Euler from the sample
    that the control is computed from, the rest exactly, as `Sampled` does.
    """

    plant: Plant = part(default=MirroredRig)
    slip: Scalar = param(default=0.2, unit="1", above=0.0, below=1.0)
    speed: Scalar = param(default=50 / 3.6, unit="m/s", above=0.0, high=200.0)
    actuator: Direct | Lag = part(default=Direct)
    sampling: Continuous | Sampling = part(default=Continuous)
    filter: Direct | LowPass = part(default=Direct)
    integral: bool = static(default=True)

    @property
    def period(self) -> float | None:
        """Sampling period [s], None in continuous time."""
        return float(self.sampling.period) if isinstance(self.sampling, Sampling) else None

    @property
    def states(self) -> tuple[str, ...]:
        """What the states are."""
        self._supported()
        start = jax.eval_shape(self.plant.start, BrakeStart(speed=self.speed, slip=self.slip))
        paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(start)]
        used = _used(self.plant, start, ("slip", *FROZEN))
        kept = [jax.tree_util.keystr(p, simple=True) for p, u in zip(paths, used, strict=True) if not u]
        return (
            *(["integral of slip error"] if self.integral else []),
            "slip error",
            *kept,
            *(["actuator torque"] if isinstance(self.actuator, Lag) else []),
            *(["torque of the last sample"] if isinstance(self.sampling, Sampling) else []),
            *(["filtered slip error"] if isinstance(self.filter, LowPass) else []),
        )

    def matrices(self) -> StateSpace:
        """A (n, n) and B (n, 1), differentiable in every parameter; compiled once for each kind of model.

        Raises:
            ValueError: a part that a linear slip model does not know.
        """
        self._supported()
        return _matrices(self)

    def point(self) -> tuple[Any, Any]:
        """State and control of the linearisation: the slip is held, what remains is at rest, the speed falls."""
        start = self.plant.start(BrakeStart(speed=self.speed, slip=self.slip))
        control = self.plant.holding(self.plant.output(start), self.slip)
        kept = _kept(self.plant, start, ("slip", *FROZEN))
        if not len(kept):
            return start, control
        flow, x, u = _flat(self.plant, start, control)

        def rate(z: Any) -> Any:
            return flow(x.at[kept].set(z), u)[kept]

        def newton(_: Any, z: Any) -> Any:
            return z - jnp.linalg.solve(jax.jacfwd(rate)(z), rate(z))

        rest = jax.lax.fori_loop(0, NEWTON, newton, x[kept])
        return ravel_pytree(start)[1](x.at[kept].set(rest)), control

    def controlled(self) -> StateSpace:
        """Plant and actuator, sampled if the controller is: what the control acts on, the slip error first."""
        system = tracking(self.plant, *self.point())
        if isinstance(self.actuator, Lag):
            system = _behind_lag(system, self.actuator.time_constant)
        if isinstance(self.sampling, Sampling):
            system = held(system, self.sampling.period, self.sampling.delay)
        return system

    def with_memory(self, system: StateSpace) -> StateSpace:
        """The system, whose first state is the slip error, with integral and filter of the controller."""
        p, first = len(system.A), int(self.integral)
        n = p + first + isinstance(self.filter, LowPass)
        step, keep = (self.sampling.period, 1.0) if isinstance(self.sampling, Sampling) else (1.0, 0.0)
        a = jnp.zeros((n, n), system.A.dtype).at[first : first + p, first : first + p].set(system.A)
        if self.integral:
            a = a.at[0, :2].set(jnp.stack([keep, step]))
        if isinstance(self.filter, LowPass):
            rate = step * self.filter.cutoff
            a = a.at[-1, first].set(rate).at[-1, -1].set(keep - rate)
        return StateSpace(a, jnp.zeros((n, 1), a.dtype).at[first : first + p].set(system.B))

    def _supported(self) -> None:
        known = {"actuator": (Direct, Lag), "sampling": (Continuous, Sampling), "filter": (Direct, LowPass)}
        for name, types in known.items():
            found = getattr(self, name)
            if not isinstance(found, types):
                names = " and ".join(t.__name__ for t in types)
                raise ValueError(f"{name}: a linear slip model knows {names}, not {type(found).__name__}")


@jax.jit
def _matrices(model: SlipModel) -> StateSpace:
    model = strong(model)
    return model.with_memory(model.controlled())


def _behind_lag(system: StateSpace, time_constant: Any) -> StateSpace:
    """The system whose input is the last state, T x' = u - x."""
    a, b = system
    n, rate = len(a), 1 / time_constant
    wider = jnp.zeros((n + 1, n + 1), a.dtype).at[:n, :n].set(a).at[:n, n:].set(b).at[n, n].set(-rate)
    return StateSpace(wider, jnp.zeros((n + 1, 1), a.dtype).at[n, 0].set(rate))


def held(system: StateSpace, period: Any, delay: Any) -> StateSpace:
    """One period of the system under an input that is the last state, the previous input, until `delay`, then the new
    one: x(T) = e^(A T) x + e^(A (T - d)) G(d) u_old + G(T - d) u,  G(s) = integral of e^(A r) B over r in [0, s]."""
    (a, b), n, m = system, *system.B.shape
    with_input = jnp.zeros((n + m, n + m), a.dtype).at[:n, :n].set(a).at[:n, n:].set(b)
    before, after = (_exponential(with_input * s) for s in (delay, period - delay))
    both = jnp.zeros_like(with_input).at[:n].set(after[:n, :n] @ before[:n])
    return StateSpace(both, jnp.concatenate([after[:n, n:], jnp.eye(m, dtype=a.dtype)]))


def _exponential(a: Any) -> Any:
    """e^a by scaling and squaring of its Taylor series, to about rounding for norms up to 2^SQUARINGS.

    Not `jax.scipy.linalg.expm`: 20,000 of the lab rig's models at once with it waited for ever (JAX 0.10.2, two cores).
    """
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(a), axis=1)))
    halvings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(norm, 0.25))) + 1, 0, SQUARINGS)
    scaled, one = a * 2.0**-halvings, jnp.eye(len(a), dtype=a.dtype)
    series = jax.lax.fori_loop(0, TERMS, lambda i, e: one + scaled @ e / (TERMS - i), one)
    return jax.lax.fori_loop(0, SQUARINGS, lambda i, e: jnp.where(i < halvings, e @ e, e), series)
