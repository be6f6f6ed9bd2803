"""Linear systems in pure JAX: linearisation, sampling, Riccati and Lyapunov equations, LQR, LQG, and stability margins.

Models, equations, regulators and filters work under `jit` and automatic differentiation, and `vmap` solves many systems
at once. Open loops, margins, frequency responses and conversions to python-control are NumPy.
"""

from diffabs.linear.balance_model import BalanceModel as BalanceModel
from diffabs.linear.gaussian import Filter as Filter
from diffabs.linear.gaussian import kalman as kalman
from diffabs.linear.gaussian import lqg as lqg
from diffabs.linear.linearization import StateSpace as StateSpace
from diffabs.linear.linearization import linearize as linearize
from diffabs.linear.lyapunov import discrete_lyapunov as discrete_lyapunov
from diffabs.linear.lyapunov import lyapunov as lyapunov
from diffabs.linear.multivariable_margins import MultivariableMargins as MultivariableMargins
from diffabs.linear.multivariable_margins import ReturnDifference as ReturnDifference
from diffabs.linear.multivariable_margins import multivariable_margins as multivariable_margins
from diffabs.linear.opened_loop import OpenLoop as OpenLoop
from diffabs.linear.opened_loop import open_loop as open_loop
from diffabs.linear.recoverable import recoverable_bound as recoverable_bound
from diffabs.linear.regulator import Regulator as Regulator
from diffabs.linear.regulator import dlqr as dlqr
from diffabs.linear.regulator import lqr as lqr
from diffabs.linear.riccati import Riccati as Riccati
from diffabs.linear.riccati import care as care
from diffabs.linear.riccati import dare as dare
from diffabs.linear.robustness import Band as Band
from diffabs.linear.robustness import band as band
from diffabs.linear.slip_model import Continuous as Continuous
from diffabs.linear.slip_model import LowPass as LowPass
from diffabs.linear.slip_model import Sampling as Sampling
from diffabs.linear.slip_model import SlipModel as SlipModel
from diffabs.linear.stability_margins import Margins as Margins
from diffabs.linear.stability_margins import margins as margins
from diffabs.linear.transfer import Transfer as Transfer
from diffabs.linear.transfer import from_control as from_control
from diffabs.linear.transfer import to_control as to_control
