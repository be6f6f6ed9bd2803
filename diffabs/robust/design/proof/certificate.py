"""Certificates: claims about the closed loops of a gain with the numbers that prove them, saved in a verifiable file.

A file stores no verdict. `Certificate.load` reads matrices and claims, and `Certificate.verify` proves them exactly
(`design.proof.exact`). `design.verify` also proves them and shares no code with the rest of this package. Claims and
their data, by kind:

    decay       P, rate (factor in discrete time)   V = x' P x falls like exp(-2 rate t), by factor^2 a period
    cost        P, Q, R, in older files an x0       the cost from any x is at most x' P x
    damping     P, cot, zeta                        every fixed system of the hull has damping above zeta
    l2          P, gamma, Bw, C, D                  the gain from w to C x + D u is below gamma
    input       P, limit, points                    |u| <= limit for ever from the hull of the points
    infeasible  W, rate (factor)                    no common P proves the rate
    unstable    P, x, vertex, rate (factor)         this vertex alone does not decay by the rate or faster
    scheduled   P, rates, maybe rate, Q, R          the same with P(p), p' between the two `rates`
"""

import dataclasses
import functools
import math
import os
import pathlib
from collections.abc import Iterator, Mapping
from fractions import Fraction
from types import MappingProxyType

import numpy as np

from diffabs.core.numerics import spectral_bound
from diffabs.core.types import Params, PyTree
from diffabs.host import files
from diffabs.robust.design.polytopes import Polytope, Schedule
from diffabs.robust.design.proof import exact, schema, serialise

QUADRATIC_KINDS = ("decay", "cost", "damping", "l2", "input")  # each has one P > 0 that decreases at every vertex


@dataclasses.dataclass(frozen=True, eq=False)
class Claim:
    """One inequality and the numbers that prove it; arrays are copied and read-only.

    Attributes:
        kind: Kind of the claim, one of those in the table of this module.
        data: Numbers and arrays by name.
    """

    kind: str
    data: Mapping[str, float | np.ndarray]

    def __post_init__(self) -> None:
        """Convert the numbers to floats, and the arrays to read-only copies."""
        data = {name: as_read_only_array(value) for name, value in self.data.items()}
        data = {name: value if value.ndim else float(value) for name, value in data.items()}
        object.__setattr__(self, "data", MappingProxyType(data))


