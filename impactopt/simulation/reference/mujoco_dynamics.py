"""Full dynamics of a collision in MuJoCo: a second opinion, from other algorithms and another integrator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from impactopt.collision.interface import Collision
from impactopt.contact.friction import ContactFriction
from impactopt.errors import InputError
from impactopt.robots.robot import Robot
from impactopt.simulation.mujoco_world import (
    MujocoOptions,
    MujocoRobot,
    Welds,
    add_welds,
    mujoco_module,
    no_log_file,
    robot_bodies,
    spec_of,
)
from impactopt.simulation.pinocchio_robot import DenseBody
from impactopt.simulation.reference.base import Forces, Phase, ReferenceModel, converge
from impactopt.simulation.reference.equations_of_motion import Instant, Scales, collision_from, contact_scales

__all__ = ["HeldRobot", "MujocoDynamics", "march"]

Array = NDArray[np.float64]
_RECORD = 5e-5  # [s] between instants that are kept
# step times the contact's fastest rate, with which it begins; times they are halved; steps of a run
_RESOLVED, _LEVELS, _MOST_STEPS = 0.02, 9, 300_000


@dataclass(frozen=True, kw_only=True, eq=False)
class MujocoDynamics(ReferenceModel):
    """A robot hits a target, in MuJoCo.

    The constrained frames are welded to the world, as hard as MuJoCo lets them be: their time constant is two
    steps, so that they get rigid as the step goes to zero. Servo, friction and contact act as applied forces,
    in MuJoCo's semi-implicit Euler steps. All this is of first order in the step: steps that resolve the
    servo and the contact are halved until impulse, energy and velocity, extrapolated to steps without length
    from the two shortest, are found. The histories, and the rest, are those of the shortest steps. The
    contact's end is found to within a step.

    Attributes
    ----------
    friction : of the joints.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    step : [s] the longest that it begins with.
    tolerance : relative, of the impulse.

    Raises
    ------
    InputError : as of `CollisionModel`; MuJoCo is not installed; a virtual base, which this has not; gains of
        a wrong shape or sign; a step or a tolerance that is not positive; in `collide`, a contact that takes
        too many steps.
    """

    step: float = 4e-5
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        mujoco_module()
        if np.any(self.held_by.compliance):
            raise InputError(
                "MujocoDynamics holds soles exactly only: take FullDynamics for a virtual base, or a stance "
                "without base_mass and base_inertia"
            )

    def _controlled(
        self, q: Array, v: Array, forces: Forces, normal: Array, tolerance: float
    ) -> tuple[Collision, float]:
        body = DenseBody(*self._held, normal, self.contact_friction)
        rate = body.update(q, v) - forces.target_speed(np.zeros(forces.target.n_states))
        scales = contact_scales(body, forces, rate, self.horizon)
        damping = np.diag(forces.kd) if forces.kd.ndim == 1 else forces.kd
        fastest = body.fastest_rate(damping + np.diag(forces.viscous + forces.coulomb / forces.transition))
        step = min(self.step, 1 / fastest) if fastest > 0 else self.step
        first = None
        while first is None:
            try:
                first = self._run(step, q, v, forces, normal, scales)
            except _NotResolved as contact:
                step = min(step / 2, _RESOLVED / contact.rate)
        coarse = first

        def at(level: int) -> Collision:
            return self._run(step / 2**level, q, v, forces, normal) if level else coarse

        return converge(at, tolerance, levels=_LEVELS, better=_extrapolated)

    def _run(
        self, step: float, q: Array, v: Array, forces: Forces, normal: Array, scales: Scales | None = None
    ) -> Collision:
        robot, frames, _, striker = self._held
        with no_log_file():
            world = HeldRobot(robot, frames, striker, step, self.contact_friction)
            world.start(q, v)
            soles = len(self.held_by.sole_names(robot))
            return march(world, forces, normal, self.horizon, soles, scales)


def _extrapolated(fine: Collision, coarse: Collision) -> Collision:
    return replace(
        fine,
        impulse=2 * fine.impulse - coarse.impulse,
        energy=2 * fine.energy - coarse.energy,
        velocity=2 * fine.velocity - coarse.velocity,
    )


class HeldRobot(MujocoRobot):
    """The robot with frames that are welded to where `start` finds them."""

    def __init__(
        self,
        robot: Robot,
        frames: tuple[str, ...],
        striker: str,
        step: float,
        friction: ContactFriction | None = None,
    ) -> None:
        mujoco, self.step = mujoco_module(), step
        spec = spec_of(robot, MujocoOptions(step, iterations=50, tolerance=0.0))
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        bodies = robot_bodies(mujoco, spec, robot)
        add_welds(spec, bodies, robot, frames, step)
        if striker not in frames:
            frame = robot.model.frames[robot.model.getFrameId(striker)]
            bodies[frame.parentJoint].add_site(name=striker, pos=frame.placement.translation)
        super().__init__(robot, spec.compile(), striker, friction=friction)
        self.welds = Welds(self.world, frames)

    def start(self, q: Array, v: Array) -> None:
        """Configuration and velocity at contact; the welds hold what they find."""
        self.put(q, v)
        self.mujoco.mj_kinematics(self.world, self.data)
        self.welds.put(self.data)

    def wrenches(self) -> tuple[Array, Array]:
        """Wrenches of the ground on the welded frames (6 a frame), and their places, at the last step's
        start.
        """
        found, places = self.welds.wrenches(self.data)
        return found.ravel(), places


class _NotResolved(Exception):
    """Steps are too long for the contact, which changes at a rate of [1/s]."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate


