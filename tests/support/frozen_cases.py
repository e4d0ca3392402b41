"""Cases and helpers that several tests share: those of `test_sdc.py`."""

from __future__ import annotations

import functools

import numpy as np
import pinocchio as pin

from impactopt import FreeMass, JointFriction, Robot, SpringDamper, Striker, g1, talos

LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=1.0)


X = np.array([1.0, 0.0, 0.0])


# ------------------------------------------------------------ robots and situations
@functools.cache
def robot_named(name):
    return {"talos": talos, "g1": g1, "talos_fixed": lambda: talos(floating=False)}[name]()


def slider(mass):
    """One mass on a prismatic joint along x, with no servo to speak of."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(joint, pin.Inertia(mass, np.zeros(3), 0.1 * np.eye(3)), pin.SE3.Identity())
    model.addFrame(pin.Frame("tip", joint, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
    return Robot.from_model(
        model,
        name="slider",
        armature=0.0,
        kp=0.0,
        kd=0.0,
        torque_limit=1.0,
        velocity_limit=10.0,
        position_limit=[(-10.0, 10.0)],
        strikers=(Striker(name="tip", frame="tip", point=np.zeros(3)),),
    )


def situation(robot, *, seed=0, speed=1.0, soles=None, striker="right_hand", normal=X, moved=18):
    """(q, v, torque): a random posture about half sitting, by the last `moved` velocities, and a motion that
    holds the soles and hits at `speed`."""
    rng = np.random.default_rng(seed)
    soles = robot.soles if soles is None and robot.floating else (soles or ())
    q = robot.posture("half_sitting") if robot.floating else pin.neutral(robot.model)
    dq = np.zeros(robot.nv)
    upper_body = np.arange(robot.nv - moved, robot.nv)
    dq[upper_body] = rng.uniform(-0.3, 0.3, upper_body.size)
    q = pin.integrate(robot.model, q, dq)
    k = Kinematics(robot, q, np.zeros(robot.nv), [s.frame for s in soles], striker, normal)
    rows, wanted = np.vstack([k.Jc, k.j]), np.zeros(len(k.Jc) + 1)
    wanted[-1] = speed
    v = 0.3 * speed * rng.normal(size=robot.nv)
    v += np.linalg.pinv(rows) @ (wanted - rows @ v)
    torque = rng.normal(scale=0.2, size=robot.n) * robot.torque_limit
    return q, v, torque


class Kinematics:
    """Everything about one configuration and velocity, by Pinocchio."""

    def __init__(self, robot, q, v, frames, striker, normal):
        model, data = robot.model, robot.model.createData()
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        hand = model.getFrameId(robot.striker(striker).model_frame)
        ids = [model.getFrameId(frame) for frame in frames]

        def jacobian(i):
            return pin.getFrameJacobian(model, data, i, pin.LOCAL_WORLD_ALIGNED).copy()

        def drift(i):
            return pin.getFrameClassicalAcceleration(model, data, i, pin.LOCAL_WORLD_ALIGNED).vector

        self.Jc = np.vstack([jacobian(i) for i in ids]) if ids else np.zeros((0, model.nv))
        self.gamma = np.concatenate([drift(i) for i in ids]) if ids else np.zeros(0)
        self.j, self.hand_drift = normal @ jacobian(hand)[:3], normal @ drift(hand)[:3]
        self.positions = [data.oMf[i].translation.copy() for i in ids]
        self.hand_position = data.oMf[hand].translation.copy()
        H = pin.crba(model, data, q)
        self.H = np.triu(H) + np.triu(H, 1).T
        self.bias = pin.nonLinearEffects(model, data, q, v).copy()


# ------------------------------------------------------------ closed forms
def two_masses(mass, target, stiffness, damping, speed):
    """Impulse and duration of two free masses: damped oscillator up to the end of compression, then
    undamped."""
    reduced = mass * target / (mass + target)
    a = damping / (2 * reduced)
    root = np.sqrt(complex(a**2 - stiffness / reduced))
    s1, s2 = -a + root, -a - root
    end = (np.log(s2 / s1) / (s1 - s2)).real
    deepest = (speed * (np.exp(s1 * end) - np.exp(s2 * end)) / (s1 - s2)).real
    frequency = np.sqrt(stiffness / reduced)
    return reduced * (speed + frequency * deepest), end + np.pi / (2 * frequency)


FRICTION = JointFriction(viscous=2.0, coulomb=1.5, transition=0.05)


# ------------------------------------------------------------ gradient
# ------------------------------------------------------------ the virtual base
def with_heavy_feet(robot, mass, inertia):
    model = robot.model.copy()
    for sole in robot.soles:
        frame = model.frames[model.getFrameId(sole.frame)]
        heavy = pin.Inertia(mass, np.zeros(3), inertia * np.eye(3))
        model.appendBodyToJoint(frame.parentJoint, heavy, frame.placement)
    return model
