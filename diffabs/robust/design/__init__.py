"""Robust state feedback by linear matrix inequalities, with exact proofs: `design`, `certify` and their data types.

Design and certification need the extra `design` (cvxpy, Clarabel, SciPy). It is loaded when the first program is
solved. Riccati and Lyapunov equations are pure JAX and work without it.
"""

from diffabs.robust.design.analysis import certify as certify
from diffabs.robust.design.parameter_box import polytope as polytope
from diffabs.robust.design.polytopes import Polytope as Polytope
from diffabs.robust.design.polytopes import Schedule as Schedule
from diffabs.robust.design.proof.certificate import Certificate as Certificate
from diffabs.robust.design.proof.certificate import Claim as Claim
from diffabs.robust.design.spec import InputLimit as InputLimit
from diffabs.robust.design.spec import L2Gain as L2Gain
from diffabs.robust.design.spec import Spec as Spec
from diffabs.robust.design.synthesis import Design as Design
from diffabs.robust.design.synthesis import DesignError as DesignError
from diffabs.robust.design.synthesis import design as design
