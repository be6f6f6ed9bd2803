"""Random loops and fields, differentiated through kernels in many nestings of JAX's transformations.

A nesting is a function of f, of rows X (rows, n) and of a count k: the Jacobians of f at each row, (rows, m, n). From
the column k on, all rows have the same numbers, which a nesting may share between the runs. The first column is the
number of a row: the numbers that are not differentiated are those of this random loop or field.

Each Jacobian is compared with XLA's (`engine="xla"`, forward mode) and with differences of values at three widths, as
`gradients_random.judge` judges them. A row whose value is NaN has the derivative NaN."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import random_fields
import random_loops
from gradients_random import SURE, WIDTHS, Found, _at, _moved, judge

import diffabs as d
from diffabs.core.pytree import canonical_dtypes
from diffabs.loop.run import run_unchecked

SAME = 1e-5  # of the scale: Jacobians of two engines
INPUTS, OBJECTIVES = 7, 4  # numbers that are differentiated, and objectives: each costs time to compile


def sums(f):
    """The sum over rows of an entry i of f: its gradient has the i-th row of each Jacobian."""
    return lambda X, i: jnp.sum(jax.vmap(f)(X)[:, i])


def rows_of(f, X):
    return jnp.arange(len(jax.eval_shape(f, X[0])))


def by_rows(f, X, row):
    """Jacobians (rows, m, n) of a function that returns those of entry i, (rows, n)."""
    return jnp.stack([row(i) for i in rows_of(f, X)], 1)


def vjp_of_vmap(f, X, k):
    values, pull = jax.vjp(jax.vmap(f), X)
    return by_rows(f, X, lambda i: pull(jnp.zeros_like(values).at[:, i].set(1))[0])


def linearized(f, X, k):
    _, push = jax.linearize(jax.vmap(f), X)
    return jnp.moveaxis(jax.vmap(lambda e: push(jnp.broadcast_to(e, X.shape)))(jnp.eye(X.shape[1])), 0, -1)


def transposed(f, X, k):
    values, push = jax.linearize(jax.jit(jax.vmap(f)), X)
    pull = jax.linear_transpose(push, X)
    return by_rows(f, X, lambda i: pull(jnp.zeros_like(values).at[:, i].set(1))[0])


def jvp_in_map(f, X, k):
    def column(e):
        return jax.jvp(jax.vmap(f), (X,), (jnp.broadcast_to(e, X.shape),))[1]

    return jnp.moveaxis(jax.lax.map(column, jnp.eye(X.shape[1], dtype=X.dtype)), 0, -1)


def grad_in_scan(f, X, k):
    _, rows = jax.lax.scan(lambda _, i: (_, jax.grad(sums(f))(X, i)), 0, rows_of(f, X))
    return jnp.swapaxes(rows, 0, 1)


def vmapped_grads_with_aux(f, X, k):
    def entry(X, i):
        values = jax.vmap(f)(X)
        return jnp.sum(values[:, i]), values

    (_, _), rows = jax.vmap(jax.value_and_grad(entry, has_aux=True), (None, 0))(X, rows_of(f, X))
    return jnp.swapaxes(rows, 0, 1)


def shared(mode, f, X, k):
    """The numbers from k on are one vector, which all runs share."""

    def total(own, common):
        return jax.vmap(lambda x: f(jnp.concatenate([x, common])))(own)

    own, common = mode(total, (0, 1))(X[:, :k], X[0, k:])
    rows = jnp.arange(len(X))
    assert_zero(jnp.where((rows[:, None] == rows)[:, None, :, None], 0.0, own), jnp.isnan(own).any())
    return jnp.concatenate([own[rows, :, rows], common], -1)


def assert_zero(x, unless):
    """No run has a derivative by the numbers of another one."""
    if not isinstance(x, jax.core.Tracer) and not unless:
        np.testing.assert_array_equal(x, 0.0)


def of_pytree(f, X, k):
    tree = {"own": [X[:, i] for i in range(k)], "rest": (X[:, k:],)}

    def value(tree):
        return f(jnp.concatenate([jnp.stack(tree["own"]), *tree["rest"]]))

    J = jax.vmap(jax.jacrev(value))(tree)
    return jnp.concatenate([jnp.stack(J["own"], -1), *J["rest"]], -1)


def stopped(f, X, k):
    held = jax.lax.stop_gradient
    first = jax.vmap(jax.jacrev(lambda x: f(x.at[k:].set(held(x[k:])))))(X)
    second = jax.vmap(jax.jacfwd(lambda x: f(x.at[:k].set(held(x[:k])))))(X)
    return first + second


def through_map(f, X, k):
    rows = jnp.arange(len(X))
    return jax.jacrev(lambda X: jax.lax.map(f, X))(X)[rows, :, rows]


def through_map_in_batches(f, X, k):
    return by_rows(f, X, lambda i: jax.grad(lambda X: jnp.sum(jax.lax.map(f, X, batch_size=2)[:, i]))(X))


def through_scan(f, X, k):
    def total(X, weights):
        return jax.lax.scan(lambda sum, x: (sum + jnp.dot(weights, f(x)), None), 0.0 * X[0, 0], X)[0]

    return jax.vmap(jax.grad(total), (None, 0), 1)(X, jnp.eye(len(rows_of(f, X)), dtype=X.dtype))


def through_fori(f, X, k):
    def twice(x):
        return jax.lax.fori_loop(0, 2, lambda i, sum: sum + 0.5 * f(x), 0.0 * f(x))

    return jax.vmap(jax.jacfwd(twice))(X)


def through_cond(f, X, k):
    return jax.vmap(jax.jacrev(lambda x: jax.lax.cond(x[0] < jnp.inf, f, lambda x: 0.0 * f(x), x)))(X)


def in_axes(f, X, k):
    return jnp.transpose(jax.vmap(jax.jacfwd(f), 1, 2)(X.T), (2, 0, 1))


def nested_vmaps(f, X, k):
    grads = jax.vmap(jax.grad(lambda x, i: f(x)[i]), (None, 0))
    return jax.vmap(grads, (0, None))(X, rows_of(f, X))


def doubled(f, X, k):
    """Two more levels of runs: every row with each of two scales of the shared numbers, the second one 1."""

    def value(x, scale):
        return f(jnp.concatenate([x[:k], scale * x[k:]]))

    all = jax.vmap(jax.vmap(jax.jacrev(value), (None, 0)), (0, None))(X, jnp.array([1.01, 1.0], X.dtype))
    return all[:, 1]


NESTINGS: dict[str, Callable[..., Any]] = {
    "vmap jacfwd": lambda f, X, k: jax.vmap(jax.jacfwd(f))(X),
    "vmap jacrev": lambda f, X, k: jax.vmap(jax.jacrev(f))(X),
    "jit vmap jit jacrev jit": lambda f, X, k: jax.jit(jax.vmap(jax.jit(jax.jacrev(jax.jit(f)))))(X),
    "vjp of a vmap": vjp_of_vmap,
    "linearize of a vmap": linearized,
    "linear_transpose": transposed,
    "jvp in a map": jvp_in_map,
    "grad in a scan": grad_in_scan,
    "vmap value_and_grad": vmapped_grads_with_aux,
    "shared, jacrev": partial(shared, jax.jacrev),
    "shared, jacfwd": partial(shared, jax.jacfwd),
    "pytree": of_pytree,
    "stop_gradient": stopped,
    "jacrev of a map": through_map,
    "grad of a map in batches": through_map_in_batches,
    "grad of a scan": through_scan,
    "jacfwd of a fori_loop": through_fori,
    "jacrev of a cond": through_cond,
    "in_axes, out_axes": in_axes,
    "vmap vmap grad": nested_vmaps,
    "vmap vmap jacrev": doubled,
    "checkpoint": lambda f, X, k: jax.vmap(jax.jacrev(jax.checkpoint(f)))(X),
    "row by row": lambda f, X, k: jnp.stack([jax.jit(jax.jacrev(f))(x) for x in X]),
}


class Case(NamedTuple):
    """A function by engine, of the numbers of one run; its rows, and the runs that the differences are of."""

    name: str
    function: Callable[[str], Callable[[Any], Any]]
    exact: Callable[[Any], Any]
    rows: np.ndarray
    shared: int


def loop_case(name: str, seed: int, rows: int, adaptive: bool = False) -> Case:
    """Loops of a structure of `random_loops`."""
    structure = random_loops.STRUCTURES[name]
    step, duration = structure.step, structure.duration
    measured = dict(structure.objectives)
    if adaptive:
        exact, solver = d.Adaptive(SURE, duration, step), d.Adaptive(1e-6, duration, step)
        if "delay" in name:
            del measured["variation"]  # has no derivative there
    else:
        exact = solver = d.FixedStep(step, duration, kinks=True)
    loop = canonical_dtypes(random_loops.drawn(name, 0, seed))
    measures = canonical_dtypes(measured)
    places = random_loops.numbers(loop, measures)
    columns = [(path, place) for path, all in places.items() for place in all]
    rows_ = [canonical_dtypes(random_loops.drawn(name, number, seed)) for number in range(rows)]
    table = np.array([[_at(loop, measures, path)[place] for path, place in columns] for loop in rows_])
    rng = np.random.default_rng([seed, rows])
    chosen = rng.choice(len(columns), min(INPUTS, len(columns)), replace=False)
    names = list(rng.choice(list(measured), min(OBJECTIVES, len(measured)), replace=False))
    X = np.concatenate([np.arange(rows)[:, None], table[:, chosen]], 1)
    k = 3 * X.shape[1] // 4
    X[:, k:] = X[0, k:]

    def value(engine: str, solver: Any, x: Any) -> Any:
        number = jnp.round(jax.lax.stop_gradient(x[0])).astype(int)
        rest = jnp.asarray(table, x.dtype)[number]
        all = [rest[i] for i in range(len(columns))]
        for i, place in enumerate(chosen):
            all[place] = x[1 + i]
        moved, measures_ = _moved(loop, measures, places, all)
        measures_ = {name: measures_[name] for name in names}
        if engine == "xla":
            run = run_unchecked(moved, solver, measures_, jax.random.key(3), 0, "xla")
        else:
            run = d.measure(moved, solver, measures_, key=jax.random.key(3))
        return jnp.stack([run.metrics[one] for one in names])

    return Case(name, lambda engine: partial(value, engine, solver), partial(value, "auto", exact), X, k)


def field_case(shape: int, seed: int, rows: int, adaptive: bool = False, dtype: Any = float) -> Case:
    """Fields of a shape of `random_fields`: the state at the end and on the way, by some of their numbers."""
    n, switches, events = random_fields.SHAPES[shape]
    rng = np.random.default_rng([seed, shape])
    drawn = [random_fields.draw(rng, n, switches, events) for _ in range(rows)]
    names, size = [], 0
    for name in rng.permutation(sorted(drawn[0])):
        if size + drawn[0][name].size <= INPUTS:
            names.append(name)
            size += drawn[0][name].size
    counts = np.cumsum([1, *(drawn[0][name].size for name in names)])
    rest = {name: np.stack([p[name] for p in drawn]) for name in drawn[0] if name not in names}
    X = np.array([np.concatenate([[i], *(p[name].ravel() for name in names)]) for i, p in enumerate(drawn)], dtype)
    k = 3 * X.shape[1] // 4
    X[:, k:] = X[0, k:]
    end = random_fields.END
    event_list = random_fields.build_events(events)
    exact = solver = d.FixedStep(0.01)
    if adaptive:
        exact, solver = d.Adaptive(SURE), d.Adaptive(1e-6)

    def value(engine: str, solver: Any, x: Any) -> Any:
        number = jnp.round(jax.lax.stop_gradient(x[0])).astype(int)
        parts = jnp.split(x, counts[:-1])[1:]
        p = {name: jnp.asarray(all, x.dtype)[number] for name, all in rest.items()}
        p |= {name: part.reshape(drawn[0][name].shape) for name, part in zip(names, parts, strict=True)}
        zero = np.zeros((), x.dtype)
        found = d.solve(
            random_fields.field,
            p["y"],
            zero,
            np.asarray(end, x.dtype),
            p,
            solver=solver,
            events=event_list,
            save=np.array([1.0, end], x.dtype),
            engine=engine,
        )
        return found.y.ravel()

    return Case(
        f"field {random_fields.SHAPES[shape]}",
        lambda engine: partial(value, engine, solver),
        partial(value, "auto", exact),
        X,
        k,
    )


class Differences(NamedTuple):
    """Values (rows, m), sizes of the numbers (rows, n), and values beside them (rows, widths, 2, m, n)."""

    values: np.ndarray
    size: np.ndarray
    sides: np.ndarray


def find_differences(case: Case) -> Differences:
    """Values and differences of the rows; an infinite value, a time that is never reached, has no differences."""
    X = case.rows
    size = np.where(np.abs(X) > 1e-6, np.abs(X), 1e-2)
    moves = [sign * width for width in WIDTHS for sign in (1, -1)]
    lanes = [x + move * np.diag(s) for x, s in zip(X, size, strict=True) for move in moves]
    found = np.asarray(jax.jit(jax.vmap(case.exact))(np.concatenate([X, *lanes])))
    n, m = X.shape[1], found.shape[1]
    sides = found[len(X) :].reshape(len(X), len(WIDTHS), 2, n, m).swapaxes(-1, -2)
    return Differences(found[: len(X)], size, np.where(np.isinf(sides), np.nan, sides))


def find_xla_jacobians(case: Case) -> np.ndarray:
    """Jacobians of the rows by XLA in forward mode, (rows, m, n)."""
    return np.asarray(jax.jit(jax.vmap(jax.jacfwd(case.function("xla"))))(case.rows))


class Score(NamedTuple):
    """Counts of entries.

    Attributes:
        compared: Entries of which the differences say something.
        wrong: Those that disagree with the differences.
        unlike: Entries that disagree with XLA.
        lost: Entries of a value that is NaN which are numbers.
    """

    compared: int
    wrong: int
    unlike: int
    lost: int


def score(case: Case, nesting: str, differences: Differences, by_xla: np.ndarray | None = None) -> Score:
    """Differentiate a case through a kernel in a nesting, and compare."""
    finite = np.isfinite(differences.values)
    rows = finite.all(1) if nesting.startswith("shared") else np.ones(len(finite), bool)  # a NaN is in every sum
    values, size, sides = (x[rows] for x in differences)
    X, finite = case.rows[rows], finite[rows]
    J = np.asarray(NESTINGS[nesting](case.function("auto"), jnp.asarray(X), case.shared), float)
    lost = np.isnan(values)[:, :, None] & ~np.isnan(J) & (np.arange(X.shape[1]) > 0)
    unlike = np.zeros_like(lost)
    if by_xla is not None:
        expected = by_xla[rows]
        scale = np.maximum(np.abs(expected) * size[:, None], np.maximum(1e-3 * np.abs(values[:, :, None]), 1e-6))
        off = np.abs(J - expected) * size[:, None] / scale
        unlike = finite[:, :, None] & ~(off <= SAME) & ~(np.isnan(J) & np.isnan(expected))
    verdicts = [
        judge(Found("", 0, [], [], value, slope, near, True, value, value))
        for value, slope, near in zip(values, J * size[:, None], sides, strict=True)
    ]
    compared = sum(int((v.agree & ~v.zero).sum()) for v in verdicts)
    return Score(compared, sum(int(v.wrong.sum()) for v in verdicts), int(unlike.sum()), int(lost.sum()))
