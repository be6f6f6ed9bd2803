"""A controller of the study as difference equations with every parameter, for other programs.

tests/experiments/test_real_rig.py runs these documents in NumPy, from the file alone.
"""

from typing import Any

import numpy as np

from diffabs import Loop, controllers, references
from diffabs.core.pytree import parameters, replace
from experiments.real_rig.box import ESTIMATED, KNOWN, Fixed
from experiments.real_rig.loops import loop

PLANT = {
    "state": "omega1, omega2 [rad/s] of the braked wheel and the body wheel, torque [N m]; (1 - slip0) v0/r1, v0/r2, 0 "
    "at t = 0; no speed becomes negative",
    "speeds": "v = r2 omega2, w = r1 omega1, slip = (v - w)/max(v, w, crawl)",
    "friction": "mu(s) = w4 s^q/(a + s^q) + w3 s^3 + w2 s^2 + w1 s for s >= 0, odd",
    "rates": "omega1' = (m g r1 mu - torque)/J1, omega2' = -(mu g/c)/r2, torque' = (u - torque)/lag",
    "deceleration": "mu g/c",
    "g": "9.81 m/s^2",
    "end": "where v falls to the speed of the stop",
}
WHEEL = (
    "t_k = k h: w_k = quantum round[(w - v n_k)/quantum] (quantum 0: no rounding), n_k normal of deviation slip_noise"
)
SEEN = {
    "DriftingSpeed": [
        "e = last + (first - last) exp(-t/T)",
        "v_k = (1 + e) v, slip_k = (v_k - w_k)/max(v_k, floor)",
    ],
    "SpeedEstimator": [
        "a_k = deceleration + normal of the accelerometer's deviation + bias",
        "k = 0: v_0 = max(w_0, floor), P = (noise v_0)^2, f = 9.81 m/s^2; then",
        "p = max(v_(k-1) - h a_k, floor), P = P + h growth^2, s = (p - w_k)/p, f = max(a_k, f exp(-h/hold))",
        "where s >= gate and f < rest: as for k = 0; else",
        "open = min(max(1 - s/gate, 0), 1), L = open P/(P + (noise p)^2)",
        "v_k = max(p + L (w_k - p), floor), P = (1 - L) P, slip_k = (v_k - w_k)/v_k",
    ],
}
ASKED = {
    "LimitedSlip": [
        "target_(-1) = the first slip as measured without noise",
        "H = h v0/max(v_k, floor)",
        "target_k = target_(k-1) + min[(1 - exp(-H/T)) (slip_ref - target_(k-1)), H rate]",
    ],
    "FilteredSlip": ["T target' = slip_ref - target, continuous, from the first slip as measured without noise"],
    "FixedSlip": ["target_k = slip_ref"],
}
FEEDBACK = [
    "error = slip_k - target_k; x_0 = 0",
    "raw = ff + g (k1 x_k + k2 error), u_k = min(max(raw, low), high)",
    "x_(k+1) = x_k + h [error + (u_k - raw)/(g k1 tracking_time)]; without anti-windup x_k + h error",
]
LAWS = {
    "ProportionalFeedback": ["g = v_k/v0", *FEEDBACK],
    "StateFeedback": ["g = 1", *FEEDBACK],
    "PID": [
        "error = target_k - slip_k; x_0 = d_0 = 0",
        "raw = ff + kp error + ki x_k + kd cutoff (error - d_k), u_k = min(max(raw, low), high)",
        "x_(k+1) = x_k + h [error + (u_k - raw)/(ki tracking_time)], d_(k+1) = d_k + h cutoff (error - d_k)",
    ],
    "SlidingMode": [
        "u_k = min(max(ff + gain min(max((target_k - slip_k)/boundary, -1), 1), low), high)",
    ],
}
HELD = "u = u_k from t_k + delay to t_(k+1) + delay, 0 before the first"


def document(loop: Loop) -> dict[str, Any]:
    """Return equations and parameters of a loop of `loops.py`, SI units."""
    blocks: Any = loop.sensor.blocks  # pyright: ignore[reportAttributeAccessIssue]
    inner: Any = loop.controller.controller  # pyright: ignore[reportAttributeAccessIssue]
    kinds = {"speed": blocks[-1], "reference": loop.reference, "controller": inner}
    return {
        "kinds": {name: type(part).__name__ for name, part in kinds.items()},
        "sensors": [type(block).__name__ for block in blocks],
        "equations": {
            "plant": PLANT,
            "every period h, in this order": [
                WHEEL,
                *SEEN[type(blocks[-1]).__name__],
                *ASKED[type(loop.reference).__name__],
                *LAWS[type(inner).__name__],
            ],
            "held": HELD,
        },
        "parameters": {
            path: {"value": np.asarray(value, float).tolist(), "unit": spec.unit}
            for path, spec, value in parameters(loop)
        },
    }


def loop_of(document: dict[str, Any]) -> Loop:
    """Return the loop of a document for the judgement, with its noises and the quantisation of the wheel's speed."""
    kinds, values = document["kinds"], {path: parameter["value"] for path, parameter in document["parameters"].items()}
    windup = {}
    if any(path.startswith("controller.controller.antiwindup") for path in values):
        windup = {"antiwindup": controllers.BackCalculation()}
    controller = getattr(controllers, kinds["controller"])(**windup)
    speed = ESTIMATED if kinds["speed"] == "SpeedEstimator" else KNOWN
    template = loop(Fixed(), controller, speed, getattr(references, kinds["reference"])())
    return replace(template, {path: np.array(value) for path, value in values.items()})
