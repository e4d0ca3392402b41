"""References that small robots follow in replays, and what is known of them in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from impactopt import FreeMass, Robot, SpringDamper
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.stance import support_polygon
from impactopt.simulation import Scene, Simulation, simulate_pinocchio
from support.small_robots import biped, slider

Array = NDArray[np.float64]
NOWHERE = np.array([50.0, 0.0, 0.0])  # a target that is never hit


def scene(striker: str = "striker:tip", **changes: Any) -> Scene:
    settings: dict[str, Any] = {
        "point": NOWHERE,
        "normal": np.array([1.0, 0.0, 0.0]),
        "law": SpringDamper(stiffness=1e4, damping=100.0),
        "target": FreeMass(mass=5.0),
        "striker": striker,
        "soles": (),
        "corners": (),
        "polygon": np.zeros((0, 2)),
    }
    return Scene(**{**settings, **changes})


def reference(
    time: Any, q: Any, v: Any = None, torque: Any = None, *, nv: int, n: int, end: float | None = None
) -> Any:
    k = len(time)
    return SimpleNamespace(
        time=np.asarray(time, dtype=float),
        q=np.broadcast_to(np.asarray(q, dtype=float), (k, np.shape(q)[-1])),
        v=np.zeros((k, nv)) if v is None else np.asarray(v, dtype=float),
        torque=np.zeros((k, n)) if torque is None else np.broadcast_to(torque, (k, n)),
        phase=np.zeros(k, dtype=int),
        contact_start=np.nan,  # known to plans alone
        end=time[-1] if end is None else end,
    )


def strike(
    damping: float,
    *,
    step: float = 1e-4,
    own: float = 6.0,
    mass: float = 5.0,
    rotor: float = 0.0,
    simulate: Callable[..., Simulation] = simulate_pinocchio,
) -> tuple[Simulation, dict[str, float]]:
    """A slider, pushed to 1.2 m/s by its feed-forward and let go, hits a free mass; and the closed form.

    rotor : how much of its own mass is its motor's.

    mu x'' + d x' + k x = 0 with mu = m_a m_t / (m_a + m_t) until x' = 0, then without the damper until x = 0.
    """
    speed, push = 1.2, 0.05
    force = own * speed / push
    robot = slider(own - rotor, armature=rotor)
    ref = reference(
        [0.0, push, push, 0.2], np.zeros(1), torque=[[force], [force], [0.0], [0.0]], nv=1, n=1, end=0.2
    )
    # half a step after a recorded instant: the worst place for an event
    point = np.array([0.5 * speed * push + speed * 0.04 + 0.5 * step * speed, 0.0, 0.0])
    law = SpringDamper(stiffness=1e4, damping=damping)
    there = scene(point=point, law=law, target=FreeMass(mass=mass))
    sim = simulate(robot, ref, there, step=step, settle=0.0)
    k, mu = law.stiffness, own * mass / (own + mass)
    w, zeta = np.sqrt(k / mu), damping / (2 * np.sqrt(k * mu))
    wd = w * np.sqrt(1 - zeta**2)
    turn = np.arctan2(wd, zeta * w) / wd  # the approach ends
    restitution = float(np.exp(-zeta * w * turn))
    t = np.linspace(0, turn, 20001)
    decay = speed * np.exp(-zeta * w * t)
    x, rate = decay * np.sin(wd * t) / wd, decay * (np.cos(wd * t) - zeta * w / wd * np.sin(wd * t))
    exact = {
        "impulse": mu * speed * (1 + restitution),
        "peak": float((k * x + damping * rate).max()),
        "duration": float(turn + np.pi / (2 * w)),
        "speed": speed,
        "own_after": speed - mu * speed * (1 + restitution) / own,
        "start": push + 0.04 + 0.5 * step,
    }
    return sim, exact


def standing(robot: Robot, posture: str = "half_sitting") -> tuple[Any, Scene, Array]:
    """A reference that stands still with its static feed-forward, its scene, and the sole wrenches."""
    q = robot.posture(posture)
    c = StanceCoordinates(robot, robot.soles, q)
    w = static_wrenches(c, *c.split(q))
    tau = (
        pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q) - c.sole_jacobians(q)[0].T @ w
    )
    ref = reference([0.0, 1.0], q, torque=tau[6:], nv=robot.nv, n=robot.n, end=0.05)
    frames = tuple(s.frame for s in robot.soles)
    striker = next(iter(robot.strikers.values())).model_frame
    corners = tuple(s.polygon for s in robot.soles)
    return ref, scene(striker, soles=frames, corners=corners, polygon=support_polygon(robot, c)), w


def standing_on_left() -> tuple[Robot, Any, Scene]:
    """The biped at rest on its left foot, the right one lifted: robot, reference, scene of both soles."""
    robot = biped()
    model, left = robot.model, robot.sole("left")
    q, data = robot.posture("half_sitting"), robot.model.createData()
    frame = model.getFrameId(left.frame)
    pin.framesForwardKinematics(model, data, q)
    foot = data.oMf[frame].copy()
    for name, bend in (("hip pitch", -0.3), ("knee", 0.6), ("ankle pitch", -0.3)):
        q[7 + robot.joint_index(f"right {name}")] += bend
    c = StanceCoordinates(robot, (left,), q)
    y, legs = c.split(q)
    for _ in range(20):
        y[:2] += foot.translation[:2] - np.array(pin.centerOfMass(model, data, c.join(y, legs)))[:2]
        legs = c.solve_legs(y, legs)
    q = c.join(y, legs)
    w = static_wrenches(c, y, legs)
    tau = pin.computeGeneralizedGravity(model, data, q) - c.sole_jacobians(q)[0].T @ w
    ref = reference([0.0, 1.0], q, torque=tau[6:], nv=robot.nv, n=robot.n, end=0.05)
    ref.stance = np.zeros(2, dtype=np.intp)
    there = scene(
        robot.striker("fist").model_frame,
        soles=tuple(s.frame for s in robot.soles),
        corners=tuple(s.polygon for s in robot.soles),
        polygon=support_polygon(robot, c),
        standing=np.array([[True, False]]),
        polygons=(support_polygon(robot, c),),
    )
    return robot, ref, there


def blow_motion() -> tuple[Robot, Any, Scene]:
    """The biped's arm swings against a mass in front of it: robot, reference, scene."""
    robot = biped()
    ref, where, _ = standing(robot)
    time = np.linspace(0, 0.5, 51)
    s = np.clip(time / 0.3, 0, 1)
    blend = 10 * s**3 - 15 * s**4 + 6 * s**5
    joint = [robot.joint_index(name) for name in ("shoulder yaw", "elbow")]
    gap = np.array([0.7, -1.0])
    q, v = np.tile(ref.q[0], (51, 1)), np.zeros((51, robot.nv))
    q[:, 7 + np.array(joint)] += blend[:, None] * gap
    v[:, 6 + np.array(joint)] = np.gradient(blend, time)[:, None] * gap
    motion = reference(time, q, v, ref.torque[0], nv=robot.nv, n=robot.n, end=0.4)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q[20])
    fid = robot.model.getFrameId(where.striker)
    point = np.array(data.oMf[fid].translation)
    jac = pin.computeFrameJacobian(robot.model, data, q[20], fid, pin.LOCAL_WORLD_ALIGNED)[:3]
    speed = jac @ v[20]
    normal = speed / np.linalg.norm(speed)
    there = replace(where, point=point, normal=normal, target=FreeMass(mass=3.0))
    return robot, motion, there


def given_until(sim: Simulation, times: Any) -> Array:
    """Impulse [N s] until each time [s], by the trapezoidal rule from the recorded contact force."""
    time, force = sim.contact_time, sim.contact_force
    return np.asarray(np.interp(times, time, cumulative_trapezoid(force, time, initial=0.0)))
