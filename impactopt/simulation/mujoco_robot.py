"""The robot in MuJoCo, in Pinocchio's conventions: what replays and references move."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.mujoco_world import mujoco_module

__all__ = ["MujocoRobot"]

Array = NDArray[np.float64]


class MujocoRobot:
    """A robot in a compiled MuJoCo model, struck at one of its sites.

    world, data : MuJoCo's model and its data.  dof, place : where the joints' rates and angles are in qvel
    and qpos.  sites : of the striking points, and along (h, nv): their Jacobians along the normal, where they
    have been last.
    """

    def __init__(self, robot: Robot, world: Any, *strikers: str) -> None:
        self.mujoco, self.robot, self.world = mujoco_module(), robot, world
        self.data = self.mujoco.MjData(world)
        self.floating = robot.floating
        self._n, self._nq, self._nv = robot.n, robot.nq, robot.nv
        joints = [world.joint(name) for name in robot.joint_names]
        self.dof = np.array([joint.dofadr[0] for joint in joints])
        self.place = np.array([joint.qposadr[0] for joint in joints])
        own = list(robot.model.joints)[-robot.n :]
        self._place = np.array([joint.idx_q for joint in own], dtype=np.intp)
        # a continuous joint's angle is (cosine, sine) in Pinocchio
        self._continuous = np.flatnonzero([joint.nq == 2 for joint in own])
        self.sites = np.array([world.site(striker).id for striker in strikers], dtype=np.intp)
        self._rows, self.along = np.zeros((3, world.nv)), np.zeros((len(strikers), world.nv))

    def put(self, q: Array, v: Array | None = None) -> None:
        """Go to q (nq), v (nv; None: the rates stay); what depends on them is not computed yet."""
        d, robot = self.data, self.robot
        if self.floating:
            d.qpos[:3], d.qpos[3:7] = q[:3], q[[6, 3, 4, 5]]
        d.qpos[self.place] = robot.joint_positions(q)
        if v is not None:
            if self.floating:
                d.qvel[:3], d.qvel[3:6] = self.base_rotation() @ v[:3], v[3:6]
            d.qvel[self.dof] = v[-robot.n :]

    def state(self) -> tuple[Array, Array]:
        """q (nq), v (nv)."""
        qpos, qvel = self.data.qpos, self.data.qvel
        q, v = np.zeros(self._nq), np.zeros(self._nv)
        if self.floating:
            q[:3], q[3:6], q[6] = qpos[:3], qpos[4:7], qpos[3]
            v[:3], v[3:6] = self.base_rotation().T @ qvel[:3], qvel[3:6]
        angles = qpos[self.place]
        q[self._place] = angles
        for k in self._continuous:
            at = self._place[k]
            q[at], q[at + 1] = np.cos(angles[k]), np.sin(angles[k])
        v[-self._n :] = qvel[self.dof]
        return q, v

    def base_rotation(self) -> Array:
        """(3, 3) of a floating base."""
        rotation = np.zeros(9)
        self.mujoco.mju_quat2Mat(rotation, self.data.qpos[3:7])
        return rotation.reshape(3, 3)

    def places(self) -> Array:
        """(h, 3) [m] of the striking points."""
        return np.asarray(self.data.site_xpos[self.sites])

    def speeds_along(self, normal: Array) -> Array:
        """Speeds (h,) [m/s] of the striking points along a normal (3,); leaves their rows in `along`."""
        for k, site in enumerate(self.sites):
            self.mujoco.mj_jacSite(self.world, self.data, self._rows, None, site)
            self.along[k] = normal @ self._rows
        return np.asarray(self.along @ self.data.qvel)

    def apply(self, torque: Array, forces: Array | float) -> None:
        """Torque (n) [N m] at the joints, and the contacts' forces (h,) [N], against the normal."""
        applied = self.data.qfrc_applied
        applied[:] = -np.atleast_1d(forces) @ self.along
        applied[self.dof] += torque
