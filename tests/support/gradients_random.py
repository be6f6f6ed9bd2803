"""Gradients of random loops against differences of three widths.

    python tests/support/gradients_random.py --loops 200 --seed 0 [--jobs 2] [--only 17] [--refine] [--json found.json]

Loop i of a seed is always the same (`random_loops.py`), of structure i modulo their number. Every objective is
differentiated in forward mode in every tunable number of the loop and of the objectives, in units of the number's size,
and compared with central differences of 1e-2, 3e-3 and 1e-3 of it. Where the three agree to 1e-3 of the derivative's
scale, the gradient must agree with them to 2e-3: an entry where it does not is wrong, and the exit status is 1. The
scale is the derivative's size, or a thousandth of the objective's where that is more. Three widths, and wide ones,
because a narrow difference agrees with a gradient that misses the same: what happens between the points of a grid.

Entries on which the widths do not agree say nothing of the gradient. They are counted by what the differences show:

    kink      left and right differences are two numbers: the value stands on a kink, or on a jump
    nearby    the two narrow ones agree: something jumps or bends within 1 % (a band is grazed, a peak changes place)
    curved    they differ as the square of the width: a smooth, strongly bent function
    scatter   none of these: the run has jumps of its own (a sample taken on this side or that of an event)
    closer    the three agree by chance: something bends on either side, closer than the narrowest of them
    diverged  a run of the differences has no value

`closer` are entries that would be wrong. Differences of 1e-4 to 1e-5 agree with the gradient, and it is no grid's
doing: at a quarter of the step all widths say the same.

Of `nearby` and `curved` the derivative is known all the same, from the narrow two or by extrapolation; how many
gradients agree with that to 1e-2 is said, and does not count.

A derivative must not change the value: that beside the gradient is the value (1e-9), and that of a run as it is without
a derivative, whose kinks are not located unless a rate jumps there (1e-5), but for the step's error: at a quarter of
the step it must be nearer. Else the value has `moved`, and counts as a wrong entry. Not collected by pytest;
`test_gradients_random.py` runs some."""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cached_property, partial
from multiprocessing import get_context
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import random_loops

from diffabs.core.pytree import canonical_dtypes, get, refine_parts, replace
from diffabs.engine.solvers import Adaptive, FixedStep
from diffabs.loop.run import measure

WIDTHS = (1e-2, 3e-3, 1e-3)
CLOSER, FINER = (1e-4, 3e-5, 1e-5), 4  # widths, and steps so many times shorter, for what seems wrong
AGREE, RIGHT, KNOWN = 1e-3, 2e-3, 1e-2  # of the scale
SAME, STEP, LESS = 1e-9, 1e-5, 0.6  # of values: rounding; the error of a step; what is left of it at a shorter one
BY_GRID = ("torque_rate",)  # taken at the steps' ends, as it documents: a kink that is located is one
KINKED = 1e-2  # by which slopes to the left and to the right differ, of the scale
PART, LEAST = 1e-3, 1e-6  # the scale's least: of the objective, and absolute
CLASSES = ("kink", "nearby", "curved", "scatter", "closer", "diverged")
SURE = 1e-10  # of the differences of adaptive runs
SHOWN = 15


class Found(NamedTuple):
    """Of one loop: entries (objective, number), values (objective,), gradients (.., ..), runs of the differences."""

    structure: str
    number: int
    objectives: list[str]
    names: list[str]
    value: np.ndarray  # (m,)
    gradient: np.ndarray  # (m, n), in units of the numbers' sizes
    sides: np.ndarray  # (widths, 2, m, n), objectives at +width and -width
    ended: bool  # the run itself reached its stop, or the end of its time if it has none
    beside: np.ndarray  # (m,), values that come with the gradient
    plain: np.ndarray  # (m,), values without a derivative
    closer: Any = False  # (m, n), entries whose differences are not to be believed
    moved: tuple[str, ...] = ()  # objectives whose value is another one beside a gradient


