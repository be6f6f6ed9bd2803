"""The right answers: SciPy's DOP853, restarted wherever the torque meets a limit, on some lanes, and C to a tight
tolerance on all of them. They share no code with diffabs, and only constants with each other; they are compared."""

import itertools

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from peers import c, problem

CHECKED = 16  # lanes by SciPy
AGREE = 1e-6  # relative, between the two: a hundredth of what is asked of the peers
TIGHT = {"setting": 1e-10, "least": 1e-8, "longest": 1e-3}
BY_SCIPY = 512  # lanes that SciPy alone is asked for, where there is no gcc


def rates(y, mass, hold):
    """(dy/dt, slip, its rate, torque before its limits) of y = (omega2, omega1, x1, distance, IAE)."""
    speed = problem.R2 * y[0]
    slip = 1 - problem.R1 * y[1] / speed
    error = slip - problem.SLIP
    torque = hold + problem.K1 * y[2] + problem.K2 * error
    mu = problem.friction(min(max(slip, 1e-9), 1.0))
    body = -2 * problem.G / problem.R2 * mu
    wheel = (mass * problem.G * problem.R1 * mu - min(max(torque, 0.0), problem.U)) / problem.J1
    turning = (-problem.R1 * wheel + (1 - slip) * problem.R2 * body) / speed
    return (body, wheel, error, speed, abs(error)), slip, turning, torque


def by_scipy(mass, speed, tolerance=1e-11):
    """Return the four numbers of one lane: pieces between kinks, the peak where the slip's rate falls through zero."""
    hold, (y, t, peak) = problem.holding(mass), ((speed / problem.R2, speed / problem.R1, 0.0, 0.0, 0.0), 0.0, 0.0)
    margins = (
        lambda t, y: problem.R2 * y[0] - problem.STOP,
        lambda t, y: rates(y, mass, hold)[3],
        lambda t, y: rates(y, mass, hold)[3] - problem.U,
        lambda t, y: rates(y, mass, hold)[1] - problem.SLIP,  # |slip - target| has a kink too
    )
    for margin in margins:
        margin.terminal, margin.direction = True, 0
    options = {"rtol": tolerance, "atol": np.array([1e-9, 1e-9, 1e-13, 1e-11, 1e-13]), "dense_output": True}
    options["max_step"] = 1e-3  # s; a longer step could cross a margin twice, unseen
    while True:
        run = solve_ivp(lambda t, y: rates(y, mass, hold)[0], (t, 5.0), y, "DOP853", events=margins, **options)
        before, t, y = run.y[:, -2], float(run.t[-1]), run.y[:, -1]
        peak = max(peak, highest(run, mass, hold))
        if run.status == 0 or len(run.t_events[0]):
            return t, float(y[3]), peak, float(y[4])
        for margin, times in zip(margins, run.t_events, strict=True):
            if len(times):  # it starts at zero now: only the way back counts
                margin.direction = 1 if margin(t, before) > 0 else -1


def highest(run, mass, hold):
    """Return the greatest slip of a piece: at its end, or where the slip's rate falls through zero."""

    def turning(t):
        return rates(run.sol(t), mass, hold)[2]

    found = [run.t[-1]]
    for left, right in itertools.pairwise(run.t):
        if turning(left) > 0 >= turning(right):
            found.append(brentq(turning, left, right, xtol=1e-14))
    return max(rates(run.sol(t), mass, hold)[1] for t in found)


def answers(masses, speeds):
    """Return ((4, lanes), how far the two references are apart, or None without gcc). Raises RuntimeError if they are
    further apart than AGREE, ValueError for too many lanes without gcc."""
    some = np.unique(np.linspace(0, len(masses) - 1, min(CHECKED, len(masses))).astype(int))
    try:
        found, _ = c.solved("adaptive", masses, speeds, **TIGHT)
    except c.NoCompiler as reason:
        if len(masses) > BY_SCIPY:
            raise ValueError(f"{reason}, so the reference is SciPy's: at most {BY_SCIPY} lanes") from None
        return np.array([by_scipy(*lane) for lane in zip(masses, speeds, strict=True)]).T, None
    oracle = np.array([by_scipy(masses[i], speeds[i]) for i in some]).T
    apart = float(problem.errors(found[:, some], oracle).max())
    if apart > AGREE:
        raise RuntimeError(f"C and SciPy are {apart:.1e} apart, not {AGREE:g}: there is no reference")
    return found, apart
