"""Small robots made in memory: quick to build functions for, and simple enough for closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt import (
    Actuator,
    ContactFriction,
    FixedBase,
    RigidWall,
    Robot,
    Sole,
    SpringDamper,
    Striker,
)
from impactopt.robots.couplings import Coupling, coupled

WALL_STIFFNESS = 2e4  # [N/m] of `on_a_wall`
HALF_SITTING = {"hip pitch": -0.4, "knee": 0.8, "ankle pitch": -0.4}


def _placement(x: float, y: float, z: float) -> Any:
    return pin.SE3(np.eye(3), np.array([x, y, z]))


def _body(mass: float, *size: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
    inertia = pin.Inertia.FromBox(mass, *size)
    return pin.Inertia(mass, np.array(at), inertia.inertia)


def _add(model: Any, parent: int, kind: Any, at: Any, name: str, body: Any) -> int:
    joint = model.addJoint(parent, kind(), _placement(*at), name)
    model.addJointFrame(joint)
    model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return int(joint)


def _mark(model: Any, joint: int, at: tuple[float, float, float], name: str) -> None:
    above = model.getFrameId(model.names[joint])
    model.addFrame(pin.Frame(name, joint, above, _placement(*at), pin.FrameType.OP_FRAME))


# of all joints: quicker than any of them
MOTORS = {
    "*": Actuator(
        stall_torque=250.0, no_load_speed=12.0, viscous_friction=0.2, coulomb_friction=1.0, power_limit=2000.0
    )
}


def biped(
    legs: int = 6,
    *,
    waist: bool = False,
    hinge: str | None = "x",
    followers: Mapping[str, tuple[str, float, float]] | None = None,
) -> Robot:
    """A 40 kg biped: two legs of six joints on box soles and an arm of three; 21 velocities.

    legs : 7: one more in each hip; 5: no ankle roll.  hinge : of soles on legs of five.  waist : two joints
    from the trunk to the hips.  followers : leader, ratio and offset by joint.
    """
    model = pin.Model()
    model.name = "small biped"
    trunk = _body(22.0, 0.2, 0.3, 0.5, at=(0.01, -0.01, 0.25))
    root = _add(model, 0, pin.JointModelFreeFlyer, (0.0, 0.0, 0.0), "root", trunk)
    x, y, z = pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ
    leg: list[tuple[str, Any, tuple[float, float, float], Any]] = [
        ("hip yaw", z, (0.0, 0.1, -0.05), _body(0.5, 0.1, 0.1, 0.1)),
        ("hip roll", x, (0.0, 0.0, -0.02), _body(0.5, 0.1, 0.1, 0.1)),
        ("hip pitch", y, (0.02, 0.0, 0.0), _body(3.0, 0.1, 0.1, 0.35, at=(0.01, 0.0, -0.17))),
        ("knee", y, (0.0, 0.0, -0.35), _body(2.0, 0.08, 0.08, 0.35, at=(0.0, 0.01, -0.16))),
        ("ankle pitch", y, (0.0, 0.0, -0.35), _body(0.4, 0.08, 0.08, 0.08)),
        ("ankle roll", x, (0.0, 0.0, -0.01), _body(1.0, 0.2, 0.1, 0.05, at=(0.03, 0.0, -0.03))),
    ]
    foot = (0.02, 0.0, -0.06)
    if legs == 7:
        leg.insert(0, ("hip tilt", y, leg[0][2], _body(0.5, 0.1, 0.1, 0.1)))
        leg[1] = (*leg[1][:2], (0.0, 0.0, -0.02), leg[1][3])
    elif legs == 5:
        foot, leg[4:] = (0.02, 0.0, -0.07), [(*leg[4][:3], leg[5][3])]
    hips = root
    for name, kind in (("waist yaw", z), ("waist pitch", y)) if waist else ():
        hips = _add(model, hips, kind, (0.0, 0.0, 0.0), name, _body(1.0, 0.1, 0.2, 0.1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        parent = hips
        for name, kind, (a, b, c), body in leg:
            parent = _add(model, parent, kind, (a, sign * b, c), f"{side} {name}", body)
        _mark(model, parent, foot, f"{side} sole")
    parent = root
    for name, kind, at, body in (
        ("shoulder pitch", y, (0.0, -0.2, 0.45), _body(1.0, 0.1, 0.1, 0.1)),
        ("shoulder yaw", z, (0.0, 0.0, 0.0), _body(1.5, 0.3, 0.08, 0.08, at=(0.15, 0.0, 0.0))),
        ("elbow", z, (0.3, 0.0, 0.0), _body(1.2, 0.25, 0.06, 0.06, at=(0.12, 0.0, 0.01))),
    ):
        parent = _add(model, parent, kind, at, name, body)
    _mark(model, parent, (0.3, 0.0, 0.0), "fist")
    laws = {name: Coupling(*law) for name, law in (followers or {}).items()}
    names = [name for name in list(model.names)[2:] if name not in laws]
    angles = {f"{side} {name}": angle for side in ("left", "right") for name, angle in HALF_SITTING.items()}
    angles = {name: angle for name, angle in angles.items() if name in names}
    size: dict[str, Any] = {"length": 0.22, "width": 0.12, "hinge": hinge if legs == 5 else None}
    soles = [Sole.box(name=side, frame=f"{side} sole", **size) for side in ("left", "right")]
    return Robot.from_model(
        coupled(model, laws),
        armature=0.05,
        torque_limit=150.0,
        velocity_limit=6.0,
        # knees do not straighten: there the legs are singular
        position_limit={name: (0.1, 2.2) if "knee" in name else (-2.2, 2.2) for name in names},
        actuators=MOTORS,
        soles=soles,
        strikers=[Striker(name="fist", frame="fist", point=np.array([0.02, 0.0, 0.0]))],
        postures={
            "half_sitting": {**angles, "shoulder pitch": 0.3, "shoulder yaw": -0.7, "elbow": 1.4},
            "upright": {"left knee": 0.1, "right knee": 0.1},
        },
    )


def arm(**options: Any) -> Robot:
    """A fixed arm of four joints, the first of which is continuous."""
    model = pin.Model()
    model.name = "small arm"
    parent = 0
    for name, kind, at, body in (
        ("turn", pin.JointModelRUBZ, (0.0, 0.0, 0.3), _body(3.0, 0.1, 0.1, 0.2)),
        ("shoulder", pin.JointModelRY, (0.0, 0.0, 0.1), _body(2.0, 0.1, 0.1, 0.4, at=(0.0, 0.0, 0.2))),
        ("elbow", pin.JointModelRY, (0.0, 0.0, 0.4), _body(1.5, 0.1, 0.1, 0.3, at=(0.0, 0.0, 0.15))),
        ("wrist", pin.JointModelRY, (0.0, 0.0, 0.3), _body(0.5, 0.1, 0.1, 0.1, at=(0.0, 0.0, 0.05))),
    ):
        parent = _add(model, parent, kind, at, name, body)
    _mark(model, parent, (0.0, 0.0, 0.1), "hand")
    settings = {
        "armature": 0.05,
        "actuators": MOTORS,
        "torque_limit": np.array([60.0, 80.0, 60.0, 40.0]),
        "velocity_limit": 5.0,
        "position_limit": dict.fromkeys(("shoulder", "elbow", "wrist"), (-2.5, 2.5)),
        "strikers": [Striker(name="hand", frame="hand", point=np.zeros(3))],
        "postures": {"start": {"turn": 0.4, "shoulder": 0.3, "elbow": 1.2, "wrist": 0.3}},
        **options,
    }
    return Robot.from_model(model, **settings)


def parallelogram(**options: Any) -> Robot:
    """A fixed planar arm of two motors, whose hand follows the elbow so that it keeps the upper arm's turn;
    and a counterweight that slides as the shoulder turns, on a branch of its own.
    """
    model, free = pin.Model(), {"hand": ("elbow", -1.0, 0.1), "weight": ("shoulder", 0.2, 0.05)}
    model.name = "parallelogram"
    shoulder = _add(model, 0, pin.JointModelRY, (0.0, 0.0, 0.3), "shoulder", _body(3.0, 0.1, 0.1, 0.4))
    elbow = _add(model, shoulder, pin.JointModelRY, (0.0, 0.0, 0.4), "elbow", _body(2.0, 0.1, 0.1, 0.4))
    hand = _add(model, elbow, pin.JointModelRY, (0.0, 0.0, 0.4), "hand", _body(1.0, 0.1, 0.1, 0.1))
    _add(model, shoulder, pin.JointModelPX, (-0.3, 0.0, 0.0), "weight", _body(0.5, 0.05, 0.05, 0.05))
    _mark(model, hand, (0.1, 0.0, 0.05), "tip")
    settings = {
        "armature": 0.05,
        "actuators": MOTORS,
        "torque_limit": np.array([200.0, 100.0]),
        "velocity_limit": 6.0,
        "position_limit": {"shoulder": (-1.5, 1.5), "elbow": (-2.3, 2.3)},
        "strikers": [Striker(name="tip", frame="tip", point=np.zeros(3))],
        "postures": {"start": {"shoulder": -0.6, "elbow": 1.6}},
        **options,
    }
    return Robot.from_model(coupled(model, {name: Coupling(*law) for name, law in free.items()}), **settings)


def slider(mass: float, **options: Any) -> Robot:
    """A point mass [kg] on a horizontal rail along x, fixed base: one prismatic joint, no servo gains."""
    model = pin.Model()
    model.name = "slider"
    _add(model, 0, pin.JointModelPX, (0.0, 0.0, 0.0), "rail", pin.Inertia.FromSphere(mass, 0.05))
    settings = {
        "kp": 0.0,
        "kd": 0.0,
        "torque_limit": 1e4,
        "velocity_limit": 10.0,
        "position_limit": {"rail": (-5.0, 5.0)},
        "strikers": [Striker(name="tip", frame="rail", point=np.zeros(3))],
        **options,
    }
    return Robot.from_model(model, **settings)


def table(mass: float, **options: Any) -> Robot:
    """A mass [kg] on a horizontal table: two prismatic joints, x and y, half of it on each; no servo gains.

    Along x it is a point mass.
    """
    model = pin.Model()
    model.name = "table"
    half = pin.Inertia.FromSphere(mass / 2, 0.05)
    first = _add(model, 0, pin.JointModelPX, (0.0, 0.0, 0.0), "along", half)
    _add(model, first, pin.JointModelPY, (0.0, 0.0, 0.0), "across", half)
    settings = {
        "kp": 0.0,
        "kd": 0.0,
        "torque_limit": 200.0,
        "velocity_limit": 3.0,
        "position_limit": dict.fromkeys(("along", "across"), (-5.0, 5.0)),
        "strikers": [Striker(name="tip", frame="across", point=np.zeros(3))],
        **options,
    }
    return Robot.from_model(model, **settings)


def on_a_wall(kind: Any, friction: ContactFriction | None, damping: float = 0.0, **options: Any) -> Any:
    """Model of a mass of 4 kg along x and 2 kg along y, at a wall across x."""
    return kind(
        robot=table(4.0),
        striker="tip",
        normal=[1.0, 0.0, 0.0],
        law=SpringDamper(stiffness=WALL_STIFFNESS, damping=damping),
        target=RigidWall(),
        stance=FixedBase(),
        contact_friction=friction,
        **options,
    )


def disc(mass: float, radius: float) -> Robot:
    """A disc in the plane, of inertia 0.4 m R^2, that strikes with the point of its rim ahead along x."""
    model = pin.Model()
    model.name = "disc"
    joint = 0
    for kind, name in ((pin.JointModelPX, "x"), (pin.JointModelPY, "y"), (pin.JointModelRZ, "turn")):
        joint = model.addJoint(joint, kind(), pin.SE3.Identity(), name)
        model.addJointFrame(joint)
        light = pin.Inertia(1e-9, np.zeros(3), 1e-12 * np.eye(3))
        model.appendBodyToJoint(joint, light, pin.SE3.Identity())
    body = pin.Inertia(mass, np.zeros(3), 0.4 * mass * radius**2 * np.eye(3))
    model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return Robot.from_model(
        model,
        kp=0.0,
        kd=0.0,
        torque_limit=200.0,
        velocity_limit=50.0,
        position_limit=dict.fromkeys(("x", "y", "turn"), (-5.0, 5.0)),
        strikers=[Striker(name="rim", frame="turn", point=np.array([radius, 0.0, 0.0]))],
    )


def striking_point(robot: Robot, posture: str, striker: str) -> Any:
    """World position (3,) [m] of a striking point in a named posture."""
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, robot.posture(posture))
    return np.array(data.oMf[model.getFrameId(f"striker:{striker}")].translation)