class Program:
    """What is compiled for a structure: values of many loops, and the gradient of one."""

    def __init__(self, name: str, times: int = 1, rtol: float | None = None):
        self.name, self.structure, self.times, self.rtol = name, random_loops.STRUCTURES[name], times, rtol
        step, duration = self.structure.step / times, self.structure.duration
        solver = slow = FixedStep(step, duration, kinks=True)  # as derivatives have it
        if rtol is not None:
            solver, slow = (Adaptive(error, duration, step) for error in (rtol, SURE))
        self.measured = dict(self.structure.objectives)
        if rtol is not None and "delay" in name:
            del self.measured["variation"]  # has no derivative there
        self.objectives = list(self.measured)

        def one(solver: Any, loop: Any, measures: Any, x: Any) -> tuple[Any, Any]:
            loop, measures = _moved(loop, measures, self.places, x)
            run = measure(loop, solver, measures, key=jax.random.key(3))
            return jnp.stack([run.metrics[one] for one in self.objectives]), run.diverged | run.timed_out

        def twice(*args: Any) -> tuple[Any, Any]:
            values, _ = one(solver, *args)
            return values, values

        self.values = jax.jit(jax.vmap(partial(one, slow), (None, None, 0)))
        self.plain = jax.jit(partial(one, FixedStep(step, duration)))
        self.one = partial(one, solver)
        self.slopes = jax.jit(jax.jacfwd(twice, argnums=2, has_aux=True))

    @cached_property
    def finer(self) -> "Program":
        """Of shorter steps."""
        return Program(self.name, FINER * self.times, self.rtol)

    def draw(self, number: int, seed: int) -> tuple[Any, Any, np.ndarray]:
        """Return a loop, what it is measured by, and the numbers of both that are differentiated."""
        loop = canonical_dtypes(refine_parts(random_loops.drawn(self.name, number, seed), self.times))
        measures = canonical_dtypes(self.measured)
        self.places = random_loops.numbers(loop, measures)
        x = [_at(loop, measures, path)[place] for path, places in self.places.items() for place in places]
        return loop, measures, np.array(x)

    def along(self, number: int, seed: int) -> np.ndarray:
        """Return the sum of a loop's objectives, and its slope along a random direction in both modes."""
        *parts, x = self.draw(number, seed)
        direction = _sizes(x) * np.random.default_rng(seed).uniform(-1.0, 1.0, len(x))

        def total(x: Any) -> Any:
            return jnp.sum(self.one(*parts, x)[0])

        value, forward = jax.jit(lambda x: jax.jvp(total, (x,), (direction,)))(x)
        return np.array([value, forward, jax.jit(jax.grad(total))(x) @ direction])

    def study(self, number: int, seed: int, widths: Sequence[float] = WIDTHS, slopes: bool = True) -> Found:
        """Gradients and differences of a loop, or differences alone."""
        loop, measures, x = self.draw(number, seed)
        size = _sizes(x)
        moves = [sign * width * np.diag(size) for width in widths for sign in (1, -1)]
        lanes, late = self.values(loop, measures, x + np.concatenate([np.zeros((1, len(x))), *moves]))
        lanes = _compared(lanes)
        sides = lanes[1:].reshape(len(widths), 2, len(x), len(self.objectives)).swapaxes(2, 3)
        names = [path + "".join(f"[{i}]" for i in place) for path, all in self.places.items() for place in all]
        ended = not late[0] or self.structure.objectives is not random_loops.BRAKING
        plain, none = _compared(self.plain(loop, measures, x)[0]), np.zeros((len(lanes[0]), len(x)))
        found = Found(self.name, number, self.objectives, names, lanes[0], none, sides, bool(ended), plain, plain)
        if not slopes:
            return found
        gradient, beside = self.slopes(loop, measures, x)
        return found._replace(gradient=np.asarray(gradient) * size, beside=_compared(beside))

    def revalued(self, found: Found, seed: int) -> Found:
        """The study of a loop, with the objectives that a derivative changes."""
        off = np.abs(found.plain - found.value)
        least = np.maximum(np.abs(found.value), LEAST)
        bound = STEP * least
        if np.any(off > bound):
            finer = self.finer.study(found.number, seed, (), slopes=False)
            bound = np.maximum(LESS * off, bound)
            off = np.where(off > STEP * least, np.abs(finer.plain - finer.value), off)
        off[[name in BY_GRID for name in self.objectives]] = 0.0
        moved = (off > bound) | (np.abs(found.beside - found.value) > SAME * least)
        return found._replace(moved=tuple(np.array(found.objectives)[moved]))


def _sizes(x: np.ndarray) -> np.ndarray:
    """Sizes of numbers, in whose units they move."""
    return np.where(np.abs(x) > 1e-6, np.abs(x), 1e-2)


def _compared(values: Any) -> np.ndarray:
    """Values, with no number where they are infinite: a time that is never reached has no differences."""
    values = np.asarray(values)
    return np.where(np.isinf(values), np.nan, values)