def march(
    world: HeldRobot,
    forces: Forces,
    normal: Array,
    horizon: float,
    soles: int,
    scales: Scales | None = None,
) -> Collision:
    """The collision in the world's steps.

    scales : of the contact; None: steps that do not resolve it are taken as they are.
    """
    data, step = world.data, world.step
    every = max(1, round(_RECORD / step))
    instants: list[Instant] = []
    impulse = travel = peak = 0.0
    target = np.zeros(forces.target.n_states)
    angles = data.qpos[world.qpos_index].copy()
    k = 0
    while True:
        world.mujoco.mj_step1(world.world, data)
        speed = float(world.speeds_along(normal)[0])
        if k == 0:
            start = float(normal @ world.striking_points()[0])
        if not np.isfinite(data.qacc_warmstart).all() or not np.isfinite(speed):
            raise InputError(f"step [s]: {step:g} is unstable here; give MujocoDynamics a shorter one")
        if k > _MOST_STEPS:
            raise InputError(
                f"the contact is too fast to follow in MuJoCo: it takes steps of {step:.2g} s, and is not "
                f"over after {_MOST_STEPS} of them; give a softer law or a heavier target, or take "
                "FullDynamics"
            )
        time, velocity = k * step, data.qvel[world.dof].copy()
        target_speed = forces.target_speed(target)
        rate = speed - target_speed
        depth = float(normal @ world.striking_points()[0]) - start - travel
        demand = forces.demand(time, data.qpos[world.qpos_index] - angles, velocity)
        phase: Phase = forces.phase(demand, velocity, depth, rate, target)
        force = forces.contact(depth, rate, phase.compressing) if phase.touching else 0.0
        if scales is not None and phase.touching:
            fastest = _fastest(forces, depth, rate, phase.compressing, scales)
            if fastest * step > 2 * _RESOLVED:
                raise _NotResolved(fastest)
        torque = forces.torque(demand, phase)
        # hand and target that neither approach nor part: the next step decides
        ends = (not phase.touching and (k > 0 or rate != 0)) or time >= horizon * (1 - 1e-9)
        if ends:
            end = world.state()
        world.apply(torque - forces.friction(velocity, phase), force)
        world.mujoco.mj_step2(world.world, data)
        peak = max(peak, force)
        if ends or k % every == 0:
            held = world.wrenches()
            instants.append(Instant(time, force, depth, speed, target_speed, velocity, torque, demand, *held))
        if ends:
            return collision_from(instants, *end, impulse, peak, target, soles, forces, not phase.touching)
        impulse += step * force
        target = target + step * np.array(forces.target_rates(target, force), dtype=float)
        travel += step * forces.target_speed(target)
        k += 1


def _fastest(forces: Forces, depth: float, rate: float, compressing: bool, scales: Scales) -> float:
    """[1/s] of the contact's spring and damper, hand and target being free."""
    way, speed = 1e-3 * scales.time * scales.speed, 1e-3 * scales.speed
    stiffness, damping = forces.contact_slopes(depth, rate, compressing, way, speed)
    return max(sqrt(max(stiffness, 0.0) * scales.mobility), abs(damping) * scales.mobility)
