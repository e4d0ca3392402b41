"""Onset of a damped contact, at which accelerations jump: as variables, and as numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.contact.laws import ContactLaw
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Index, Measure, Place, percent
from impactopt.transcription.contact_blocks import FORCE_SCALE
from impactopt.transcription.contact_state import Contact
from impactopt.transcription.elimination import Turn, determined
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.limits import DIRECTIONS

TYPICAL = 100.0  # [rad/s^2]


class FirstInstant:
    """Variables and constraints of it.

    law : numbers of the contact law.  suffix : of the names of its place and variables.
    """

    def __init__(self, b: Builder, contact: Contact, law: dict[str, float], suffix: str) -> None:
        self._b, self.contact, self.law = b, contact, law
        self.place = Place.plain(f"first instant of contact{suffix}")

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(name + suffix, 1, size, **options)

        self.change = add("jump of acceleration", b.ny, scale=TYPICAL, labels=b.coordinates.labels)
        of_wrenches = {name: b.limits.of_wrenches[name] for name in ("scale", "labels")}
        self.w = add("jump of sole wrench", b.nw, **of_wrenches)
        self.f = add("first force", 1, scale=FORCE_SCALE)

    def instance(self) -> tuple[list[Affine], Array]:
        """Slots and parameters of the block ``first``."""
        b, state = self._b, self.contact.state
        slots = [state.y, state.legs, self.contact.u0[0], self.change[0], self.w[0], self.f[0]]
        law, robot = np.array([*self.law.values()]), b.robot
        before = np.array([float(b.problem.target.speed_before())])
        numbers = [b.problem.normal, law, before, robot.armature, robot.torque_limit, b.limits.units]
        return slots, np.concatenate(numbers)

    def add_rows(self, at: int) -> None:
        """``at``: number of the first output of its instance."""
        b, part = self._b, self._b.parts("first")
        term, share = "jump of acceleration", percent("of the joint's limit off")
        b.equal(term, self.place, DIRECTIONS[: b.coordinates.base], at + part["base"], b.limits.unbalanced)
        b.equal(term, self.place, b.robot.joint_names, at + part["joints"], share)
        b.equal("contact law", self.place, ["force"], at + part["law"], Measure("N", FORCE_SCALE, "off"))
        self._rotors = at + part["rotors"]

    @property
    def rotors(self) -> Index:
        """Numbers of the outputs that are the rotors' part of the gears' load, once constraints are there."""
        return np.asarray(self._rotors)

    def determined(self) -> list[Determined]:
        """All of it, as of one element."""
        groups = (self.change, self.w, self.f)
        return [determined(Turn.ELEMENT, np.concatenate([g.index(0) for g in groups]))]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write what it is for coordinates and rates (ny,) and legs (nl,) at contact."""
        b, law = self._b, type(self._b.problem.law)(**self.law)
        force, change, w, _ = jump(b.problem, b.coordinates, law, y, rates, legs)
        self.f.write(x, force)
        self.change.write(x, change)
        self.w.write(x, w)


def jump(
    problem: ImpactProblem, c: StanceCoordinates, law: ContactLaw, y: Array, rates: Array, legs: Array
) -> tuple[float, Array, Array, Array]:
    """First force [N] of all strikers; by how much it changes yddot (ny,) and the sole wrenches (6 a sole);
    and the joints' accelerations (n,) then, of a robot that has coasted until then.
    """
    model = problem.robot.model
    q, v, a = c.complete_motion(y, rates, np.zeros(c.ny), legs)
    data: Any = model.createData()
    upper = np.triu(pin.crba(model, data, q))
    inertia = upper + np.triu(upper, 1).T
    soles = c.sole_jacobians(q)[0] if c.legs else np.zeros((0, model.nv))
    hands = [model.getFrameId(problem.robot.striker(name).model_frame) for name in problem.strikers]
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    axes = pin.LOCAL_WORLD_ALIGNED
    found = [np.reshape(pin.getFrameJacobian(model, data, hand, axes), (6, model.nv))[:3] for hand in hands]
    rows = np.array([problem.normal @ jacobian for jacobian in found])
    rates = rows @ v - float(problem.target.speed_before())
    forces = np.array([float(law.branch(0.0, float(rate), True)) for rate in rates])
    both = np.linalg.solve(inertia, np.column_stack([soles.T, -forces @ rows]))
    spread, free = both[:, :-1], both[:, -1]
    w: Array = np.zeros(0)
    if len(soles):
        w = np.asarray(np.linalg.lstsq(soles @ spread, -soles @ free, rcond=None)[0])
    change = free + spread @ w
    base = change[: c.base].copy()
    if c.base:  # from the base's own frame to rates of its coordinates
        base[:3] = pin.rpy.rpyToMatrix(y[3:6]) @ base[:3]
        base[3:] = np.linalg.solve(pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL), base[3:])
    independent = np.concatenate([base, change[c.base :][c.independent]])
    return float(forces.sum()), independent, w, np.asarray((a + change)[c.base :])