def looked_closer(found: Found, closer: Sequence[Found]) -> Found:
    """The study, with which of its wrong entries are not; `closer` are studies of all widths, at two steps."""
    v = judge(found)
    widths = np.array(WIDTHS + CLOSER)[:, None, None]
    bounds = AGREE * v.scale
    differences = np.stack([(one.sides[:, 0] - one.sides[:, 1]) / (2 * widths) for one in closer])
    same = np.max(np.abs(differences[0] - differences[1]), axis=0) <= bounds
    settled = np.max(np.abs(differences[:, -2] - differences[:, -1]), axis=0) <= bounds
    bent = [np.abs(one.sides[-1].sum(axis=0) - 2 * one.value[:, None]) / CLOSER[-1] for one in closer]
    smooth = np.max(bent, axis=0) <= KINKED * v.scale
    right = np.abs(found.gradient - differences[0][-1]) <= RIGHT * v.scale
    return found._replace(closer=v.wrong & same & settled & smooth & right)


def _at(loop: Any, measures: Any, path: str) -> np.ndarray:
    part, _, own = path.rpartition(":")
    return np.asarray(get(measures[part] if part else loop, own))


def _moved(loop: Any, measures: Any, places: dict[str, Any], x: Any) -> tuple[Any, Any]:
    """Loop and objectives with the numbers x, an array or a list, at their places."""
    new: dict[str, dict[str, Any]] = {}
    start = 0
    for path, all in places.items():
        part, _, own = path.rpartition(":")
        value = jnp.asarray(get(measures[part] if part else loop, own))
        here = x[start : start + len(all)]
        whole = here[0] if value.ndim == 0 else value.at[tuple(np.array(all).T)].set(jnp.asarray(here))
        new.setdefault(part, {})[own] = whole
        start += len(all)
    measures = {name: replace(part, new.get(name, {})) for name, part in measures.items()}
    return replace(loop, new.get("", {})), measures


class Verdict(NamedTuple):
    """What the differences say, by entry (m, n)."""

    difference: np.ndarray  # (widths, m, n)
    scale: np.ndarray
    error: np.ndarray  # of the gradient, in scales, against the narrowest
    agree: np.ndarray  # bool: the widths do
    wrong: np.ndarray  # bool
    zero: np.ndarray  # bool: nothing depends on the number, says everybody
    kind: np.ndarray  # str, of CLASSES where the widths do not agree, else ""
    known: np.ndarray  # bool: a gradient that agrees with what is known where they do not


def judge(found: Found) -> Verdict:
    """Compare the gradients of a loop with its differences."""
    widths = np.array(WIDTHS)[:, None, None]
    right, left = found.sides[:, 0], found.sides[:, 1]
    difference = (right - left) / (2 * widths)
    base = found.value[:, None]
    scale = np.maximum(np.max(np.abs(difference), axis=0), np.maximum(PART * np.abs(base), LEAST))
    spread = np.max(difference, axis=0) - np.min(difference, axis=0)
    slopes = np.stack([(right - base) / widths, (base - left) / widths])
    bend = np.abs(slopes[0] - slopes[1])
    smooth = (bend[-1] <= KINKED * scale) | (bend[-1] <= 0.6 * bend[-2])  # else left and right are two numbers
    agree = (spread <= AGREE * scale) & smooth & ~np.asarray(found.closer)
    error = np.abs(found.gradient - difference[-1]) / scale
    wrong = agree & ~(error <= RIGHT)
    zero = agree & (np.max(np.abs(difference), axis=0) == 0) & (found.gradient == 0)
    least = np.maximum(PART * np.abs(base), LEAST)
    kind, limit = _kinds(difference, slopes, smooth, least)
    kind = np.where(found.closer, "closer", np.where(agree, "", kind))
    off = np.abs(found.gradient - limit) / np.maximum(np.abs(limit), least)
    known = np.isin(kind, ("nearby", "curved")) & (off <= KNOWN)
    return Verdict(difference, scale, error, agree, wrong, zero, kind, known)


