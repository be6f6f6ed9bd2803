"""Polytopes with two inputs: the quadruple tank with uncertain valves, against a program written out by hand."""

import itertools
import re

import cvxpy as cp
import numpy as np
import pytest
from mutants import killed_by
from project import ROOT

from diffabs.core.pytree import replace
from diffabs.linear import linearize, lqr
from diffabs.parts.plants.quadruple_tank import PumpVoltages, QuadrupleTank, TankLevels
from diffabs.robust.design import InputLimit, L2Gain, Polytope, Spec, certify, design
from diffabs.robust.design.verify import verify_file

LEVELS, PUMPS = TankLevels(0.124, 0.127, 0.018, 0.014), PumpVoltages(3.0, 3.0)
SHARES = tuple(itertools.product((0.65, 0.75), (0.55, 0.65)))
Q, R = np.diag([100.0, 100.0, 1.0, 1.0]), np.diag([0.01, 0.02])
COST, TIME = 5e3, 50.0  # units in which the numbers of the program by hand are near 1


def linear_tank(share_1, share_2):
    return linearize(replace(QuadrupleTank(), {"share_1": share_1, "share_2": share_2}), LEVELS, PUMPS)


def tanks():
    models = [linear_tank(*shares) for shares in SHARES]
    return Polytope(A=[model.A for model in models], B=[model.B for model in models], states=TankLevels._fields)


TANKS = tanks()


def by_hand(system):
    """Return gain and trace Z of the least guaranteed cost."""
    n, m = system.order, system.inputs
    x, z, f = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
    q, r = np.sqrt(Q * TIME / COST), np.sqrt(R * TIME / COST)
    constraints = [cp.bmat([[z, np.eye(n)], [np.eye(n), x]]) >> 0]
    for a, b in zip(system.A, system.B, strict=True):
        flow = TIME * (a @ x + b @ f)
        rows = [[-(flow + flow.T), x @ q, f.T @ r], [q @ x, np.eye(n), np.zeros((n, m))]]
        constraints.append(cp.bmat([*rows, [r @ f, np.zeros((m, n)), np.eye(m)]]) >> 0)
    problem = cp.Problem(cp.Minimize(cp.trace(z)), constraints)
    problem.solve(solver="CLARABEL", tol_gap_rel=1e-9, tol_gap_abs=1e-9, tol_feas=1e-9)
    assert problem.status == "optimal"
    return f.value @ np.linalg.inv(x.value), COST * problem.value


@killed_by("robust.design.sdp.program", 'F{i}": (m, n)', 'F{i}": (1, n)')
def test_one_gain_for_all_valves_is_that_of_the_program_by_hand(tmp_path):
    found = design(TANKS, Spec(Q=Q, R=R))
    gain, trace = by_hand(TANKS)
    np.testing.assert_allclose(found.trace_cost, trace, rtol=1e-6)
    np.testing.assert_allclose(found.gain, gain, atol=1e-3 * np.abs(gain).max())
    assert found.lower_bound < found.trace_cost
    found.certificate.save(tmp_path / "tanks.json")
    verdicts = verify_file(tmp_path / "tanks.json")
    assert [(verdict.kind, verdict.reason) for verdict in verdicts] == [("decay", ""), ("cost", "")]


def test_the_regulator_of_the_middle_is_certified_and_its_negative_disproved():
    gain = np.asarray(lqr(*linear_tank(0.7, 0.6)[:2], Q, R).gain)
    proof = certify(gain, TANKS, Spec(Q=Q, R=R))
    assert proof.quadratically_stable
    assert proof.verified_exactly
    assert proof.guaranteed_cost > design(TANKS, Spec(Q=Q, R=R)).trace_cost
    assert certify(-gain, TANKS).quadratically_stable is False
    with pytest.raises(ValueError, match=r"the gain has shape \(1, 4\); inputs and states of the system need \(2, 4\)"):
        certify(gain[0], TANKS)


SPECIFICATIONS = {
    "decay": {"Q": Q, "R": R, "decay": 0.01},
    "damping": {"Q": Q, "R": R, "damping": 0.8},
    "input": {"Q": Q, "R": R, "input": InputLimit(limit=(1.0, 1.5), points=0.01 * np.eye(4))},
    "l2": {"l2": L2Gain(output=np.eye(4), feedthrough=None)},
}


@pytest.mark.parametrize("kind", SPECIFICATIONS)
def test_each_specification_is_proved_for_two_inputs(kind):
    found = design(TANKS, Spec(**SPECIFICATIONS[kind]))
    assert found.gain.shape == (2, 4)
    assert found.certificate.verified_exactly
    assert kind in {claim.kind for claim in found.certificate.claims}


@pytest.mark.parametrize("period", [None, 5.0])
def test_tanks_without_coupling_are_two_designs(period):
    """Two tanks with a pump each in one system: gains and costs are those of both alone."""
    flow, pump = np.array([[-0.016], [-0.011]]), np.array([[7.7e-4], [5.8e-4]])
    if period:
        flow, pump = np.exp(flow * period), np.expm1(flow * period) / flow * pump
    weights, efforts = (100.0, 70.0), (0.01, 0.02)
    spread = (0.8, 1.2)  # of a pump's flow
    alone = [
        design(
            Polytope(A=[[flow[i]]] * 2, B=[[factor * pump[i]] for factor in spread], period=period),
            Spec(Q=weights[i : i + 1], R=efforts[i]),
        )
        for i in range(2)
    ]
    both = Polytope(
        A=[np.diag(flow[:, 0])] * 4,
        B=[np.diag(np.array(factors) * pump[:, 0]) for factors in itertools.product(spread, spread)],
        period=period,
    )
    found = design(both, Spec(Q=weights, R=efforts))
    np.testing.assert_allclose(found.trace_cost, sum(one.trace_cost for one in alone), rtol=1e-5)
    gains = np.diag([one.gain[0, 0] for one in alone])
    np.testing.assert_allclose(found.gain, gains, atol=1e-3 * np.abs(gains).max())


def test_the_design_of_the_page():
    page = (ROOT / "docs/plant-with-two-inputs.md").read_text()
    scope: dict = {}
    exec(re.search(r"```python\n(import numpy as np\n.*?design\(.*?)```", page, re.DOTALL)[1], scope)
    np.testing.assert_allclose(scope["robust"].gain, design(TANKS, Spec(Q=Q, R=R)).gain, rtol=1e-6)
