"""Replay in MuJoCo with nothing held, but by its own hands: the robot is free on its soles.

Unilateral contact with friction at the soles' corners, the servo with its limits, the target moved by the
contact law's force. Shares no code with the planner: it reads a reference (times, positions, velocities,
feed-forward), the robot's numbers and the scene's.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_choice, check_positive
from impactopt.robots.loads import BEARS, weight_of
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import Besides
from impactopt.simulation.controller import ControllerSettings, WholeBodyController
from impactopt.simulation.link_contact import CONTACTS, LinkContact, solids_in_contact
from impactopt.simulation.motors import CutWatch, Delay, GearWatch, Motors, Servo
from impactopt.simulation.mujoco_world import (
    MujocoOptions,
    MujocoRobot,
    Welds,
    build_world,
    no_log_file,
    site_name,
)
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.result import (
    FollowedReference,
    Scene,
    Simulation,
    Touches,
    check_not_diverged,
    posture_error,
    simulation_of,
    stance_at,
)
from impactopt.simulation.target_dynamics import Push, Struck

Array = NDArray[np.float64]
THREE, NEXT, LAST = np.arange(3), [1, 2, 0], [2, 0, 1]  # axes, and those after and before each
AWAY = np.array([0.0, 0.0, -100.0])  # [m] where what is broken goes
FALLEN_TILT, FALLEN_DROP = 0.7, 0.3  # [rad] of the base from the reference's; of its height, as a fraction
LEANS, STIRS = 0.2, 0.05  # [rad] of the base against the reference's last; [m/s] of it: more is no standing
SETTLES, SETTLES_SOLELESS = 2.0, 0.3  # [s] beyond the motion: a robot on its feet may fall late
TOUCHING = 1e-9  # [m] that the robot starts lower: soles that rounding has above the floor bear nothing
MOVED = 1e-3  # [m] from one step to the next: a striking link meets the target at another point
SLID = 0.05  # [m] of a sole along the floor, about half of one's width: it stands where it was not to


class _Replay(MujocoRobot):
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
        meeting = solids_in_contact(robot, self.scene) if contact == "link" else []
        struck = [k for each in meeting for pair in each for k in pair]
        world = build_world(robot, self.scene, perturbation, solver, near, struck)
        sites = (site_name(k + 1) for k in range(len(scene.strikers)))
        super().__init__(robot, world, *sites, friction=scene.friction)
        self.links = LinkContact(self.mujoco, self.world, meeting) if meeting else None
        self.depths = np.full(len(scene.strikers), -np.inf)  # [m] of strikers in the target
        if self.links is not None:
            self.world.site_sameframe[self.sites] = 0  # they move in their bodies
        self.grips = Welds(self.world, scene.hands)
        self.besides = Besides(self.world, solids)
        self.planned = self.followed = reference
        self.follow(reference)
        self.struck = Struck(self.scene)
        # the target's state, and how far it has gone [m]
        self.target, self.travel = self.struck.untouched, self.struck.travel_at_start(reference)
        self.placed: tuple[Array | None, float, bool] = (None, 0.0, False)  # as its body is: both, and broken
        # strikers' depths in it at the end of a step in contact; of the step before, their speeds and forces
        self.kept: Array | None = None
        self.before: tuple[Array, Array] | None = None
        # how fast the robot accelerates (h, nv) by a unit of each contact's force, where there may be one
        self.yields: Array | None = None
        self.held = {name: k for k, name in enumerate(scene.soles)}
        self.geom_sole = np.full(self.world.ngeom, -1)
        for sole in robot.soles:
            for k in range(len(sole.polygon)):
                self.geom_sole[self.world.geom(f"sole {sole.frame} {k}").id] = self.held.get(sole.frame, -1)
        frames = [robot.model.frames[robot.model.getFrameId(name)] for name in scene.soles]
        on = list(zip(frames, scene.corners, strict=True))
        bodies = [self.world.body(f"body {robot.model.names[f.parentJoint]}").id for f, _ in on]
        self.corner_body = np.repeat(bodies, [len(corners) for corners in scene.corners]).astype(np.intp)
        places = [f.placement.act(np.array([*c, 0.0])) for f, corners in on for c in corners]
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

    def asked(self, t: float, forces: Array) -> tuple[Array, Array]:
        """Torque demand (n,) [N m] at a time [s], and what saturation leaves of it."""
        d = self.data
        if self.wbc is None:
            return self.servo.torque(t, d.qpos[self.place], d.qvel[self.dof])
        _, v = self.state()
        rotation = self.base_rotation() if self.floating else np.eye(3)
        demand = self.wbc.torque(t, d.qpos[self.place], v, rotation, forces)
        return demand, np.clip(demand, -self.servo.limit, self.servo.limit)

    def start(self, q: Array) -> None:
        self.put(q)
        if self.scene.soles:
            self.data.qpos[2] -= TOUCHING
        self.mujoco.mj_kinematics(self.world, self.data)
        self.grips.put(self.data)
        self.mujoco.mj_forward(self.world, self.data)

    # ------------------------------------------------------------------ what a step needs
    def hand_speeds(self) -> Array:
        """Speeds (h,) of the striking points along the normal [m/s]; sets their depths in the target."""
        places = self.places()
        if self.kept is not None:
            # depths are the contact's: they are followed more exactly there than the arms are
            gone = self.struck.depths(places, 0.0) - self.kept
            known = gone[np.isfinite(gone)]
            self.travel = float(known.mean()) if known.size else self.travel
        self.kept = None
        self.depths = self.struck.depths(places, self.travel)
        if self.links is not None:
            self._meet(self.links)
        return self.speeds_along(self.scene.normal)

    def _meet(self, links: LinkContact) -> None:
        """Striking points are where their links are deepest in the target's body."""
        d = self.data
        for k, site in enumerate(self.sites):
            depth, place = links.deepest(d, k)
            self.depths[k] = depth - (self.travel - self.placed[1])  # its body is where it was placed
            if place is None:
                continue
            if np.linalg.norm(place - d.site_xpos[site]) > MOVED:
                self.before = None
            body = self.world.site_bodyid[site]
            self.world.site_pos[site] = d.xmat[body].reshape(3, 3).T @ (place - d.xpos[body])
            d.site_xpos[site] = place

    def push(self, speeds: Array, step: float) -> Push:
        """The contact in the step that begins now; moves the target.

        Hands gain speed as in the step before, where soles and servos had the same to say.
        """
        struck, d, none = self.struck, self.data, 0.0 * speeds
        depths = none - np.inf if self.perturbation.missing else self.depths
        self.yields = None
        if struck.near(depths, speeds, self.target, step):
            self.yields = np.zeros_like(self.along)
            self.mujoco.mj_solveM(self.world, d, self.yields, self.pushes)
            yields = self.along @ self.yields.T
            gains = none if self.before is None else (speeds - self.before[0]) / step
            gains = gains + (none if self.before is None else yields @ self.before[1])
            push = struck.pushed(depths, speeds, gains, yields, self.target, self.travel, step)
            self.kept = push.depths
            if self.links is not None:  # as those of points in a plane
                self.kept = self.kept + struck.depths(self.places(), self.travel) - depths
        else:
            state, travel = struck.untouched_step(self.target, self.travel, step)
            push = Push(forces=none, halves=none, peaks=none, state=state, travel=travel, depths=depths)
        self.before = (speeds, push.forces)
        self.target, self.travel = push.state, push.travel
        return push

    def shove(self, t: float) -> None:
        """The perturbation's push at the base, if it is on at a time [s]."""
        world = self.perturbation
        if not (self.floating and world.push):
            return
        on = world.push_start <= t < world.push_start + world.push_time
        way = np.array([np.cos(world.push_way), np.sin(world.push_way)])
        self.data.xfrc_applied[1, :2] = on * world.push * way

    def place_target(self) -> None:
        """Its body goes with it; what a blow has broken is put away."""
        state, travel, broken = self.placed
        if state is not self.target:  # it is replaced where it changes
            broken = bool(self.scene.target.outcome(self.target).get("broken", False))
        elif travel == self.travel:
            return
        self.besides.place(self.data, self.travel * self.scene.normal + broken * AWAY)
        self.placed = self.target, self.travel, broken

    # ------------------------------------------------------------------ what a record needs
    def look_at(self, gears: GearWatch, torque: Array, push: Push) -> None:
        """Records gear loads after a step with torque (n,) [N m] of the servos, under these forces."""
        acceleration = self.data.qacc[self.dof]
        gears.look(torque, acceleration)
        if self.yields is not None:
            gears.look(torque, acceleration + (push.forces - push.peaks) @ self.yields[:, self.dof])

    def corner_places(self) -> Array:
        """World places (k, 3) of all fixed soles' corners."""
        rotations = self.data.xmat[self.corner_body].reshape(-1, 3, 3)
        return self.data.xpos[self.corner_body] + (rotations @ self.corners[:, :, None])[:, :, 0]

    def sole_ground(self) -> Array:
        """(soles, 6) wrench of the floor on each fixed sole about the world's origin; after the step's forces
        are known."""
        out = np.zeros((len(self.held), 6))
        contacts = self.data.contact
        if not self.data.ncon:
            return out
        sole = self.geom_sole[contacts.geom].max(axis=1)
        on = (contacts.efc_address >= 0) & (sole >= 0)
        axes, place = contacts.frame[on].reshape(-1, 3, 3), contacts.pos[on]
        # the frame's first axis points from the first geom to the second: from the floor, geom 0, up
        parts = self.data.efc_force[contacts.efc_address[on][:, None] + THREE]
        force = (parts[:, None] @ axes)[:, 0]
        # place x force; np.cross takes several times as long
        moment = place[:, NEXT] * force[:, LAST] - place[:, LAST] * force[:, NEXT]
        np.add.at(out, sole[on], np.concatenate([force, moment], axis=1))
        return out

    def ground(self) -> Array:
        """(soles and hands, 6) wrench of the world on what stands on it and holds on to it, about its origin;
        after the step's forces are known.
        """
        if not self.grips.frames:
            return self.sole_ground()
        found, places = self.grips.wrenches(self.data)
        found[:, 3:] += np.cross(places, found[:, :3])
        return np.vstack([self.sole_ground(), found])

    def fallen(self, t: float) -> str:
        """Reason why the robot counts as fallen, "" if it stands: the base is far from the reference's at a
        time [s], which may bow deeply itself. A robot that recovers reaches the reference's postures after
        the blow later.
        """
        if not self.scene.soles:
            return ""
        times = self.servo.time
        row = max(int(np.searchsorted(times, t, side="right")) - 1, 0)
        since = row
        if self.wbc is not None and self.wbc.tracking.recovers(t):
            since = min(int(np.searchsorted(times, self.wbc.tracking.contact[1])), row)
        lean = float(self.base_errors(slice(since, row + 1)).min())
        height, planned = self.data.qpos[2], float(self.reference_q[since : row + 1, 2].min())
        if lean > FALLEN_TILT:
            return f"fell: the base leans {lean:.1f} rad from where it should be"
        if height < (1 - FALLEN_DROP) * planned:
            return f"fell: the base is {height:.2f} m high where it should be {planned:.2f} m"
        return ""

    def base_errors(self, rows: slice) -> Array:
        """Angles [rad] between the verticals of the base and of the reference's configurations in rows."""
        w, x, y, z = self.data.qpos[3:7].tolist()
        return np.arccos(np.clip(self.upright[rows] @ _upright((x, y, z, w)), -1.0, 1.0))

    def not_standing(self, simulation: Simulation) -> str:
        """Reason why the robot does not stand at the end of its simulation; "" if it does."""
        if not self.scene.soles:
            return ""
        lean, speed = float(self.base_errors(slice(-1, None))[0]), float(np.linalg.norm(self.data.qvel[:3]))
        if lean > LEANS:
            return f"leans at the end: base {lean:.2f} rad from where it should be"
        if speed > STIRS:
            return f"still moves at the end: base at {speed:.2f} m/s"
        least = BEARS * weight_of(self.robot)
        normal, slip = simulation.sole_normal[-1], simulation.slip.max(axis=0)
        for name, force, slid in zip(simulation.soles, normal, slip, strict=True):
            if force < least:
                return f"the sole {name!r} bears no load at the end"
            if slid > SLID:
                return f"the sole {name!r} slid: {1e3 * slid:.0f} mm along the floor"
        return ""


