"""Replay in MuJoCo with a free robot: only supporting hands are fixed.

Soles have unilateral contact with friction at their corners, the servo saturates, and the contact law's force
moves the target. The engine shares no code with the planner: it reads a reference (times, positions,
velocities, feed-forward), the robot's parameters and the scene.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.friction import tangential_mobility, tangential_outcome
from impactopt.errors import InputError, check_choice, check_positive
from impactopt.robots.loads import MIN_LOAD_FRACTION, weight_of
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import UnintendedContacts
from impactopt.simulation.controller import ControllerSettings, WholeBodyController
from impactopt.simulation.motors import CutWatch, Delay, GearWatch, Motors, Servo
from impactopt.simulation.mujoco_world import (
    CONTACTS,
    LinkContact,
    MujocoOptions,
    MujocoRobot,
    Welds,
    build_world,
    no_log_file,
    site_name,
    solids_in_contact,
)
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.result import (
    FollowedReference,
    Scene,
    Simulation,
    Touches,
    check_not_diverged,
    cross,
    posture_error,
    simulation_of,
    stance_at,
)
from impactopt.simulation.target_dynamics import Push, TargetContact

AXES = np.arange(3)
AWAY = np.array([0.0, 0.0, -100.0])  # [m] where the body of a broken target goes
# A robot has fallen beyond these errors of its base: tilt [rad], and loss of height, over the height of the
# centre of mass at the start, as the base's own origin may lie on the ground
FALLEN_TILT, FALLEN_DROP = 0.7, 0.3
# A robot does not stand at the end beyond these: tilt [rad] and speed [m/s] of the base
STANDING_TILT, STANDING_SPEED = 0.2, 0.05
SETTLE, SETTLE_WITHOUT_SOLES = 2.0, 0.3  # [s] simulated beyond the motion: a robot on its feet may fall late
INITIAL_SINK = 1e-9  # [m]: rounding may leave a sole above the floor, without load in the first step
NEW_POINT = 1e-3  # [m] from one step to the next: the striking link now touches the target at another point
MAX_SLIP = 0.05  # [m] of a sole, about half its width: farther, it stands where it was not planned to


class _Replay(MujocoRobot):
    """State of a replay: robot, target, servo or controller, and forces of the last step."""

    def __init__(
        self,
        robot: Robot,
        reference: Any,
        scene: Scene,
        perturbation: Perturbation,
        solver: MujocoOptions,
        controller: ControllerSettings | None = None,
        contact: str = "point",
    ) -> None:
        self.scene, self.perturbation = perturbation.scene(scene), perturbation
        self.wbc: WholeBodyController | None = None
        if controller is not None:
            world = perturbation
            self.wbc = WholeBodyController(
                robot, reference, scene, controller, kp=world.kp, kd=world.kd, limit=world.torque_limit
            )
        solids = self.scene.solids
        near = solids.near(robot.model, reference)
        link_pairs = solids_in_contact(robot, self.scene) if contact == "link" else []
        in_contact = [k for pairs in link_pairs for pair in pairs for k in pair]
        world = build_world(robot, self.scene, perturbation, solver, near, in_contact)
        sites = (site_name(k + 1) for k in range(len(scene.strikers)))
        target = self.scene.target
        mobility = tangential_mobility(scene.friction, target, target.parameters)
        super().__init__(robot, world, *sites, friction=scene.friction, mobility=mobility)
        self.links = LinkContact(self.mujoco, self.world, link_pairs) if link_pairs else None
        self.depths = np.full(len(scene.strikers), -np.inf)  # [m] of striking points in the target
        if self.links is not None:
            # MuJoCo else takes a site that is compiled at its body's origin to be there, whatever its
            # position
            self.world.site_sameframe[self.sites] = 0  # striking points move on their links
        self.grips = Welds(self.world, scene.hands)
        self.unintended = UnintendedContacts(self.world, solids)
        self.planned = self.followed = reference
        self.follow(reference)
        self.contact = TargetContact(self.scene)
        # the target's state and travel [m]
        self.target, self.travel = self.contact.untouched, self.contact.travel_at_start(reference)
        # state, travel and whether it is broken, for which the target's body was placed last
        self.placed: tuple[Array | None, float, bool] = (None, 0.0, False)
        # depths of the striking points at the end of the last step, None if it had no contact
        self.last_depths: Array | None = None
        # speeds of the striking points in the last step, and forces on them (None: no contact was near)
        self.last_step: tuple[Array, Array | None] | None = None
        # decelerations (h, nv) of the robot by a unit of each contact force; None: no contact is near
        self.response: Array | None = None
        self.sole_index = {name: k for k, name in enumerate(scene.soles)}
        # of each geom: index of the scene's sole that it is a corner of, or -1
        self.geom_sole = np.full(self.world.ngeom, -1)
        for sole in robot.soles:
            for k in range(len(sole.polygon)):
                self.geom_sole[self.world.geom(f"sole {sole.frame} {k}").id] = self.sole_index.get(
                    sole.frame, -1
                )
        frames = [robot.model.frames[robot.model.getFrameId(name)] for name in scene.soles]
        with_corners = list(zip(frames, scene.corners, strict=True))
        bodies = [self.world.body(f"body {robot.model.names[f.parentJoint]}").id for f in frames]
        self.corner_body = np.repeat(bodies, [len(corners) for corners in scene.corners]).astype(np.intp)
        places = [f.placement.act(np.array([*c, 0.0])) for f, corners in with_corners for c in corners]
        self.corners = np.reshape(places, (-1, 3))
        self.start(self.reference_q[0])

    def follow(self, reference: Any) -> None:
        """Sets the reference that servo and controller follow from now on."""
        world, self.followed = self.perturbation, reference
        self.servo = Servo(self.robot, reference, kp=world.kp, kd=world.kd, limit=world.torque_limit)
        self.reference_q = np.asarray(reference.q)
        if self.floating:
            self.upright = _upright(self.reference_q[:, 3:7].T)
        if self.wbc is not None:
            self.wbc.follow(None if reference is self.planned else reference)

    def command(self, t: float, forces: Array) -> tuple[Array, Array]:
        """Torque demand (n,) [N m] at a time [s], and the demand after saturation.

        forces : (h,) [N] of the last step, which the controller senses.
        """
        d = self.data
        if self.wbc is None:
            return self.servo.torque(t, d.qpos[self.qpos_index], d.qvel[self.dof])
        _, v = self.state()
        rotation = self.base_rotation() if self.floating else np.eye(3)
        demand, limit = self.wbc.torque(t, d.qpos[self.qpos_index], v, rotation, forces), self.servo.limit
        return demand, np.minimum(np.maximum(demand, -limit), limit)

    def start(self, q: Array) -> None:
        """Puts the robot at q (nq,), and welds supporting hands there."""
        self.put(q)
        if self.scene.soles:
            self.data.qpos[2] -= INITIAL_SINK
        self.mujoco.mj_kinematics(self.world, self.data)
        self.grips.put(self.data)
        self.mujoco.mj_forward(self.world, self.data)
        # [m] of the centre of mass of all that the first joint, a floating base's, carries
        self.start_height = float(self.data.subtree_com[self.world.jnt_bodyid[0], 2])

    # ---------------------------------------------------------------- parts of a step
    def hand_speeds(self) -> Array:
        """Speeds (h,) of the striking points along the normal [m/s]; updates their depths in the target."""
        places = self.striking_points() - self.tangential[0]
        if self.last_depths is not None:
            # The contact's integration gives depths more exactly than MuJoCo's step gives the robot: take the
            # travel that makes them agree.
            travels = self.contact.depths(places, 0.0) - self.last_depths
            known = travels[np.isfinite(travels)]
            self.travel = float(known.mean()) if known.size else self.travel
        self.last_depths = None
        self.depths = self.contact.depths(places, self.travel)
        if self.links is not None:
            self._move_striking_points(self.links)
        return self.speeds_along(self.scene.normal)

    def _move_striking_points(self, links: LinkContact) -> None:
        """Moves each striking point to where its link is deepest in the target's body."""
        d = self.data
        for k, site in enumerate(self.sites):
            depth, place = links.deepest(d, k)
            # MuJoCo's distance is to the body as it was placed last, not at the present travel
            self.depths[k] = depth - (self.travel - self.placed[1])
            if place is None:
                continue
            if np.linalg.norm(place - d.site_xpos[site]) > NEW_POINT:
                self.last_step = None  # of another point: its speeds give no acceleration
            body = self.world.site_bodyid[site]
            self.world.site_pos[site] = d.xmat[body].reshape(3, 3).T @ (place - d.xpos[body])
            d.site_xpos[site] = place

    def push(self, speeds: Array, step: float) -> Push | None:
        """Contact in the step that begins now, None if no contact is near; advances the target.

        speeds : (h,) [m/s] of the striking points along the normal.

        MuJoCo's accelerations are known only after the step, so that those without the contact are taken from
        the step before: the change of speed, without the part of its contact forces.
        """
        contact, d, zero = self.contact, self.data, 0.0 * speeds
        depths = zero - np.inf if self.perturbation.missing else self.depths
        self.response = None
        if not contact.near(depths, speeds, self.target, step):
            self.target, self.travel = contact.untouched_step(self.target, self.travel, step)
            self.release(step)
            self.last_step = speeds, None
            return None
        self.update_friction(self.scene.normal)
        self.response = np.zeros_like(self.normal_jacobian)
        # M is the free robot's: MuJoCo's contacts hold the soles, and their effect is in `accelerations`.
        self.mujoco.mj_solveM(self.world, d, self.response, self.force_map)
        inverse_mass = self.normal_jacobian @ self.response.T
        # speeds' change minus that by the contact forces of the last step, -M^-1 f
        accelerations = zero
        if self.last_step is not None:
            before, forces = self.last_step
            accelerations = (speeds - before) / step + (zero if forces is None else inverse_mass @ forces)
        push = contact.pushed(depths, speeds, accelerations, inverse_mass, self.target, self.travel, step)
        self.last_depths = push.depths
        if self.links is not None:  # to depths of the points in the target's plane, as in `hand_speeds`
            self.last_depths = (
                self.last_depths
                + contact.depths(self.striking_points() - self.tangential[0], self.travel)
                - depths
            )
        self.bend(push.forces, step)
        self.last_step = (speeds, push.forces)
        self.target, self.travel = push.state, push.travel
        return push

    def apply_perturbation(self, t: float) -> None:
        """Applies the perturbation's push on the base at a time [s]."""
        world = self.perturbation
        if not world.push:
            return
        on = world.push_start <= t < world.push_start + world.push_time
        direction = np.array([np.cos(world.push_way), np.sin(world.push_way)])
        self.data.xfrc_applied[1, :2] = on * world.push * direction

    def place_target(self) -> None:
        """Moves the target's body with the target; a broken one is put away."""
        state, travel, broken = self.placed
        if state is not self.target:  # a state that changes is a new array
            broken = bool(self.scene.target.outcome(self.target).get("broken", False))
        elif travel == self.travel:
            return
        displacement = self.travel * self.scene.normal + self.tangential[0] + broken * AWAY
        self.unintended.place_target(self.data, displacement)
        self.placed = self.target, self.travel, broken

    # ---------------------------------------------------------------- recorded quantities
    def record_gears(self, gears: GearWatch, torque: Array, push: Push | None) -> None:
        """Records gear loads after a step with motor torques (n,) [N m] and the contact forces `push`."""
        acceleration = self.data.qacc[self.dof]
        gears.update(torque, acceleration)
        if push is not None and self.response is not None:  # at the peak of the forces, instead of their mean
            gears.update(torque, acceleration + (push.forces - push.peaks) @ self.response[:, self.dof])

    def corner_places(self) -> Array:
        """World positions (k, 3) [m] of all corners of the scene's soles."""
        rotations = self.data.xmat[self.corner_body].reshape(-1, 3, 3)
        return self.data.xpos[self.corner_body] + (rotations @ self.corners[:, :, None])[:, :, 0]

    def sole_ground(self) -> Array:
        """Wrench (soles, 6) of the floor on each of the scene's soles about the world's origin.

        To be called once the step's forces are known.
        """
        out = np.zeros((len(self.sole_index), 6))
        contacts = self.data.contact
        if not self.data.ncon:
            return out
        sole = self.geom_sole[contacts.geom].max(axis=1)
        on = (contacts.efc_address >= 0) & (sole >= 0)
        axes, place = contacts.frame[on].reshape(-1, 3, 3), contacts.pos[on]
        # the frame's first axis points from the first geom to the second: from the floor, geom 0, up
        parts = self.data.efc_force[contacts.efc_address[on][:, None] + AXES]
        force = (parts[:, None] @ axes)[:, 0]
        np.add.at(out, sole[on], np.concatenate([force, cross(place, force)], axis=1))
        return out

    def ground(self) -> Array:
        """Wrenches (soles and supporting hands, 6) of the world on them, about its origin.

        To be called once the step's forces are known.
        """
        if not self.grips.frames:
            return self.sole_ground()
        wrenches, places = self.grips.wrenches(self.data)
        wrenches[:, 3:] += cross(places, wrenches[:, :3])
        return np.vstack([self.sole_ground(), wrenches])

    def fallen(self, t: float) -> str:
        """Reason why the robot counts as fallen at a time [s], "" if it stands.

        The base is compared with that of the reference, which may bow deeply itself. A robot that recovers
        goes through the reference's postures after the impact more slowly: it is compared with all of them.
        """
        if not self.scene.soles:
            return ""
        times = self.servo.time
        now = max(bisect_right(times, t) - 1, 0)
        since = now
        if self.wbc is not None and self.wbc.tracking.recovers(t):
            since = min(bisect_left(times, self.wbc.tracking.contact[1]), now)
        lean = self.base_error(slice(since, now + 1))
        height, planned = self.data.qpos[2], float(self.reference_q[since : now + 1, 2].min())
        if lean > FALLEN_TILT:
            return f"fell: the base leans {lean:.1f} rad from where it should be"
        if height < planned - FALLEN_DROP * self.start_height:
            return f"fell: the base is {height:.2f} m high where it should be {planned:.2f} m"
        return ""

    def base_error(self, instants: slice) -> float:
        """Least angle [rad] between the vertical axes of the base and of the reference at these instants."""
        w, x, y, z = self.data.qpos[3:7].tolist()
        cosine = float((self.upright[instants] @ _upright((x, y, z, w))).max())
        return math.acos(min(max(cosine, -1.0), 1.0))

    def not_standing(self, simulation: Simulation) -> str:
        """Reason why the robot does not stand at the end of the simulation; "" if it does."""
        if not self.scene.soles:
            return ""
        lean, speed = self.base_error(slice(-1, None)), float(np.linalg.norm(self.data.qvel[:3]))
        if lean > STANDING_TILT:
            return f"leans at the end: base {lean:.2f} rad from where it should be"
        if speed > STANDING_SPEED:
            return f"still moves at the end: base at {speed:.2f} m/s"
        least = MIN_LOAD_FRACTION * weight_of(self.robot)
        normal, slip = simulation.sole_normal[-1], simulation.slip.max(axis=0)
        stance = int(simulation.stance[-1]) if simulation.stance.size else 0
        stands = self.scene.standing_soles(stance)  # the others are in the air
        for k, (name, slid) in enumerate(zip(simulation.soles, slip, strict=True)):
            if k in stands and normal[k] < least:
                return f"the sole {name!r} carries no load at the end"
            if slid > MAX_SLIP:
                return f"the sole {name!r} slid: {1e3 * slid:.0f} mm along the floor"
        return ""


