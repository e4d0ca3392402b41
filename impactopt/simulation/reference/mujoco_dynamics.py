"""Full dynamics of a collision in MuJoCo: a check by other algorithms and another integrator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from impactopt.arrays import Array
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

_RECORD = 5e-5  # [s] between recorded instants
_RESOLUTION = 0.02  # step of the first run, times the contact's fastest rate
_RUNS, _MAX_STEPS = 9, 300_000  # with half the step each; of a run


@dataclass(frozen=True, kw_only=True, eq=False)
class MujocoDynamics(ReferenceModel):
    """Collision in MuJoCo, without frozen quantities.

    The fixed frames are welded to the world, as hard as MuJoCo permits: the time constant is two steps, so
    that welds become rigid as the step goes to zero. Servo, friction and contact act as applied forces, in
    MuJoCo's semi-implicit Euler steps. All this is of first order in the step. Steps that resolve servo and
    contact are halved until impulse, energy and velocity converge, extrapolated to zero step from the two
    shortest (Richardson). Histories and other results are those of the shortest steps. The end of contact is
    found to within a step.

    Attributes
    ----------
    friction : of the joints.
    kp, kd : (n,) or (n, n) gains in place of the robot's.
    step : [s] of the first run, at most.
    tolerance : relative, of the impulse.

    Raises
    ------
    InputError : as in `CollisionModel`; MuJoCo is not installed; a virtual base, which this model lacks;
        gains of a wrong shape or sign; a step or a tolerance that is not positive; in `collide`, a contact
        that takes too many steps.
    """

    step: float = 4e-5
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        mujoco_module()
        if np.any(self.held_by.compliance):
            raise InputError(
                "MujocoDynamics fixes soles exactly only: take FullDynamics for a virtual base, or a stance "
                "without base_mass and base_inertia"
            )

    def _controlled(
        self, q: Array, v: Array, forces: Forces, normal: Array, tolerance: float
    ) -> tuple[Collision, float]:
        body = DenseBody(*self._body_arguments, normal, self.contact_friction)
        body.update(q, v)
        body.update_contact()
        rate = float(body.speeds()[0]) - forces.target_speed(np.zeros(forces.target.n_states))
        scales = contact_scales(body, forces, rate, self.horizon)
        damping = np.diag(forces.kd) if forces.kd.ndim == 1 else forces.kd
        fastest = body.fastest_rate(damping + np.diag(forces.viscous + forces.coulomb / forces.transition))
        # steps that resolve servo and friction; halved until they resolve the contact too
        # explicit in the applied forces, so that a decay faster than 2 / step would grow
        step = min(self.step, 1 / fastest) if fastest > 0 else self.step
        first = None
        while first is None:
            try:
                first = self._run(step, q, v, forces, normal, scales)
            except _NotResolved as contact:
                step = min(step / 2, _RESOLUTION / contact.rate)
        coarse = first

        def at(level: int) -> Collision:
            return self._run(step / 2**level, q, v, forces, normal) if level else coarse

        return converge(at, tolerance, levels=_RUNS, extrapolate=_extrapolated)

    def _run(
        self, step: float, q: Array, v: Array, forces: Forces, normal: Array, scales: Scales | None = None
    ) -> Collision:
        """Collision in steps of this length [s]; `scales` as in `march`."""
        robot, frames, _, striker = self._body_arguments
        with no_log_file():
            world = WeldedRobot(robot, frames, striker, step, self.contact_friction, forces.mobility)
            world.start(q, v)
            soles = len(self.held_by.sole_names(robot))
            return march(world, forces, normal, self.horizon, soles, scales)


def _extrapolated(fine: Collision, coarse: Collision) -> Collision:
    """Richardson extrapolation of a method of first order from two runs, the finer with half the step."""
    return replace(
        fine,
        impulse=2 * fine.impulse - coarse.impulse,
        energy=2 * fine.energy - coarse.energy,
        velocity=2 * fine.velocity - coarse.velocity,
    )


class WeldedRobot(MujocoRobot):
    """Robot whose frames are welded where they are in `start`."""

    def __init__(
        self,
        robot: Robot,
        frames: tuple[str, ...],
        striker: str,
        step: float,
        friction: ContactFriction | None = None,
        mobility: float = 0.0,
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
        super().__init__(robot, spec.compile(), striker, friction=friction, mobility=mobility)
        self.welds = Welds(self.world, frames)

    def start(self, q: Array, v: Array) -> None:
        """Sets q (nq,), v (nv,) at contact, and the welds to the frames' placements."""
        self.put(q, v)
        self.mujoco.mj_kinematics(self.world, self.data)
        self.welds.put(self.data)

    def wrenches(self) -> tuple[Array, Array]:
        """Wrenches (6 frames,) of the ground on the welded frames, and their origins (frames, 3) [m].

        Both are those at the start of the last step.
        """
        wrenches, places = self.welds.wrenches(self.data)
        return wrenches.ravel(), places