def _upright(quaternion: Any) -> Array:
    """(..., 3) the world's vertical in axes turned by quaternions (x, y, z, w) of numbers or arrays (...)."""
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
    """The whole motion from the reference's first posture at rest, on free soles, and ``settle`` [s] beyond.

    settle : by default 2 s, in which it can fall, and 0.3 s for a robot without soles.
    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n), as of
    :class:`impactopt.transcription.plan.Trajectory`. step [s], iterations, tolerance : of MuJoCo
    (semi-implicit Euler, Newton, elliptic cones). record : steps between recorded instants; every step is
    recorded in contact. perturbation : where the world differs from what was planned; default: nowhere.
    missed : the reference of a robot that hits nothing, which it notices at ``missed.contact_end`` (see
        :class:`impactopt.simulation.result.FollowedReference`); default: it does not notice.
    controller : settings of a whole-body controller; default: the joints' servo.
    contact : "point": the striking point meets the target's plane; "link": the hull of the striking link
        meets the target's body, and the law's force acts where it is deepest.
    until [s] : it ends, if that is earlier.

    A fall ends the simulation early; the result says so.

    Raises
    ------
    InputError : MuJoCo is not installed, there is no such contact, or the simulation diverges (with the time
    at which it did).
    """
    check_positive("step [s]", step)
    check_choice("contact", contact, CONTACTS)
    if controller is not None and robot.floating and not scene.soles and not scene.hands:
        raise InputError(
            f"robot {robot.name!r} floats freely, and the whole-body controller moves bases by what they "
            "stand on: take the servo"
        )
    world = perturbation if perturbation is not None else Perturbation()
    beyond = settle if settle is not None else SETTLES if scene.soles else SETTLES_SOLELESS
    solver = MujocoOptions(step, iterations, tolerance)
    replay = _Replay(robot, reference, scene, world, solver, controller, contact)
    mujoco, model, data, servo = replay.mujoco, replay.world, replay.data, replay.servo
    most = servo.limit * (1 + 1e-9)  # demand that does not saturate
    period, wait = world.period, world.delay
    if controller is not None:
        period, wait = period or controller.period, wait or controller.delay
    hold = max(1, round(period / step))
    waiting: deque[tuple[int, tuple[Array, Array]]] = deque()  # when to set, and what: demand and torque
    lag = round(wait / step)
    # what the servo tells the motors, and what reaches them: demand, and what saturation leaves of it
    told, reached = np.zeros((2, robot.n)), np.zeros((2, robot.n))
    force, forces = 0.0, np.zeros(len(scene.strikers))
    ground = np.zeros((len(scene.soles) + len(scene.hands), 6))
    rows: list[tuple[Any, ...]] = []
    touches, saturated, peak, fall = Touches(), 0.0, 0.0, ""
    followed = FollowedReference(reference, missed)
    motors, delay, cuts, passive = Motors(robot), Delay(robot), CutWatch(robot), robot.passive
    undriven = bool(passive.any())
    drive: Array | None = None  # torque of the motors
    gears = GearWatch(robot)
    # given to the target [N s] by each striker, and its state when it was last touched
    impulses, left = np.zeros(len(scene.strikers)), replay.target
    with no_log_file():
        for k in range(round(min(float(reference.end) + beyond, until) / step)):
            t = k * step
            mujoco.mj_step1(model, data)
            if (now := followed.at(t, bool(touches.intervals))) is not replay.followed:
                replay.follow(now)
                servo = replay.servo
            if k % hold == 0:
                asked = replay.asked(t, forces)
                # at rest before the start, it asked for the same
                waiting.append((k + lag if k else 0, asked))
            while waiting and waiting[0][0] <= k:
                told = np.array(waiting.popleft()[1])
            reached, late = delay.at(t, told), reached
            delay.keep(t, told)
            if reached is not late:
                demand, wanted = reached
                saturates = bool((np.abs(demand) > most).any())
            rates = data.qvel[replay.dof]
            cut = motors.cut(wanted, rates)
            if motors.lines:
                cuts.look(t, wanted, cut, step)
            drive = cut if drive is None else drive
            torque, drive = motors.mean(drive, cut, step), motors.after(drive, cut, step)
            if undriven:  # springs, that no computer samples
                torque = np.where(passive, servo.springs(data.qpos[replay.place], rates), torque)
            speeds = replay.hand_speeds()
            target_before = replay.target
            push = replay.push(speeds, step)
            forces, force = push.forces, push.force
            peak = max(peak, push.peak)
            replay.apply(torque, push.forces)
            replay.shove(t)
            touches.add(t, force, step, push.since)
            saturated += step * saturates
            replay.place_target()
            impulses += step * push.forces
            left = replay.target if force > 0 else left
            kept = k % record == 0 or touches.touched
            state = replay.state() if kept else None
            corners = replay.corner_places() if kept else None
            mujoco.mj_step2(model, data)
            replay.besides.look(data, t)
            replay.look_at(gears, torque, push)
            if kept:
                ground = replay.ground()
                assert state is not None
                met = force, replay.struck.speed(target_before), float(speeds[0])
                loads = demand, torque, ground, corners, gears.taken()
                rows.append((t, *state, *met, *loads, stance_at(now, t)))
                check_not_diverged(data.qvel, t, step)
                fall = replay.fallen(t)
                if fall:
                    fall = f"{fall} at t = {t:.2f} s"
                    break
    simulation = simulation_of(
        robot,
        replay.scene,
        rows,
        touches,
        engine="mujoco",
        impulse=float(impulses.sum()),
        impulses=impulses,
        peak_force=peak,
        outcome=replay.scene.target.outcome(left),
        saturated=saturated,
        cuts=cuts.told() if motors.lines else None,
        posture_error=posture_error(robot.model, replay.state()[0], replay.reference_q[-1]),
        fall=fall,
        touched=replay.besides.touched(),
        missed=world.missing,
    )
    return simulation if fall else replace(simulation, fall=replay.not_standing(simulation))