def _upright(quaternion: Any) -> Array:
    """World's vertical (..., 3) in axes rotated by quaternions (x, y, z, w), of numbers or arrays (...)."""
    x, y, z, w = quaternion
    return np.array([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]).T


def simulate_mujoco(
    robot: Robot,
    reference: Any,
    scene: Scene,
    *,
    step: float = 2e-4,
    iterations: int = 100,
    tolerance: float = 1e-10,
    settle: float | None = None,
    record: int = 5,
    perturbation: Perturbation | None = None,
    missed: Any = None,
    controller: ControllerSettings | None = None,
    contact: str = "point",
    until: float = np.inf,
) -> Simulation:
    """Simulates the whole motion on free soles, from the reference's first posture at rest.

    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n), as
        :class:`impactopt.transcription.plan.Trajectory`.
    step [s], iterations, tolerance : of MuJoCo (semi-implicit Euler, Newton, elliptic cones).
    settle [s] : simulated beyond the motion, in which the robot may fall; default: 2 s, and 0.3 s for a robot
        without soles.
    record : steps between recorded instants; in contact every step is recorded.
    perturbation : differences of the world from the planned one; default: none.
    missed : reference of a robot that hit nothing, followed from ``missed.contact_end`` on
        (:class:`impactopt.simulation.result.FollowedReference`); default: the robot does not notice.
    controller : settings of a whole-body controller; default: the joints' servo.
    contact : "point": the striking point touches the target's plane; "link": the hull of the striking link
        touches the target's body, and the law's force acts where it is deepest.
    until [s] : ends the simulation earlier.

    A fall ends the simulation early, and is reported in the result.

    Raises
    ------
    InputError : MuJoCo is not installed, there is no such contact, or the simulation diverges (with the time
    at which it did).
    """
    check_positive("step [s]", step)
    check_choice("contact", contact, CONTACTS)
    if controller is not None and robot.floating and not scene.soles and not scene.hands:
        raise InputError(
            f"robot {robot.name!r} floats freely, and the whole-body controller needs soles or supporting "
            "hands: take the servo"
        )
    world = perturbation if perturbation is not None else Perturbation()
    if world.push and not robot.floating:
        raise InputError(
            f"perturbation: push acts on the base, and that of {robot.name!r} is bolted: leave it out"
        )
    beyond = settle if settle is not None else SETTLE if scene.soles else SETTLE_WITHOUT_SOLES
    solver = MujocoOptions(step, iterations, tolerance)
    replay = _Replay(robot, reference, scene, world, solver, controller, contact)
    mujoco, model, data, servo = replay.mujoco, replay.world, replay.data, replay.servo
    limit = servo.limit * (1 + 1e-9)
    period, delay = world.period, world.delay
    if controller is not None:
        period, delay = period or controller.period, delay or controller.delay
    hold, lag = max(1, round(period / step)), round(delay / step)  # in steps
    waiting: deque[tuple[int, tuple[Array, Array]]] = deque()  # step in which a command takes effect; command
    # (2, n) demand, and demand after saturation: as commanded, and as it reaches the motors
    commanded, reached = np.zeros((2, robot.n)), np.zeros((2, robot.n))
    none = np.zeros(len(scene.strikers))
    forces = none  # [N] of the last step
    ground = np.zeros((len(scene.soles) + len(scene.hands), 6))
    recorded: list[tuple[Any, ...]] = []
    touches, saturated, fall = Touches(), 0.0, ""
    followed = FollowedReference(reference, missed)
    motors, motor_delay, cuts, passive = Motors(robot), Delay(robot), CutWatch(robot), robot.passive
    has_passive = bool(passive.any())
    drive: Array | None = None  # torque of the motors
    gears = GearWatch(robot)
    # [N s] of each striker on the target, and the target's state at the last touch
    impulses, last_touched = none, replay.target
    with no_log_file():
        for k in range(round(min(float(reference.end) + beyond, until) / step)):
            t = k * step
            mujoco.mj_step1(model, data)
            if (now := followed.at(t, bool(touches.intervals))) is not replay.followed:
                replay.follow(now)
                servo = replay.servo
            if k % hold == 0:
                # the first command takes effect at once: at rest before the start, it was the same
                waiting.append((k + lag if k else 0, replay.command(t, forces)))
            while waiting and waiting[0][0] <= k:
                commanded = np.array(waiting.popleft()[1])
            reached, previous = motor_delay.at(t, commanded), reached
            motor_delay.keep(t, commanded)
            if reached is not previous:
                demand, saturated_demand = reached
                saturates = bool(np.count_nonzero(np.abs(demand) > limit))
            rates = data.qvel[replay.dof]
            cut = motors.cut(saturated_demand, rates)
            if motors.lines:
                cuts.update(t, saturated_demand, cut, step)
            drive = cut if drive is None else drive
            # The step has the mean torque, by which its impulse is exact; the motor's own state goes on from
            # its end.
            torque, drive = motors.mean(drive, cut, step), motors.after(drive, cut, step)
            if has_passive:  # springs act at every step: no computer samples them
                torque = np.where(passive, servo.springs(data.qpos[replay.qpos_index], rates), torque)
            speeds = replay.hand_speeds()
            target_before, displacement = replay.target, (replay.travel, replay.tangential[0])
            push = replay.push(speeds, step)
            forces = none if push is None else push.forces
            replay.apply(torque, None if push is None else forces)
            replay.apply_perturbation(t)
            touches.add(t, push)
            saturated += step * saturates
            replay.place_target()
            if push is not None:
                impulses = impulses + step * forces
                last_touched = replay.target if push.given[-1] > 0 else last_touched
            records = k % record == 0 or touches.touched
            # positions are those before the step, forces and accelerations those in it
            state = replay.state() if records else None
            corners = replay.corner_places() if records else None
            mujoco.mj_step2(model, data)
            replay.unintended.update(data, t)
            replay.record_gears(gears, torque, push)
            if records:
                ground = replay.ground()
                assert state is not None
                force = 0.0 if push is None else float(push.total[0])
                contact_values = force, replay.contact.speed(target_before), float(speeds[0])
                loads = demand, torque, ground, corners, gears.take()
                recorded.append((t, *state, *contact_values, *displacement, *loads, stance_at(now, t)))
                check_not_diverged(data.qvel, t, step)
                fall = replay.fallen(t)
                if fall:
                    fall = f"{fall} at t = {t:.2f} s"
                    break
    outcome = replay.scene.target.outcome(last_touched)
    if replay.mobility:
        outcome |= tangential_outcome(replay.tangential[1])
    simulation = simulation_of(
        robot,
        replay.scene,
        recorded,
        touches,
        engine="mujoco",
        impulse=float(impulses.sum()),
        impulses=impulses,
        outcome=outcome,
        saturated=saturated,
        cuts=cuts.cuts() if motors.lines else None,
        posture_error=posture_error(robot.model, replay.state()[0], replay.reference_q[-1]),
        fall=fall,
        touched=replay.unintended.contacts(),
        missed=world.missing,
    )
    return simulation if fall else replace(simulation, fall=replay.not_standing(simulation))
