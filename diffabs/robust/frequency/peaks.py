"""Bounds of the peak of S, of T or of any channel of a loop over a box of parameters, from both sides.

    reached    a peak that a loop of the box has: gradient ascent from several starts
    constant   no loop of the box exceeds it, at any frequency: the bound of mu, for parameters that stand still
    varying    nor does the gain with parameters that vary arbitrarily fast: the bounded real lemma

`vertices` has the inequalities of both bounds. They hold for the hull of vertices that covers the box: `polytope`
checks that cover at a grid and at random points.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from diffabs.core.compiling import SAME_RESULT_OPTIONS
from diffabs.core.jax_flags import default_flags
from diffabs.core.pytree import part, pytree, replace, static
from diffabs.core.types import Array, JsonObject, Scalar
from diffabs.core.validity import check_part
from diffabs.linear.linearization import StateSpace
from diffabs.linear.responses import hinf_norm, open_transfer
from diffabs.linear.responses.response import TracedSystem, as_arrays
from diffabs.linear.stability_margins import json_number
from diffabs.linear.transfer import WHOLE_PERIOD_TOLERANCE, Transfer
from diffabs.loop.closed_loop import Loop
from diffabs.parts.controllers import Sampled
from diffabs.robust.design import certify
from diffabs.robust.design.parameter_box import polytope
from diffabs.robust.design.polytopes import Coverage, Polytope
from diffabs.robust.frequency.vertices import VertexSystems, bound_constant, bound_varying
from diffabs.robust.reach.cover import check_box

SCREENED = 16  # points inside the box, besides its corners, where ascents may start
MAX_CORNERS = 64
STARTS, MAX_STEPS = 4, 40  # ascents, from the highest of these points, and steps of each
MAX_BOUNDED_VERTICES = 64  # of a hull whose bounds are computed

PEAK_NAMES = ("sensitivity", "complementary")
Channel: TypeAlias = Callable[[Loop], Transfer | TracedSystem]


class PeakBounds(NamedTuple):
    """Bounds of the peak gain of a channel over a box.

    Attributes:
        reached: Greatest peak that the ascents met; infinite if a loop of the box is unstable.
        values: Parameters of that loop, by path.
        at: Frequency of its peak [rad/s].
        constant: Bound for constant parameters at all frequencies; infinite without one, NaN where the solver's answer
            does not pass its check.
        constant_at: Frequency whose own bound, for it alone, is the greatest [rad/s].
        varying: Bound for parameters that vary arbitrarily fast, likewise.
        no_common: Whether it is proved that no common Lyapunov matrix exists, so `varying` is infinite.
        ranges: Number of frequency ranges of `constant`, each with its own multiplier.
        vertices: Number of vertices of the hull.
        coverage: Check that the hull covers the box.
        seconds: Computing time [s] of the ascents, the hull, `constant` and `varying`.
    """

    reached: float
    values: Mapping[str, float]
    at: float
    constant: float
    constant_at: float
    varying: float
    no_common: bool
    ranges: int
    vertices: int
    coverage: Coverage | None
    seconds: Mapping[str, float]

    def record(self) -> JsonObject:
        """Return the bounds as JSON values, in SI."""
        cover = self.coverage
        spread = {} if cover is None else {"checked": cover.checked, "spread": json_number(cover.spread)}
        fields = self._asdict()
        numbers = {name: json_number(fields[name]) for name in ("reached", "at", "constant", "constant_at", "varying")}
        return {**fields, **numbers, "values": dict(self.values), "seconds": dict(self.seconds), "coverage": spread}


@default_flags()
def bound_peaks(
    loop: Loop, over: Mapping[str, tuple[float, float]], channel: Channel | None = None, *, seed: int = 0
) -> dict[str, PeakBounds]:
    """Return bounds of the peaks of S and T of a linearised loop over a box of parameters, or of another channel.

    The loop is that of `linear.open_loop`, at rest on its setpoint, with one control or several. In a sampled loop
    whole periods of delay are states. With several controls the gain is the largest singular value.

    Args:
        loop: Loop in continuous time without pure delay, or with a `Sampled` controller.
        over: Range (low, high) of each parameter of the box, by path, in SI units.
        channel: None for S and T at the controls, by the names "sensitivity" and "complementary". Or a function of a
            loop that returns another closed channel without delay, differentiable as `linear.responses.open_transfer`
            is, whose order does not depend on the parameters; its bounds have the name "channel".
        seed: Seed of the points at which ascents may start.

    Raises:
        ValueError: A range is wrong, the loop has no linear model in the box, a pure delay in continuous time or a
            delay of other whole periods in it, or the hull needs more than 64 vertices.
        ModuleNotFoundError: cvxpy is not installed.

    See also:
        `frequency.prove_sensitivity`: A proof about the box itself, with exact delays.
        `linear.band`: Margins at samples of a box.
        `linear.responses.structured_singular_value`: Bounds of mu of one matrix.

    Notes:
        A hull of vertices covers the systems of the box. If one F at a frequency has, at each vertex,

            gamma^2 |w|^2 - |z|^2 - 2 Re v* F [s I - A, -B] v > 0   for all v = (x, w) that are not 0,

        then gamma is a bound of every constant system there: of mu, for real parameters and a full performance block.
        One F serves a range of frequencies, so the bound holds between grid points, too. One P > 0 with
        -d/dt x'P x - |z|^2 + gamma^2 |w|^2 > 0 bounds the gain of parameters that vary. The returned bounds are
        evaluated after the solver: eigenvalues are above what errors of 2^-40 of each entry can change. The hull is
        checked at a grid and at random points of the box, and may hold systems with a higher peak than any in the box.
        Source: C. Scherer, LPV control and full block multipliers, Automatica 37 (2001).

    Examples:
        A laboratory brake at high speed, for all masses:

        >>> from diffabs.robust.frequency import bound_peaks
        >>> from diffabs.scenario import load
        >>> box = {"plant.mass": (5.3, 6.2), "initial.speed": (10.0, 13.9)}
        >>> bounds = bound_peaks(load("slip-lmi").loop, box)["sensitivity"]
        >>> print(f"found {bounds.reached:.3f}, constant {bounds.constant:.3f}, varying {bounds.varying:.3f}")
        found 2.403, constant 2.403, varying 3.518
    """
    check_part(loop)
    check_box(over)
    with jax.enable_x64(True):
        closed = _close(loop, over, channel)
        began = time.monotonic()
        peaks = _climb(closed, over, seed)
        times = {"ascents": time.monotonic() - began}
        if not all(np.isfinite(peak.value) for peak in peaks.values()):
            return {name: _without_bounds(over, peak, times) for name, peak in peaks.items()}
        began = time.monotonic()
        hull = polytope(closed, {f"loop.{path}": ends for path, ends in over.items()})
    if hull.vertices > MAX_BOUNDED_VERTICES:
        raise ValueError(
            f"the hull of the systems needs {hull.vertices} vertices, more than {MAX_BOUNDED_VERTICES}: vary fewer "
            "parameters"
        )
    systems = closed.unpack(hull.A)
    states = Polytope(A=systems.A, B=np.zeros((*systems.A.shape[:2], 1)), period=systems.period)
    kinds = {claim.kind for claim in certify(np.zeros((1, states.order)), states).claims}
    times["hull"] = time.monotonic() - began
    return {name: _bound(name, systems, hull, peak, over, kinds, times) for name, peak in peaks.items()}


class _Peak(NamedTuple):
    """A peak of a channel, its parameters (p,) and its frequency [rad/s]; infinite at an unstable loop."""

    value: float
    point: np.ndarray
    at: float


def _without_bounds(over: Mapping[str, tuple[float, float]], peak: _Peak, times: Mapping[str, float]) -> PeakBounds:
    values = dict(zip(over, peak.point.tolist(), strict=True))
    return PeakBounds(peak.value, values, peak.at, np.inf, np.nan, np.inf, False, 0, 0, None, times)


def _bound(
    name: str, systems: VertexSystems, hull: Polytope, peak: _Peak, over: Mapping[str, tuple[float, float]],
    kinds: set[str], times: Mapping[str, float],
) -> PeakBounds:  # fmt: skip
    """Return the bounds of one channel; `kinds` are those of what `certify` proves about the stability of the hull."""
    bounds = _without_bounds(over, peak, times)._replace(vertices=hull.vertices, coverage=hull.coverage)
    no_common = bool(kinds & {"infeasible", "unstable"})
    if "unstable" in kinds:
        return bounds._replace(no_common=no_common)
    if name == "complementary":  # T = I - S
        systems = systems._replace(C=-systems.C, D=np.eye(systems.D.shape[1]) - systems.D)
    began = time.monotonic()
    constant = bound_constant(systems, peak.value, peak.at)
    middle = time.monotonic()
    varying = np.inf if no_common else bound_varying(systems, peak.value)
    return bounds._replace(
        constant=constant.value,
        constant_at=constant.at,
        varying=varying,
        no_common=no_common,
        ranges=constant.ranges,
        seconds={**times, "constant": middle - began, "varying": time.monotonic() - middle},
    )


@pytree
class _ClosedChannel:
    """A channel of a loop as one matrix [[A, B], [C, D]], padded to a square, of the states that it depends on."""

    loop: Loop = part()
    channel: Channel = static()
    names: tuple[str, ...] = static(default=())
    coupled: tuple[int, ...] = static(default=())
    inputs: int = static(default=1)
    states: tuple[str, ...] = static(default=())

    @property
    def period(self) -> float | None:
        """Sampling period [s]."""
        controller = self.loop.controller
        return controller.period if isinstance(controller, Sampled) else None  # pyright: ignore[reportReturnType]

    def system(self) -> TracedSystem:
        """Return the channel, without states that it does not depend on."""
        system, keep = as_arrays(self.channel(self.loop)), np.array(self.coupled, int)
        return system._replace(A=system.A[np.ix_(keep, keep)], B=system.B[keep], C=system.C[:, keep])

    def matrices(self) -> StateSpace:
        """Return the padded matrix and an empty input."""
        a, b, c, d = self.system()[:4]
        whole = jnp.block([[a, b], [c, d]])
        size = max(whole.shape)
        whole = jnp.pad(whole, ((0, size - whole.shape[0]), (0, size - whole.shape[1])))
        return StateSpace(whole, jnp.zeros((size, 1)))

    def unpack(self, wholes: np.ndarray) -> VertexSystems:
        """Return the systems of padded matrices (V, k, k)."""
        n, m = len(self.coupled), self.inputs
        outputs = jax.eval_shape(lambda: self.system().D).shape[0]
        a, c = wholes[:, :n], wholes[:, n : n + outputs]
        period = None if self.period is None else float(self.period)
        return VertexSystems(a[:, :, :n], a[:, :, n : n + m], c[:, :, :n], c[:, :, n : n + m], period)


def _close(loop: Loop, over: Mapping[str, tuple[float, float]], channel: Channel | None) -> _ClosedChannel:
    """Return S or another channel of a loop as a model of the box.

    Raises ValueError for a loop that the bounds do not cover.
    """
    corners = [replace(loop, dict(zip(over, point, strict=True))) for point in _corners(over)]
    names = ("channel",)
    if channel is None:
        opened = jax.jit(open_transfer)
        channel, names = _Sensitivity(_count_periods([opened(corner) for corner in corners])), PEAK_NAMES
    response = jax.jit(channel)
    systems = [as_arrays(response(corner)) for corner in corners]
    if not all(np.isfinite(np.concatenate([np.ravel(x) for x in system[:4]])).all() for system in systems):
        raise ValueError("the loop has no linear model at a corner of the box: it does not rest, or is at a kink")
    if any(np.any(system.delay) for system in systems):
        raise ValueError("the channel has a pure delay: bounds over a box need finitely many states")
    coupled = sorted(set().union(*map(_coupled_states, systems)))
    if not coupled:
        raise ValueError("the channel has no states: its gain is the same at all frequencies")
    return _ClosedChannel(loop=loop, channel=channel, names=names, coupled=tuple(coupled), inputs=systems[0].B.shape[1])


@dataclasses.dataclass(frozen=True)
class _Sensitivity:
    """S of a loop, with whole periods of delay as states."""

    periods: int

    def __call__(self, loop: Loop) -> TracedSystem:
        opened = open_transfer(loop)
        a, b, c, d = opened[:4]
        m = b.shape[1]
        for _ in range(self.periods):  # the old input is a state
            a = jnp.block([[a, b], [jnp.zeros((m, len(a) + m))]])
            c, b = jnp.hstack([c, d]), jnp.concatenate([jnp.zeros((len(a) - m, m)), jnp.eye(m)])
            d = jnp.zeros_like(d)
        direct = jnp.linalg.inv(jnp.eye(m) + d)
        b = b @ direct
        return TracedSystem(a - b @ c, b, -direct @ c, direct, opened.period, jnp.zeros(()))


def _count_periods(systems: list[TracedSystem]) -> int:
    """Return the whole periods of delay of open loops. Raises ValueError for others, or if they differ."""
    delays = [float(system.delay) for system in systems]
    period = systems[0].period
    if period is None:
        if any(delays):
            raise ValueError(
                f"the loop has a pure delay of {max(delays):g} s in continuous time: bounds over a box need finitely "
                "many states; certify --sensitivity has exact delays"
            )
        return 0
    counts = {round(delay / float(period) + WHOLE_PERIOD_TOLERANCE) for delay in delays}
    if len(counts) > 1:
        raise ValueError(f"the delay has from {min(counts)} to {max(counts)} whole periods in the box: cut it there")
    return counts.pop()


def _coupled_states(system: TracedSystem) -> set[int]:
    """Return the states that are linked with another one, with an input or with an output."""
    a = np.asarray(system.A) * (1 - np.eye(len(system.A)))
    linked = a.any(axis=0) | a.any(axis=1) | np.asarray(system.B).any(axis=1) | np.asarray(system.C).any(axis=0)
    return set(np.flatnonzero(linked).tolist())


def _corners(over: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Return up to `MAX_CORNERS` corners of the box, (k, p)."""
    ends = np.array([sorted(pair) for pair in over.values()], float).reshape(-1, 2)
    count = min(2 ** len(ends), MAX_CORNERS)
    bits = (np.arange(count)[:, None] >> np.arange(len(ends))) & 1
    return ends[np.arange(len(ends)), bits]