class _NotResolved(Exception):
    """Raised when steps are too long for the contact, which changes at this rate [1/s]."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate


def march(
    world: WeldedRobot,
    forces: Forces,
    normal: Array,
    horizon: float,
    soles: int,
    scales: Scales | None = None,
) -> Collision:
    """Simulates a collision in the steps of a MuJoCo world, from its current state.

    scales : of the contact, to check that steps resolve it; None: no check.

    Raises
    ------
    InputError : the simulation diverges, or takes too many steps.
    _NotResolved : the steps do not resolve the contact.
    """
    data, step = world.data, world.step
    every = max(1, round(_RECORD / step))
    instants: list[Instant] = []
    impulse = travel = peak = 0.0
    target = np.zeros(forces.target.n_states)
    angles = data.qpos[world.qpos_index].copy()
    k = 0
    while True:
        world.mujoco.mj_step1(world.world, data)  # up to velocities; forces are set before mj_step2
        speed = float(world.speeds_along(normal)[0])
        world.update_friction(normal)
        if k == 0:
            start = float(normal @ world.striking_points()[0])
        if not np.isfinite(data.qacc_warmstart).all() or not np.isfinite(speed):
            raise InputError(f"step [s]: {step:g} is unstable here; give MujocoDynamics a shorter one")
        if k > _MAX_STEPS:
            raise InputError(
                f"the contact is too fast for MuJoCo: it has not ended after {_MAX_STEPS} steps of "
                f"{step:.2g} s; give a softer law or a heavier target, or take "
                "FullDynamics"
            )
        time, velocity = k * step, data.qvel[world.dof].copy()
        target_speed = forces.target_speed(target)
        rate = speed - target_speed
        depth = float(normal @ world.striking_points()[0]) - start - travel
        demand = forces.demand(time, data.qpos[world.qpos_index] - angles, velocity)
        phase: Phase = forces.phase(demand, velocity, depth, rate, target)
        force = forces.contact(depth, rate, phase.compressing) if phase.touching else 0.0
        # the steps have to resolve the contact's fastest mode, with a factor of two of tolerance
        if scales is not None and phase.touching:
            fastest = _fastest(forces, depth, rate, phase.compressing, scales)
            if fastest * step > 2 * _RESOLUTION:
                raise _NotResolved(fastest)
        torque = forces.torque(demand, phase)
        # a contact that begins with equal speeds of hand and target may still press: wait for the next step
        ends = (not phase.touching and (k > 0 or rate != 0)) or time >= horizon * (1 - 1e-9)
        if ends:
            end, tangential = world.state(), world.tangential[1]
        on_hand = np.array([force])
        world.bend(on_hand, step)
        world.apply(torque - forces.friction(velocity, phase), on_hand)
        world.mujoco.mj_step2(world.world, data)
        peak = max(peak, force)
        if ends or k % every == 0:
            wrenches, places = world.wrenches()
            instants.append(
                Instant(time, force, depth, speed, target_speed, velocity, torque, demand, wrenches, places)
            )
        if ends:
            done = not phase.touching
            return collision_from(instants, *end, impulse, peak, target, soles, forces, done, tangential)
        impulse += step * force
        # semi-implicit Euler as in MuJoCo: the travel follows from the new speed
        target = target + step * np.array(forces.target_rates(target, force), dtype=float)
        travel += step * forces.target_speed(target)
        k += 1


def _fastest(forces: Forces, depth: float, rate: float, compressing: bool, scales: Scales) -> float:
    """Fastest rate [1/s] of the contact's spring and damper between free hand and target."""
    # differences a thousandth of the contact's own depth and speed
    depth_step, speed_step = 1e-3 * scales.time * scales.speed, 1e-3 * scales.speed
    stiffness, damping = forces.contact_slopes(depth, rate, compressing, depth_step, speed_step)
    return max(sqrt(max(stiffness, 0.0) * scales.inverse_mass), abs(damping) * scales.inverse_mass)
