"""Conditional integration that does not chatter: against the textbook's law in Filippov's sense, and by hand."""

import jax
import numpy as np
import pytest
import sliding
from mutants import killed_by
from signals import close, seen

import diffabs as d
from diffabs.core.protocols import Clock, Memory, Tracking
from diffabs.loop.admissible import batch_admissibility
from diffabs.parts.controllers import PID, Clamping, Sampled
from diffabs.parts.objectives import IAE

SOLVERS = [d.FixedStep(1e-2, 10.0), d.Adaptive(1e-6, 10.0, 1e-2)]
AT = {"ki": 5.0, "kp": 2.0, "high": 3.0}


def iae(numbers, solver, tracking_time=0.01):
    loop = sliding.limited_pi(Clamping(tracking_time=tracking_time))
    loop = d.replace(loop, {f"controller.{name}": x for name, x in numbers.items()})
    return d.measure(loop, solver, {"iae": IAE()}).metrics["iae"]


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_value_and_derivatives_are_those_of_filippovs_solution(solver):
    """Of order Tt^2: at Tt = 10 ms the value is off by 1.3e-5, and the derivatives by at most 1e-3."""
    value, slopes = iae(AT, solver), jax.jacfwd(lambda at: iae(at, solver))(AT)
    np.testing.assert_allclose(value, sliding.limited_pi_iae(**AT), rtol=3e-5)
    exact = sliding.differences(sliding.limited_pi_iae, AT)
    np.testing.assert_allclose([slopes[name] for name in AT], exact, rtol=2e-3)


@pytest.mark.slow
def test_reverse_mode_and_a_kernel_agree_with_forward_mode():
    solver = d.FixedStep(1e-2, 10.0)
    forward, reverse = (jax.jacfwd, jax.grad)
    each = [mode(lambda at: iae(at, solver))(AT) for mode in (forward, reverse)]
    for name in AT:
        np.testing.assert_allclose(each[1][name], each[0][name], rtol=1e-9)
    loop, batch = sliding.limited_pi(Clamping()), d.Batch({"controller.ki": np.array([4.0, 5.0, 6.0])})
    for engine in ("kernel", "xla"):
        found = d.run_batch(loop, batch, solver, {"iae": IAE()}, engine=engine).metrics["iae"]
        exact = [sliding.limited_pi_iae(ki=ki) for ki in (4.0, 5.0, 6.0)]
        np.testing.assert_allclose(found, exact, rtol=3e-5, err_msg=engine)


@killed_by("parts.controllers.antiwindup", "smaller(0.0 * error, error), larger(0.0 * error, error)", "-1e9, 1e9")
def test_the_rate_lies_between_zero_and_the_error():
    law = Clamping(tracking_time=0.1)
    # error, gain, excess of the output over its limit; I' = e - excess/(gain Tt)
    rows = ((0.5, 20.0, 0.6, 0.2), (0.5, 20.0, 1.1, 0.0), (-0.5, 20.0, 0.6, -0.5), (-0.5, 20.0, -0.6, -0.2),
            (-0.5, -20.0, 0.6, -0.2), (0.5, -20.0, 0.6, 0.5), (0.5, 0.0, 9.0, 0.5), (0.0, 20.0, 0.6, 0.0))  # fmt: skip
    close([law.rate(error, gain, 3.0 + excess, 3.0) for error, gain, excess, _ in rows], [row[-1] for row in rows])


@killed_by("parts.controllers.sampled", "_at_period(self.controller, clock.h).flow", "self.controller.flow")
def test_a_sampled_controller_uses_its_period():
    """With Tt = period, one Euler step puts the output on the limit if that needs between nothing and the whole
    error."""
    pid = PID(kp=1.0, ki=10.0, low=0.0, high=2.0, antiwindup=Clamping(tracking_time=1e-3))
    computer, signal = Sampled(controller=pid, period=0.05), Tracking(1.0, seen(0.5), 0.0)
    memory = Memory(pid.start(signal).flow._replace(integral=np.float64(0.16)))  # 0.1 beyond the limit
    after = computer.compute_sample(Clock(0.0, 0.05, 0, None, True), memory, signal)[0]
    close(after.flow.integral, 0.16 + 0.05 * 0.5 - 0.1 / 10.0)


@killed_by("loop.stability", "jnp.maximum(rates, drain)", "rates")
def test_a_step_too_long_for_the_tracking_time_is_refused():
    loop = sliding.limited_pi(Clamping(tracking_time=0.01))
    with pytest.raises(ValueError, match=r"solver.step = 0.03 s is not stable.*\(0, 0.0278\] s"):
        d.check(loop, d.FixedStep(0.03, 10.0))
    d.check(loop, d.Adaptive(1e-6, 10.0, 0.1))
    values = {"controller.antiwindup.tracking_time": np.array([1e-3, 0.01])}
    assert list(batch_admissibility(loop, values, d.FixedStep(0.01, 10.0)).codes > 0) == [True, False]
