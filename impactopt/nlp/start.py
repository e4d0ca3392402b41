"""A first iterate: reach to the target by inverse kinematics, strike at a moderate speed, come back."""

from __future__ import annotations

import contextlib

import numpy as np
import pinocchio as pin

from impactopt.coordinates import StanceCoordinates
from impactopt.errors import InputError
from impactopt.motion import CubicSpline, quintic
from impactopt.nlp.layout import Array
from impactopt.nlp.transcription import Transcription
from impactopt.statics import static_wrenches


def strike_rates(
    c: StanceCoordinates, striker: str, y: Array, legs: Array, velocity: Array, *, base: float = 0.3
) -> Array:
    """Least rates ydot (ny,) that give the striking point ``velocity`` (3,) [m/s].

    ``base`` : ease of the base's rates.
    """
    model, data = c.model, c.model.createData()
    fid = model.getFrameId(f"striker:{striker}")

    def point(at: Array) -> Array:
        pin.framesForwardKinematics(model, data, c.join(at, legs))
        return np.array(data.oMf[fid].translation)

    h = 1e-6
    jac = np.stack([(point(y + h * e) - point(y - h * e)) / (2 * h) for e in np.eye(c.ny)], axis=1)
    weight = np.ones(c.ny)
    weight[: c.base] = base
    return np.asarray(weight * np.linalg.lstsq(jac * weight, velocity, rcond=None)[0])


def first_iterate(t: Transcription, *, speed: float = 1.0, noise: float = 0.0, seed: int = 0) -> Array:
    """Solver variables (n,) of a plain reach.

    ``noise`` [rad] perturbs the posture at contact, for several starts.
    """
    p, c = t.problem, t.coordinates
    rng = np.random.default_rng(seed)
    y_hit, legs_hit = c.split(p.contact_posture)
    y_hit[c.base :] += noise * rng.standard_normal(c.ny - c.base)
    y_hit = np.clip(y_hit, t.y_lower, t.y_upper)
    rates = strike_rates(c, p.striker, y_hit, legs_hit, speed * p.normal)
    limit = 0.8 * t.rate_limit[c.independent]
    rates *= min(1.0, float((limit / np.maximum(np.abs(rates[c.base :]), 1e-9)).min()))
    x = np.clip(np.zeros(t.layout.n), t.layout.lower, t.layout.upper)
    zero = np.zeros(c.ny)
    swing_T = float(np.mean(p.swing.duration))
    follow_T = float(np.mean(p.follow.duration))
    swing = quintic(t.y0, zero, y_hit, rates, swing_T, t.swing_breaks)
    curve = CubicSpline.fit(swing, t.swing_breaks, zero, rates, swing_T)
    t.swing_c.write(x, curve.control[3:-1])
    values = quintic(y_hit, 0.5 * rates, t.y0, zero, follow_T, t.follow_breaks)
    back = CubicSpline.fit(values, t.follow_breaks, 0.5 * rates, zero, follow_T)
    for follow in t.follows:
        follow.guess(x, back, t.y0)
    for group, wrench, spline, nodes in (
        (t.swing_legs, t.swing_w, curve, t.swing_nodes),
        *((follow.legs, follow.w, back, t.follow_nodes) for follow in t.follows),
    ):
        legs, all_legs, all_w = t.legs0, [], []
        for y in spline.sample(nodes * spline.duration)[0]:
            with contextlib.suppress(InputError):  # out of the legs' reach: the solver has to mend it
                legs = c.solve_legs(y, legs)
            all_legs.append(np.clip(legs, t.legs_lower, t.legs_upper))
            all_w.append(static_wrenches(c, y, legs))
        if c.legs:
            group.write(x, np.array(all_legs))
            wrench.write(x, np.array(all_w))
    if t.brake is not None and c.legs:
        t.coast_w.write(x, t.swing_w.read(x)[-1:])
    t.swing_T.write(x, swing_T)
    t.u0.write(x, rates)
    for collision in t.collisions:
        collision.guess(x, y_hit, rates, t.swing_legs.read(x)[-1] if c.legs else t.legs0)
    return np.clip(t.with_lifted(x), t.layout.lower, t.layout.upper)
