"""LQ weights as the parameters of a loop, tuned through the Riccati equation or through the robust design.

    Q = L L',  L lower triangular with diagonal exp(d),   R = exp(rho);   gain = design(Q, R)

The log-Cholesky coordinates (d, the rest of L, rho) describe every positive definite pair and no other pair. The gain
depends on Q/R alone, so rho is usually held fixed. `design` is any differentiable function of (Q, R):

    lqr_gain_design(model)         the LQ regulator of one linear model, by `linear.lqr` or `dlqr`
    robust_gain_design(polytope)   eqs. (29)-(32) of Maeda and Sugiura over a polytope, by `robust_gain`
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.core.pytree import param, part, pytree, replace, static
from diffabs.core.types import AnyArray, Part, PyTree, Scalar, Vector
from diffabs.linear.regulator import dlqr, lqr
from diffabs.linear.weights import as_weight_matrix
from diffabs.loop.closed_loop import Loop
from diffabs.robust.design.interior.differentiable import robust_gain
from diffabs.robust.design.polytopes import Polytope

GainDesign = Callable[[Any, Any], Any]


@pytree
class LQWeights:
    """A loop whose gain at `path` is designed from LQ weights.

    Q (n, n) has the order of the design's states. The first row (n,) of the designed gain replaces the parameter at
    `path`.
    """

    loop: Loop = part(default=Loop)
    log_diagonal: Vector = param(default=(0.0, 0.0), unit="1", free=True)
    """Logarithm d (n,) of the diagonal of L."""
    lower: Vector = param(default=(0.0,), unit="1", free=True)
    """Entries of L below the diagonal, row by row."""
    log_effort: Scalar = param(default=0.0, unit="1")
    """rho = ln R."""
    design: GainDesign = static()
    """Function (Q, R) -> gain."""
    path: str = static(default="controller.gain")
    """Dotted path of the gain in the loop."""

    def problems(self) -> Iterator[str]:
        """Yield a message if `log_diagonal` and `lower` do not have the shapes (n,) and (n (n - 1)/2,)."""
        shapes, n = (np.shape(self.log_diagonal), np.shape(self.lower)), np.size(self.log_diagonal)
        if shapes != ((n,), (n * (n - 1) // 2,)):
            yield f"log_diagonal and lower have shapes {shapes[0]}, {shapes[1]}; n states need (n,), (n (n - 1)/2,)"

    def weights(self) -> tuple[PyTree, PyTree]:
        """Return Q (n, n) and R (1, 1)."""
        n = len(self.log_diagonal)
        diagonal = jnp.exp(jnp.asarray(self.log_diagonal))
        root = jnp.zeros((n, n), diagonal.dtype).at[np.tril_indices(n, -1)].set(jnp.asarray(self.lower))
        root = root + jnp.diag(diagonal)
        return root @ root.T, jnp.exp(jnp.asarray(self.log_effort))[None, None]

    def closed_loop(self) -> Loop:
        """Return the loop with the gain designed from these weights."""
        return replace(self.loop, {self.path: self.design(*self.weights())[0]})


def lq_weights(loop: Loop, Q: AnyArray, R: float, design: GainDesign, path: str = "controller.gain") -> LQWeights:
    """Return a loop with the LQ weights Q and R as its parameters.

    Q (n, n), or its diagonal (n,), is positive definite, and R > 0. `path` is that of the gain in the loop.
    """
    q = as_weight_matrix("Q", Q, len(np.atleast_1d(Q)), definite=True)
    r = as_weight_matrix("R", R, 1, definite=True)
    root = np.linalg.cholesky(q)
    return LQWeights(
        loop=loop,
        log_diagonal=np.log(np.diag(root)),
        lower=root[np.tril_indices(len(q), -1)],
        log_effort=float(np.log(r[0, 0])),
        design=design,
        path=path,
    )


def lqr_gain_design(model: Part) -> GainDesign:
    """Return the function (Q, R) -> LQ gain (1, n) of a linear model, in discrete time if the model has a period."""
    solve, (a, b) = (lqr if model.period is None else dlqr), model.matrices()
    return lambda Q, R: solve(a, b, Q, R).gain


def robust_gain_design(system: Polytope) -> GainDesign:
    """Return the function (Q, R) -> gain (1, n) with the least guaranteed cost over a polytope.

    The gain is NaN for weights without a robust gain; a search rejects such weights.
    """
    return lambda Q, R: robust_gain(system, Q, R)