def _kinds(difference: Any, slopes: Any, smooth: Any, least: Any) -> tuple[np.ndarray, np.ndarray]:
    """Why the widths do not agree, and the derivative as far as it is known; slopes (2, widths, m, n) to the right and
    to the left."""
    wide, middle, narrow = difference
    scale = np.maximum(np.maximum(np.abs(middle), np.abs(narrow)), least)
    outer, inner = (WIDTHS[0] ** 2 - WIDTHS[1] ** 2), (WIDTHS[1] ** 2 - WIDTHS[2] ** 2)
    square = (wide - middle) / outer
    curved = np.abs((middle - narrow) - square * inner) <= 0.3 * np.abs(square) * inner + 0.2 * AGREE * scale
    beside = np.abs(middle - narrow) <= AGREE * scale
    (_, right, nearest), (_, left, last) = slopes
    stable = np.abs(right - nearest) + np.abs(left - last) <= 0.5 * np.abs(nearest - last)
    jump = np.abs((nearest - last) * WIDTHS[2] - (right - left) * WIDTHS[1]) <= 0.2 * np.abs(right - left) * WIDTHS[1]
    kind = np.select(
        [~np.isfinite(difference).all(axis=0), ~smooth & (stable | jump), curved & smooth, beside & smooth],
        ["diverged", "kink", "curved", "nearby"],
        "scatter",
    )
    extrapolated = narrow - (middle - narrow) / inner * WIDTHS[2] ** 2
    return kind, np.where(kind == "curved", extrapolated, narrow)


def studied(
    name: str, loops: Sequence[int], seed: int, times: int = 1, told: bool = True, rtol: float | None = None
) -> list[Found]:
    """The loops of one structure, compiled once."""
    program, all, begun = Program(name, times, rtol), [], time.monotonic()
    for number in loops:
        found = program.study(number, seed)
        if judge(found).wrong.any():
            finer = Program(name, FINER * times, rtol)
            found = looked_closer(
                found, [one.study(number, seed, WIDTHS + CLOSER, slopes=False) for one in (program, finer)]
            )
        all.append(found if rtol else program.revalued(found, seed))
        if told:
            wrong = len(offenders(all[-1:]))
            print(f"loop {number} ({name}): {wrong} wrong, {time.monotonic() - begun:.0f} s", flush=True)
    return all


def _job(task: tuple[str, list[int], int, int, bool, float | None]) -> list[Found]:
    jax.config.update("jax_enable_x64", True)
    return studied(*task)


def run(
    loops: int, seed: int, jobs: int = 1, names: Sequence[str] | None = None, rtol: float | None = None
) -> list[Found]:
    """So many loops of a seed, a structure after the other, in so many processes."""
    names = list(names or random_loops.STRUCTURES)
    tasks = [
        (name, list(range(i, loops, len(names))), seed, 1, True, rtol) for i, name in enumerate(names) if i < loops
    ]
    if jobs == 1:
        return [found for task in tasks for found in studied(*task)]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        return [found for part in pool.map(_job, tasks) for found in part]


def tally(founds: Iterable[Found], by: str) -> dict[str, Counter[str]]:
    """Counts of entries, by objective or by structure."""
    counts: dict[str, Counter[str]] = {}
    for found in founds:
        v = judge(found)
        for i, objective in enumerate(found.objectives):
            row = counts.setdefault(objective if by == "objective" else found.structure, Counter())
            row["entries"] += v.agree[i].size
            row["zero"] += int(v.zero[i].sum())
            row["compared"] += int((v.agree[i] & ~v.zero[i]).sum())
            row["wrong"] += int(v.wrong[i].sum())
            for kind in CLASSES:
                row[kind] += int((v.kind[i] == kind).sum())
            row["known"] += int(np.isin(v.kind[i], ("nearby", "curved")).sum())
            row["known right"] += int(v.known[i].sum())
    return counts


COLUMNS = ("entries", "zero", "compared", "wrong", *CLASSES)


def table(founds: Sequence[Found], by: str) -> str:
    """The counts as a table."""
    counts = tally(founds, by)
    total = sum(counts.values(), Counter())
    lines = [f"{by:<32}" + "".join(f"{c:>10}" for c in COLUMNS) + "  of nearby and curved, right"]
    for name, row in [*sorted(counts.items()), ("all", total)]:
        known = f"{row['known right']} of {row['known']}"
        lines.append(f"{name:<32}" + "".join(f"{row[c]:>10}" for c in COLUMNS) + f"  {known}")
    return "\n".join(lines)


