"""LQ weights as the parameters of a loop: tuned through the Riccati equation, or through the robust design itself.

    Q = L L',  L lower triangular with diagonal exp(d),   R = exp(rho);   gain = design(Q, R)

The log-Cholesky coordinates (d, the rest of L, rho) reach every positive definite pair, and nothing else. Only Q/R
matters to the gain, so rho is usually left where it is. `design` is any differentiable function of (Q, R):

    regulator(model)       the LQ regulator of one linear model, by `linear.lqr` or `dlqr`
    robust(polytope)       eqs. (29)-(32) of Maeda and Sugiura over a polytope, by `robust_gain`
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffabs.core.loop import Loop
from diffabs.core.pytree import Scalar, Vector, param, part, pytree, replace, static
from diffabs.design.interior.differentiable import robust_gain
from diffabs.design.polytopes import Polytope
from diffabs.linear.regulator import dlqr, lqr

GainDesign = Callable[[Any, Any], Any]


@pytree
class LQWeights:
    """A loop whose gain, at `path`, is designed from weights. Q (n, n) has the order of the design's states; the gain
    keeps as many of its first numbers as there is room for at `path`."""

    loop: Loop = part(default=Loop)
    log_diagonal: Vector = param(default=(0.0, 0.0), unit="1")
    lower: Vector = param(default=(0.0,), unit="1")
    log_effort: Scalar = param(default=0.0, unit="1")
    design: GainDesign = static()
    path: str = static(default="controller.gain")

    def weights(self) -> tuple[Any, Any]:
        """Q (n, n), R (1, 1)."""
        n = len(self.log_diagonal)
        diagonal = jnp.exp(jnp.asarray(self.log_diagonal))
        root = jnp.zeros((n, n), diagonal.dtype).at[np.tril_indices(n, -1)].set(jnp.asarray(self.lower))
        root = root + jnp.diag(diagonal)
        return root @ root.T, jnp.exp(jnp.asarray(self.log_effort))[None, None]

    def closed(self) -> Loop:
        """The loop with the gain that these weights give."""
        return replace(self.loop, {self.path: self.design(*self.weights())[0]})


def lq_weights(loop: Loop, Q: Any, R: float, design: GainDesign, path: str = "controller.gain") -> LQWeights:
    """A loop with weights Q (n, n) or a diagonal (n,), positive definite, and R > 0 as its parameters.

    Raises:
        ValueError: Q is not positive definite, R is not positive.
    """
    q = np.asarray(Q, float)
    q = np.diag(q) if q.ndim == 1 else q
    if not (np.linalg.eigvalsh(q) > 0).all() or not R > 0:
        raise ValueError(f"Q = {q.tolist()} or R = {R} is not positive definite: it has no logarithm")
    root = np.linalg.cholesky(q)
    return LQWeights(
        loop=loop,
        log_diagonal=np.log(np.diag(root)),
        lower=root[np.tril_indices(len(q), -1)],
        log_effort=float(np.log(R)),
        design=design,
        path=path,
    )


def lqr_gain_design(model: Any) -> GainDesign:
    """The LQ regulator of a linear model (`matrices()`, `period`), in discrete time if the model is."""
    solve, (a, b) = (lqr if model.period is None else dlqr), model.matrices()
    return lambda Q, R: solve(a, b, Q, R).gain


def robust_gain_design(system: Polytope) -> GainDesign:
    """The gain with the least guaranteed cost over a polytope; NaN where there is none: such weights are rejected."""
    return lambda Q, R: robust_gain(system, Q, R)
