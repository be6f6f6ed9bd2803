"""Slow, obvious second versions: the closed loops as plain NumPy right-hand sides, integrated by SciPy.

Nothing here calls diffabs for physics or control: only the parameters are read from its parts. Equations as printed in
the papers, in the speeds of vehicle and rim; limits by `np.clip`, stop and lock by events.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import PchipInterpolator

import diffabs.parts.roads as roads
from diffabs.parts.plants import LabRig, MirroredRig, QuarterCar

G = 9.81


def friction(road):
    """mu(slip, speed, distance) of a road, for slip >= 0."""
    match road:
        case roads.RationalCurve():
            return lambda s, v, x: (
                road.w4 * s**road.q / (road.a + s**road.q) + np.polyval([road.w3, road.w2, road.w1, 0], s)
            )
        case roads.Burckhardt():
            return lambda s, v, x: (road.c1 * (1 - np.exp(-road.c2 * s)) - road.c3 * s) * np.exp(-road.c4 * s * v)
        case roads.MagicFormula():

            def magic(s, v, x):
                bs = road.B * s
                return road.D * np.sin(road.C * np.arctan(bs - road.E * (bs - np.arctan(bs))))

            return magic
        case roads.Tabulated():
            curve = PchipInterpolator(road.slip, road.mu)
            return lambda s, v, x: float(curve(s))
        case roads.Scaled():
            inner = friction(road.road)
            return lambda s, v, x: road.scale * inner(s, v, x)
    raise TypeError(type(road))


def slip_of(v, w):
    """(v - w)/v when braking."""
    return (v - w) / max(v, w)


def plant_rates(plant):
    """f(v, w, x, extra, u) -> (v', w', extra'): vehicle speed, rim speed of the wheel, the lab rig's brake torque."""
    mu = friction(plant.road)
    if isinstance(plant, QuarterCar):

        def rates(v, w, x, extra, u):  # pyright: ignore[reportRedeclaration]  # of another branch
            m = np.copysign(mu(abs(slip_of(v, w)), v, x), slip_of(v, w))
            spin = (plant.radius * m * plant.mass * G - u) / plant.inertia
            return -m * G, plant.radius * (max(spin, 0) if w <= 0 else spin), 0.0

        return rates
    if isinstance(plant, MirroredRig):
        j2 = plant.inertia_factor * plant.mass * plant.body_radius**2

        def rates(v, w, x, extra, u):
            force = np.copysign(mu(abs(slip_of(v, w)), v, x), slip_of(v, w)) * plant.mass * G
            spin = (force * plant.wheel_radius - u) / plant.wheel_inertia
            return (
                -plant.body_radius * force * plant.body_radius / j2,
                plant.wheel_radius * (max(spin, 0) if w <= 0 else spin),
                0.0,
            )

        return rates
    assert isinstance(plant, LabRig)
    return _lab_rig(plant, mu)


def _lab_rig(p, mu):
    def rates(v, w, x, brake, u):
        w1, w2 = w / p.wheel_radius, v / p.drum_radius
        m = np.copysign(mu(abs(slip_of(v, w)), v, x), slip_of(v, w))
        arm = p.lever * (np.sin(p.lever_angle) - m * np.cos(p.lever_angle))
        if w > 0:
            normal = (p.weight_torque + brake + p.wheel_stiction + p.wheel_friction * w1) / arm
            spin = normal * p.wheel_radius * m - p.wheel_friction * w1 - p.wheel_stiction - brake
        else:
            stuck = p.wheel_radius * m * p.weight_torque / (arm - p.wheel_radius * m)
            held = min(stuck, brake + p.wheel_stiction)
            normal = (p.weight_torque + held) / arm
            spin = max(normal * p.wheel_radius * m - held, 0.0)
        drum = -(normal * p.drum_radius * m + p.drum_friction * w2 + p.drum_stiction) / p.drum_inertia
        asked = p.brake_gain * u + p.brake_offset if u >= p.brake_threshold else 0.0
        return p.drum_radius * drum, p.wheel_radius * spin / p.wheel_inertia, p.brake_rate * (asked - brake)

    return rates


def brake(plant, torque, *, speed, stop, slip=0.0, memory=0, rates=None, duration=30.0, tolerance=1e-12):
    """Integrate until the vehicle has slowed to `stop`; restart where the wheel locks.

    `torque(t, slip, memory)` is the control; `rates(t, slip, memory)` the derivative of a controller's memory of length
    `memory`. Returns time, distance, greatest slip, integral of |slip - 0.2|.
    """
    f = plant_rates(plant)

    def right_hand_side(t, z):
        v, w, x, extra, _, *m = z
        v, w = max(v, 1e-3), max(w, 0.0)  # a trial step may look past the end
        s = slip_of(v, w)
        dv, dw, dextra = f(v, w, x, extra, torque(t, s, m))
        return [dv, dw, v, dextra, abs(s - 0.2), *(rates(t, s, m) if memory and rates else ())]

    def stopped(t, z):
        return z[0] - stop

    def locked(t, z):
        return z[1]

    stopped.terminal = locked.terminal = True
    stopped.direction = locked.direction = -1
    z, t, peak = np.array([speed, (1 - slip) * speed, 0.0, 0.0, 0.0] + [0.0] * memory), 0.0, slip
    for _ in range(50):
        events = (stopped, locked) if z[1] > 0 else (stopped,)
        run = solve_ivp(
            right_hand_side,
            (t, duration),
            z,
            "DOP853",
            events=events,
            rtol=tolerance,
            atol=tolerance,
            dense_output=True,
        )
        grid = np.linspace(run.t[0], run.t[-1], 20001)
        dense = run.sol(grid)
        peak = max(peak, np.max((dense[0] - np.maximum(dense[1], 0)) / np.maximum(dense[0], dense[1])))
        z, t = run.y[:, -1].copy(), run.t[-1]
        if run.status == 0 or run.t_events[0].size:
            break
        z[1] = 0.0
    return {"stop_time": t, "stop_distance": z[2], "max_slip": peak, "iae": z[4]}


def arm_rates(p, torque):
    """x' of the two-wheeler `p` under torque(t, x) [N m]: M q'' = forces - h - G, one 3 by 3 system, written out from
    the equations and not from the code."""
    upper = p.arm_mass + p.rider_mass
    a = p.body_inertia + p.body_mass * p.body_height**2 + upper * p.mount_height**2
    p2, p3 = p.arm_inertia + p.arm_mass * p.arm_length**2, p.rider_inertia + p.rider_mass * p.rider_height**2
    c2 = p.arm_mass * p.mount_height * p.arm_length
    c3 = p.rider_mass * p.mount_height * p.rider_height
    b1 = p.body_mass * p.body_height + upper * p.mount_height
    b2, b3 = p.arm_mass * p.arm_length, p.rider_mass * p.rider_height

    def rates(t, x):
        q1, q2, q3, v1, v2, v3 = x
        m12, m13 = p2 + c2 * np.cos(q2), p3 + c3 * np.cos(q3)
        first = a + p2 + p3 + 2 * c2 * np.cos(q2) + 2 * c3 * np.cos(q3)
        mass = [[first, m12, m13], [m12, p2, 0], [m13, 0, p3]]
        turning = [
            -c2 * np.sin(q2) * (2 * v1 * v2 + v2**2) - c3 * np.sin(q3) * (2 * v1 * v3 + v3**2),
            c2 * np.sin(q2) * v1**2,
            c3 * np.sin(q3) * v1**2,
        ]
        arm, rider = b2 * np.sin(q1 + q2), b3 * np.sin(q1 + q3)
        weight = -p.gravity * np.array([b1 * np.sin(q1) + arm + rider, arm, rider])
        forces = np.array([0, torque(t, x), -p.stiffness * q3 - p.damping * v3])
        return np.concatenate([x[3:], np.linalg.solve(mass, forces - turning - weight)])

    return rates


def arm_stays_up(p, gain, start, voltage, duration=60.0, rest=1e-3):
    """Whether u = clip(K x) brings the two-wheeler from `start` to |x| < rest: DOP853, tolerance 1e-10, ended there or
    on the ground. Raises where it does neither."""

    def torque(t, x):
        u = np.clip(gain @ x, -voltage, voltage)
        return p.torque_constant * (u - p.back_emf * x[4]) / p.resistance - p.friction * x[4]

    def landed(t, x):
        return abs(x[0]) - np.pi / 2

    def resting(t, x):
        return np.linalg.norm(x) - rest

    landed.terminal = resting.terminal = True
    events = (landed, resting)
    run = solve_ivp(arm_rates(p, torque), (0, duration), start, "DOP853", events=events, rtol=1e-10, atol=1e-12)
    if run.status != 1:
        raise AssertionError(f"neither at rest nor on the ground after {duration:g} s: {run.y[:, -1]}")
    return bool(run.t_events[1].size)