def offenders(founds: Iterable[Found]) -> list[dict[str, Any]]:
    """Wrong entries, the worst first."""
    rows = []
    for found in founds:
        v = judge(found)
        for i, j in np.argwhere(v.wrong):
            rows.append({
                "loop": found.number,
                "structure": found.structure,
                "objective": found.objectives[i],
                "parameter": found.names[j],
                "value": float(found.value[i]),
                "gradient": float(found.gradient[i, j]),
                "differences": [float(x) for x in v.difference[:, i, j]],
                "error": float(v.error[i, j]),
            })  # fmt: skip
        for objective in found.moved:
            i = found.objectives.index(objective)
            rows.append({
                "loop": found.number,
                "structure": found.structure,
                "objective": objective,
                "parameter": "value",
                "value": float(found.value[i]),
                "gradient": float(found.beside[i]),
                "differences": [float(found.plain[i])],
                "error": float("inf"),
            })  # fmt: skip
    return sorted(rows, key=lambda row: -row["error"] if np.isfinite(row["error"]) else -np.inf)


def line(row: dict[str, Any]) -> str:
    """A wrong entry in a line."""
    differences = ", ".join(f"{x:.6g}" for x in row["differences"])
    if row["parameter"] == "value":
        found = f"{row['value']:.9g}; beside a gradient {row['gradient']:.9g}, without {differences}"
        return f"loop {row['loop']:>3} ({row['structure']}): {row['objective']} = {found}"
    of = f"d {row['objective']} / d {row['parameter']}"
    return f"loop {row['loop']:>3} ({row['structure']}): {of} = {row['gradient']:.6g}; differences {differences}"


def refine(founds: Sequence[Found], seed: int, times: int = 4) -> list[str]:
    """Whether wrong entries are cured by a shorter step: O(h) or O(1), in a line for each loop and objective."""
    lines = []
    bad = {(found.structure, found.number): found for found in founds if judge(found).wrong.any()}
    for name in dict.fromkeys(structure for structure, _ in bad):
        numbers = [number for structure, number in bad if structure == name]
        for fine in studied(name, numbers, seed, times):
            coarse = judge(bad[name, fine.number])
            finer = judge(fine)
            for i, objective in enumerate(fine.objectives):
                where = coarse.wrong[i] & finer.agree[i]
                if where.any():
                    ratio = np.median(finer.error[i][where] / coarse.error[i][where])
                    order = "O(h) or better" if ratio < 0.5 else "O(1)"
                    lines.append(
                        f"loop {fine.number} ({name}), {objective}: {where.sum()} of {coarse.wrong[i].sum()} wrong, "
                        f"error times {ratio:.2g} at a step {times} times shorter: {order}"
                    )
    return lines


def report(founds: Sequence[Found]) -> str:
    """Tables and the worst offenders."""
    wrong = offenders(founds)
    late = [found.number for found in founds if not found.ended]
    lines = [table(founds, "objective"), "", table(founds, "structure"), ""]
    lines += [line(row) for row in wrong[:SHOWN]]
    lines += [f"... and {len(wrong) - SHOWN} more"] if len(wrong) > SHOWN else []
    lines += [f"loops that did not stop in time, or diverged: {late}"] if late else []
    return "\n".join([*lines, f"{len(wrong)} wrong entries in {len(founds)} loops"])


def main() -> int:
    """Exit status 1 if an entry is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", type=int, help="this loop alone")
    parser.add_argument("--structure", help="loops of structures whose name contains this alone")
    parser.add_argument("--rtol", type=float, help="gradients of adaptive steps with this error")
    parser.add_argument("--refine", action="store_true", help="run loops with wrong entries again, with h/4")
    parser.add_argument("--json", help="write the counts and all wrong entries to this file")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    names = list(random_loops.STRUCTURES)
    if asked.only is not None:
        founds = studied(names[asked.only % len(names)], [asked.only], asked.seed, rtol=asked.rtol)
    elif asked.structure:
        chosen = [(i, name) for i, name in enumerate(names) if asked.structure in name]
        founds = [
            f for i, n in chosen for f in studied(n, range(i, asked.loops, len(names)), asked.seed, rtol=asked.rtol)
        ]
    else:
        founds = run(asked.loops, asked.seed, asked.jobs, rtol=asked.rtol)
    print(report(founds))
    if asked.refine:
        print("\n".join(refine(founds, asked.seed)))
    if asked.json:
        counts = {by: tally(founds, by) for by in ("objective", "structure")}
        with open(asked.json, "w", encoding="utf-8") as file:
            json.dump(counts | {"wrong": offenders(founds), "seed": asked.seed, "loops": len(founds)}, file, indent=1)
    return int(bool(offenders(founds)))


if __name__ == "__main__":
    sys.exit(main())