def _climb(closed: _ClosedChannel, over: Mapping[str, tuple[float, float]], seed: int) -> dict[str, _Peak]:
    """Return the greatest peak that ascents meet for each name of a channel."""
    from scipy.optimize import minimize
    from scipy.stats import qmc

    low, high = np.array(list(over.values()), float).reshape(-1, 2).T
    width = np.where(high > low, high - low, 1.0)
    paths = [f"loop.{path}" for path in over]

    def measure(share: Array) -> tuple[Scalar, tuple[Scalar, Scalar]]:
        values = low + share * (high - low)
        system = replace(closed, dict(zip(paths, values, strict=True))).system()
        outputs = [(system.C, system.D)]
        if len(closed.names) > 1:  # T = I - S
            outputs.append((-system.C, jnp.eye(len(system.D)) - system.D))
        c, d = (jnp.stack(matrices) for matrices in zip(*outputs, strict=True))
        answer = jax.vmap(lambda c, d: hinf_norm(system._replace(C=c, D=d)))(c, d)
        return answer.value, (answer.value, answer.at)

    climb = jax.jit(jax.jacfwd(measure, has_aux=True), compiler_options=SAME_RESULT_OPTIONS)
    inside = qmc.Sobol(len(low), rng=np.random.default_rng(seed)).random(SCREENED)
    shares = np.concatenate([(_corners(over) - low) / width, inside])
    met: list[list[_Peak]] = [[] for _ in closed.names]

    def evaluate(share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slopes, (values, at) = jax.device_get(climb(share))
        for peaks, value, w in zip(met, values, at, strict=True):
            peaks.append(_Peak(float(value) if np.isfinite(value) else np.inf, low + share * (high - low), float(w)))
        return values, slopes

    screened = np.array([evaluate(share)[0] for share in shares])
    if np.isfinite(screened).all():
        for i in range(len(closed.names)):

            def descend(share: np.ndarray, i: int = i) -> tuple[float, np.ndarray]:
                values, slopes = evaluate(share)
                return (-float(values[i]), -slopes[i]) if np.isfinite(values[i]) else (np.inf, np.zeros(len(share)))

            for start in shares[np.argsort(-screened[:, i])[:STARTS]]:
                minimize(descend, start, jac=True, bounds=[(0.0, 1.0)] * len(low), options={"maxiter": MAX_STEPS})
    return {name: max(peaks, key=lambda peak: peak.value) for name, peaks in zip(closed.names, met, strict=True)}
