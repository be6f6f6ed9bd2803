"""jaxonomy: a LeafSystem and its zero crossings under vmap. They are the stop, which ends the run, the peaks of the
slip, whose reset keeps the greatest, and the kinks of torque and |error|, where a major step ends. Dopri5."""

import jax
import jax.numpy as jnp
import jaxonomy
from jaxonomy.backend import ODESolver
from jaxonomy.simulation import Simulator

from peers import on_devices
from peers.jax_scan import rates
from peers.ladder import TOLERANCES
from peers.problem import DURATION, K1, K2, R1, R2, SLIP, STOP, U, holding

TITLE, PACKAGES, MANY = "jaxonomy, Dopri5 with zero crossings", ("jaxonomy", "jax", "jaxlib"), 256
LADDER = TOLERANCES
MAJOR_STEPS = 400


def slip(y):
    """(v - r omega)/v [1]."""
    return 1 - R1 * y[1] / (R2 * y[0])


class Rig(jaxonomy.LeafSystem):
    """The five states, and the greatest slip as a discrete one; mass [kg] is a parameter."""

    def __init__(self, dtype):
        """Declare states, parameter and zero crossings."""
        super().__init__(name="rig")
        self.declare_dynamic_parameter("mass", jnp.ones((), dtype))
        self.declare_continuous_state(default_value=jnp.ones(5, dtype), ode=self.flow)
        self.declare_discrete_state(default_value=jnp.zeros((), dtype))
        falling = "positive_then_non_positive"
        self.declare_zero_crossing(
            lambda t, x, **p: R2 * x.continuous_state[0] - STOP, direction=falling, terminal=True
        )
        self.declare_zero_crossing(self.slip_rate, reset_map=self.keep, direction=falling)
        for kink in (
            self.torque,
            lambda t, x, **p: self.torque(t, x, **p) - U,
            lambda t, x, **p: slip(x.continuous_state) - SLIP,
        ):
            self.declare_zero_crossing(kink)

    def flow(self, t, x, **p):
        """dy/dt."""
        return jnp.stack(rates(x.continuous_state, p["mass"], holding(p["mass"])))

    def torque(self, t, x, **p):
        """Before its limits [N m]."""
        y = x.continuous_state
        return holding(p["mass"]) + K1 * y[2] + K2 * (slip(y) - SLIP)

    def slip_rate(self, t, x, **p):
        """[1/s]."""
        y, d = x.continuous_state, self.flow(t, x, **p)
        return (-R1 * d[1] + (1 - slip(y)) * R2 * d[0]) / (R2 * y[0])

    def keep(self, t, x, **p):
        """The state with the greatest slip so far."""
        return x.with_discrete_state(jnp.maximum(x.discrete_state, slip(x.continuous_state)))


def prepared(masses, speeds, tolerance, dtype, threads):
    """Lanes are dealt to host devices."""
    del threads
    jaxonomy.set_backend("jax")
    rig = Rig(dtype)
    options = jaxonomy.SimulatorOptions(
        math_backend="jax", ode_solver_method="dopri5", rtol=tolerance, atol=1e-2 * tolerance,
        max_major_steps=MAJOR_STEPS, save_time_series=False, return_context=True, precision=dtype,
    )  # fmt: skip
    simulator = Simulator(rig, ode_solver=ODESolver(rig, options=options.ode_options), options=options)
    start = rig.create_context()

    def one(mass, speed):
        zero = jnp.zeros_like(mass)
        y = jnp.stack((speed / R2, speed / R1, zero, zero, zero))
        context = start.with_parameter("mass", mass).with_continuous_state(y).with_time(zero)
        end = simulator.advance_to(zero + DURATION, context).context
        y = end.continuous_state
        return end.time, y[3], end.discrete_state, y[4]

    return on_devices.spread(jax.vmap(one), masses, speeds, dtype)