@dataclasses.dataclass(frozen=True, eq=False)
class Certificate:
    """Claims about the loops A + B K of a polytope or of a schedule.

    The certificate holds read-only copies, so a verdict stays true. A property whose claim is missing or not proved is
    None.

    Attributes:
        system: A polytope or a schedule.
        gain: Gain K, shape (m, n). For a schedule of N cells also one gain for each node, shape (N + 1, m, n).
        claims: Claims of the certificate.

    Raises:
        ValueError: Claims or a gain that do not fit the system.
    """

    system: Polytope | Schedule
    gain: np.ndarray
    claims: tuple[Claim, ...]

    def __post_init__(self) -> None:
        """Copy the data, and check shapes and ranges of the claims."""
        gain = as_read_only_array(self.gain)
        object.__setattr__(self, "gain", as_read_only_array(gain[None]) if gain.ndim == 1 else gain)
        object.__setattr__(self, "system", as_read_only_system(self.system))
        object.__setattr__(self, "claims", tuple(self.claims))
        schema.check_gain(self.system, self.gain)
        for claim in self.claims:
            schema.check_claim(claim.kind, self.system, self.gain, claim.data)

    def verify(self) -> tuple[bool, ...]:
        """Return for each claim, in order, whether exact arithmetic proves it.

        The proof also covers relative errors of up to 2^-40 in each entry of the vertices' matrices.
        """
        return self._verdicts

    @functools.cached_property
    def _verdicts(self) -> tuple[bool, ...]:
        return tuple(exact.is_proved(claim.kind, self.system, self.gain, claim.data) for claim in self.claims)

    @property
    def verified_exactly(self) -> bool:
        """Whether the certificate has a claim and all its claims are proved."""
        return bool(self.claims) and all(self.verify())

    def proved_data(self, *kinds: str) -> Iterator[Params]:
        """Yield the data of the proved claims of these `kinds`."""
        for claim, verdict in zip(self.claims, self.verify(), strict=True):
            if verdict and claim.kind in kinds:
                yield claim.data

    @property
    def period(self) -> float | None:
        """Sampling period [s] of a discrete-time system; None for continuous time."""
        return self.cells[0].period

    @property
    def cells(self) -> tuple[Polytope, ...]:
        """Polytopes of a schedule; a polytope is its own single cell."""
        return self.system.cells if isinstance(self.system, Schedule) else (self.system,)

    @property
    def quadratically_stable(self) -> bool | None:
        """True if one P is proved to decrease at all vertices, False if a proof excludes such a P, otherwise None.

        A vertex with a growing mode excludes such a P, whatever the others are.
        """
        # A scheduled claim with equal P at all nodes is a proof for one P.
        common = [data["P"] for data in self.proved_data("scheduled") if (data["P"] == data["P"][0]).all()]
        if common or any(self.proved_data(*QUADRATIC_KINDS)):
            return True
        # Only a witness against the rate 0 excludes stability; a witness against a faster decay leaves it open.
        refuted = (
            data.get("rate", 0.0) <= 0 and data.get("factor", 1.0) >= 1
            for data in self.proved_data(*schema.DISPROOF_KINDS)
        )
        return False if any(refuted) else None

    @property
    def stable(self) -> bool | None:
        """True if any proved claim except a disproof implies stability; else None, never False.

        Every such claim has a P, or a P that depends on a schedule's parameter, that decreases along all trajectories.
        """
        return True if any(self.proved_data(*QUADRATIC_KINDS, "scheduled")) else None

    @property
    def decay_rate(self) -> float | None:
        """Largest proved decay rate of |x| [1/s], from decay and scheduled claims; None without such a claim.

        A cost claim of a polytope proves no rate. A scheduled claim without a rate counts as 0.
        """
        rates = [data.get("rate", 0.0) for data in self.proved_data("decay", "scheduled")]
        if self.period is not None:
            rates = [-math.log(data.get("factor", 1.0)) / self.period for data in self.proved_data("decay")]
        return max(rates, default=None)

    @property
    def guaranteed_cost(self) -> float | None:
        """Trace P of the first proved cost claim, rounded up; for a scheduled claim the largest over the nodes.

        It is the cost summed over starts at the unit vectors. It is None without a proved cost.
        """
        return self._cost(self.proved_data("cost", "scheduled"))

    def _cost(self, claims: Iterator[Params]) -> float | None:
        """Return trace P of the first of these claims that has a cost."""
        for data in claims:
            if "Q" in data or "R" in data:
                return max(
                    round_up(sum(map(Fraction, np.diag(P)))) for P in data["P"].reshape(-1, *data["P"].shape[-2:])
                )
        return None

    @property
    def damping(self) -> float | None:
        """Largest damping ratio [1] proved for all fixed systems of the hull."""
        return max((data["zeta"] for data in self.proved_data("damping")), default=None)

    @property
    def l2_gain(self) -> float | None:
        """Bound of the L2 gain in the first proved l2 claim."""
        return next((data["gamma"] for data in self.proved_data("l2")), None)

    @property
    def input_limit(self) -> np.ndarray | None:
        """Bounds of the inputs (m,) in the first proved input claim."""
        return next((data["limit"] for data in self.proved_data("input")), None)

    @functools.cached_property
    def _margins(self) -> list[tuple[str, dict[int, float]]]:
        return [
            (claim.kind, exact.vertex_margins(claim.kind, self.system, self.gain, claim.data)) for claim in self.claims
        ]

    @property
    def margins(self) -> dict[str, float]:
        """Smallest margin [1] by kind of claim, in floats; also of claims that are not proved.

        A margin is the smallest eigenvalue of a claim's inequality, relative to the largest eigenvalue of its terms by
        magnitude. A negative margin contradicts the claim up to rounding. Side conditions such as P > 0 do not count.
        """
        smallest: dict[str, float] = {}
        for kind, margins in self._margins:
            smallest[kind] = min(smallest.get(kind, math.inf), *margins.values())
        return smallest

    @property
    def worst_vertex(self) -> dict[str, PyTree] | None:
        """The vertex with the smallest margin, or None without a claim about single vertices.

        Keys: `index` over the vertices of all cells in order, `cell` (its number), `corner` (parameters by path, or
        None), `claim` (its kind) and `margin` [1].
        """
        all_of = [
            (value, i, kind) for kind, each in self._margins for i, value in each.items() if i != exact.ALL_VERTICES
        ]
        if not all_of:
            return None
        margin, index, kind = min(all_of)
        places = [(c, cell.corners[i] if cell.corners else None) for c, cell in enumerate(self.cells)
                  for i in range(cell.vertices)]  # fmt: skip
        cell, corner = places[index]
        corner = None if corner is None else dict(corner)
        return {"index": index, "cell": cell, "corner": corner, "claim": kind, "margin": margin}

    @property
    def frozen(self) -> tuple[float, ...]:
        """Largest real part [1/s] of the poles of A + B K at each vertex, over all cells in order.

        In discrete time it is their spectral radius [1]. The values are floats and no proof. For a schedule a value is
        the worse one for the gains at the cell's two nodes.
        """
        # Within a cell K is linear between its two nodes: each vertex is checked with both gains.
        gains = (
            self.gain if self.gain.ndim == 3 else np.broadcast_to(self.gain, (len(self.cells) + 1, *self.gain.shape))
        )
        poles = []
        for c, cell in enumerate(self.cells):
            closed = (cell.closed_loop(gain) for gain in gains[c : c + 2])
            pair = [spectral_bound(matrices, discrete=self.period is not None) for matrices in closed]
            poles += np.max(pair, axis=0).tolist()
        return tuple(poles)

    def summary(self) -> dict[str, PyTree]:
        """Return the proved properties for JSON.

        The keys are the names of the properties, `gain`, `trace_cost` and `claims`. `trace_cost` is the cost of the
        first cost claim, proved or not; `guaranteed_cost` is proved.
        """
        limit = self.input_limit
        return {
            "gain": self.gain.tolist(),
            "verified_exactly": self.verified_exactly,
            "quadratically_stable": self.quadratically_stable,
            "stable": self.stable,
            "decay_rate": self.decay_rate,
            "trace_cost": self._cost(claim.data for claim in self.claims),
            "guaranteed_cost": self.guaranteed_cost,
            "damping": self.damping,
            "l2_gain": self.l2_gain,
            "input_limit": None if limit is None else limit.tolist(),
            "worst_vertex": self.worst_vertex,
            "margins": self.margins,
            "claims": [{"kind": c.kind, "proved": ok} for c, ok in zip(self.claims, self.verify(), strict=True)],
        }

    def __str__(self) -> str:
        """Return one line for each claim, and the worst vertex."""
        size = f"{sum(cell.vertices for cell in self.cells)} vertices of order {self.cells[0].order}"
        lines = [f"certificate for {size}, gain {' '.join(str(self.gain.tolist()).split())}"]
        for claim, verdict in zip(self.claims, self.verify(), strict=True):
            numbers = [f"{name} {value!r}" for name, value in claim.data.items() if isinstance(value, float)]
            lines.append("  ".join([f"{claim.kind}:", "proved" if verdict else "NOT PROVED", *numbers]))
        if worst := self.worst_vertex:
            where = ", ".join(f"{name} {value:.6g}" for name, value in (worst["corner"] or {}).items())
            lines.append(f"tightest at vertex {worst['index']} ({where or 'no corner named'}): {worst['margin']:.2e}")
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the certificate to the file at `path`, complete or not at all.

        Raises:
            OSError: The file cannot be written.
            ValueError: A certificate that is too large for its readers.
        """
        claims = ((claim.kind, claim.data) for claim in self.claims)
        files.write_file(pathlib.Path(path), serialise.format_certificate(self.system, self.gain, claims).encode())

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Certificate":
        """Return the certificate saved at `path`, with nothing proved yet.

        Its polytopes have no `corners` and no `coverage`.

        Raises:
            OSError: The file cannot be read.
            ValueError: A file that is no certificate; the message is one line that names the field.
        """
        try:
            system, gain, claims = serialise.read_certificate(path)
            return Certificate(system, gain, tuple(Claim(kind, data) for kind, data in claims))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{os.fspath(path)}: {' '.join(str(error).split())}") from None


def as_read_only_array(value: object) -> np.ndarray:
    """Return a copy as floats that cannot be written to."""
    array = np.array(value, float)
    array.setflags(write=False)
    return array


def as_read_only_system(system: Polytope | Schedule) -> Polytope | Schedule:
    """Return a copy whose arrays cannot be written to."""
    if isinstance(system, Schedule):
        copy = dataclasses.replace(system, cells=tuple(map(_as_read_only_polytope, system.cells)))
        copy.nodes.setflags(write=False)
        return copy
    return _as_read_only_polytope(system)


def _as_read_only_polytope(system: Polytope) -> Polytope:
    copy = dataclasses.replace(system)
    copy.A.setflags(write=False)
    copy.B.setflags(write=False)
    return copy


def round_up(value: Fraction | float) -> float:
    """Return the smallest float that is not below a rational number."""
    near = float(value)
    return near if Fraction(near) >= value else math.nextafter(near, math.inf)
