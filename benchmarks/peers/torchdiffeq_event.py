"""torchdiffeq: dopri5 by `odeint_event`, one lane at a time: the event and the step are those of the whole state. The
slip is seen again around its peak by a second `odeint`."""

import numpy as np
import torch
import torchdiffeq

from peers.ladder import TOLERANCES
from peers.problem import J1, K1, K2, R1, R2, SLIP, STOP, W1, W2, W3, W4, A, G, P, U, holding
from peers.scipy_loop import highest

TITLE, PACKAGES, MANY = "torchdiffeq, odeint_event in a loop", ("torchdiffeq", "torch"), 2
LADDER = TOLERANCES
WINDOW, SAVED = 0.12, 241


def one(mass, speed, tolerance, real):
    """The four numbers of one lane."""
    hold = float(holding(mass))

    def rates(t, y):
        velocity = R2 * y[0]
        error = 1 - R1 * y[1] / velocity - SLIP
        s = torch.clamp(error + SLIP, 1e-6, 1.0)
        power = torch.exp(P * torch.log(s))
        mu = W4 * power / (A + power) + ((W3 * s + W2) * s + W1) * s
        torque = torch.clamp(hold + K1 * y[2] + K2 * error, 0.0, U)
        return torch.stack((-2 * G / R2 * mu, mass * G * R1 / J1 * mu - torque / J1, error, velocity, torch.abs(error)))

    start = torch.tensor([speed / R2, speed / R1, 0.0, 0.0, 0.0], dtype=real)
    zero = torch.tensor(0.0, dtype=real)
    options = {"rtol": tolerance, "atol": 1e-2 * tolerance, "method": "dopri5"}
    t, y = torchdiffeq.odeint_event(rates, start, zero, event_fn=lambda t, y: R2 * y[0] - STOP, **options)
    seen = torchdiffeq.odeint(rates, start, torch.linspace(0, WINDOW, SAVED, dtype=real), **options)
    slips = (1 - R1 * seen[:, 1] / (R2 * seen[:, 0])).numpy()
    return float(t), float(y[-1, 3]), float(highest(slips)), float(y[-1, 4])


def prepared(masses, speeds, tolerance, dtype, threads):
    """Lanes in a Python loop."""
    torch.set_num_threads(threads)
    real = torch.float32 if dtype == "float32" else torch.float64

    def solve():
        with torch.no_grad():
            rows = [one(*lane, tolerance, real) for lane in zip(masses.tolist(), speeds.tolist(), strict=True)]
        return np.array(rows).T

    return solve
