"""A punch by Crocoddyl, with its rigid impulse: a program by itself, `python crocoddyl_plan.py DIR`.

It runs in an environment of its own, with crocoddyl, pinocchio and numpy, and knows nothing of this package:
DIR has the robot and the task as numbers (`task.npz`), and gets what came of it (`plan.npz`).

As its own examples do it: swing, impulse and follow-through are one shooting problem of fixed times, solved
by box-FDDP. Soles are held, torques are bounded, all other limits are barriers in the cost. At the impulse
the hand is at the hit point and stops, as at a wall. Its speed there is rewarded: Crocoddyl has no cost of an
impulse (`ResidualModelContactForce` is zero at nodes without controls).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import crocoddyl
import numpy as np
import pinocchio as pin

STEP, DAMPING = 0.01, 20.0  # [s], [1/s] of soles that slip
ITERATIONS = 400
FAST = 100.0  # [m/s] wanted of the hand: so far off that the price of speed is linear
POSTURE, RATE, EFFORT = 1e-2, 1e-3, 1e-2  # prices of motion, of torques over their limits
LIMITS, CONES = 1e5, 1e1  # of joints and rates over their bounds, of wrenches over their cones
PLACE, ACROSS, SPEED = 1e6, 1e2, 3e-2  # of the hand off the point, of its speed across and along
REST = 1e4  # of what still moves at the end
HERE = pin.LOCAL_WORLD_ALIGNED


def model_of(task: dict[str, Any]) -> Any:
    """The robot: a free base, and joints that turn about an axis of theirs; frames of soles and striker."""
    model = pin.Model()
    for k, parent in enumerate(task["parents"]):
        axis, place = task["axes"][k], pin.SE3(task["places"][k])
        kind = pin.JointModelRevoluteUnaligned(axis) if axis.any() else pin.JointModelFreeFlyer()
        joint = model.addJoint(int(parent), kind, place, f"joint {k}" if k else "root_joint")
        body = pin.Inertia(task["masses"][k], task["levers"][k], task["inertias"][k])
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    model.armature = task["armature"]
    for name, joint, place in zip(task["frames"], task["frame_joints"], task["frame_places"], strict=True):
        model.addFrame(pin.Frame(str(name), int(joint), pin.SE3(place), pin.FrameType.OP_FRAME))
    return model


class Punch:
    """The shooting problem of a task."""

    def __init__(self, model: Any, task: dict[str, Any]) -> None:
        self.model, self.task = model, task
        self.state = crocoddyl.StateMultibody(model)
        self.actuation = crocoddyl.ActuationModelFloatingBase(self.state)
        self.q0, self.nu = task["q0"], self.actuation.nu
        data = model.createData()
        pin.framesForwardKinematics(model, data, self.q0)
        self.soles = [model.getFrameId(str(name)) for name in task["soles"]]
        self.places = [data.oMf[i].copy() for i in self.soles]
        self.hand = model.getFrameId(str(task["striker"]))

    def step(self, length: float = STEP, rest: float = 1.0) -> Any:
        """A node of swing or follow-through; without a length it is the end of it."""
        costs = crocoddyl.CostModelSum(self.state, self.nu)
        self._motion(costs, rest)
        share = crocoddyl.ActivationModelWeightedQuad(EFFORT / self.task["torque"] ** 2)
        self._add(costs, "effort", crocoddyl.ResidualModelControl(self.state, self.nu), share)
        for i in self.soles:
            cone = crocoddyl.WrenchCone(
                np.eye(3), self.task["friction"], self.task["box"], 4, True, self.task["least"], 1e5
            )
            residual = crocoddyl.ResidualModelContactWrenchCone(self.state, i, cone, self.nu, True)
            self._add(costs, f"cone {i}", residual, _barrier(cone.lb, cone.ub), CONES)
        contacts = crocoddyl.ContactModelMultiple(self.state, self.nu)
        for i, place in zip(self.soles, self.places, strict=True):
            sole = crocoddyl.ContactModel6D(
                self.state, i, place, pin.LOCAL, self.nu, np.array([0.0, DAMPING])
            )
            contacts.addContact(f"sole {i}", sole)
        dynamics = crocoddyl.DifferentialActionModelContactFwdDynamics(
            self.state, self.actuation, contacts, costs, 0.0, True
        )
        node = crocoddyl.IntegratedActionModelEuler(dynamics, length)
        node.u_lb, node.u_ub = -self.task["torque"], self.task["torque"]
        return node

    def impulse(self) -> Any:
        """The blow: soles stay, the hand stops."""
        impulses = crocoddyl.ImpulseModelMultiple(self.state)
        for i in self.soles:
            impulses.addImpulse(f"sole {i}", crocoddyl.ImpulseModel6D(self.state, i, pin.LOCAL))
        impulses.addImpulse("hand", crocoddyl.ImpulseModel3D(self.state, self.hand, HERE))
        costs = crocoddyl.CostModelSum(self.state, 0)
        at = crocoddyl.ResidualModelFrameTranslation(self.state, self.hand, self.task["point"], 0)
        self._add(costs, "place", at, crocoddyl.ActivationModelQuad(3), PLACE)
        n = self.task["normal"]
        wanted = pin.Motion(np.concatenate([FAST * n, np.zeros(3)]))
        speed = crocoddyl.ResidualModelFrameVelocity(self.state, self.hand, wanted, HERE, 0)
        weights = np.concatenate([np.where(np.abs(n) > 0.5, SPEED, ACROSS), np.zeros(3)])
        self._add(costs, "speed", speed, crocoddyl.ActivationModelWeightedQuad(weights))
        return crocoddyl.ActionModelImpulseFwdDynamics(self.state, impulses, costs, 0.0, 0.0, True)

    def _motion(self, costs: Any, rest: float) -> None:
        """Prices of states: away from the start, fast, over the bounds of joints and rates."""
        nv, nu = self.state.nv, self.nu
        x0 = np.concatenate([self.q0, np.zeros(nv)])
        weights = np.concatenate([np.full(nv, POSTURE), np.full(nv, RATE * rest)])
        away = crocoddyl.ResidualModelState(self.state, x0, nu)
        self._add(costs, "motion", away, crocoddyl.ActivationModelWeightedQuad(weights))
        at = crocoddyl.ResidualModelState(self.state, self.state.zero(), nu)
        self._add(costs, "limits", at, _barrier(self.task["lower"], self.task["upper"]), LIMITS)

    def _add(self, costs: Any, name: str, residual: Any, activation: Any, price: float = 1.0) -> None:
        costs.addCost(name, crocoddyl.CostModelResidual(self.state, activation, residual), price)


def _barrier(lower: Any, upper: Any) -> Any:
    return crocoddyl.ActivationModelQuadraticBarrier(crocoddyl.ActivationBounds(lower, upper))


def main(directory: Path) -> None:
    """Solve the task in there."""
    with np.load(directory / "task.npz") as file:
        task = {name: x if x.ndim else x.item() for name, x in file.items()}
    model = model_of(task)
    punch = Punch(model, task)
    before, after = (round(task[name] / STEP) for name in ("swing", "follow"))
    x0 = np.concatenate([task["q0"], np.zeros(model.nv)])
    nodes = [punch.step()] * before + [punch.impulse()] + [punch.step()] * after
    problem = crocoddyl.ShootingProblem(x0, nodes, punch.step(0.0, REST))
    solver = crocoddyl.SolverBoxFDDP(problem)
    begun = time.perf_counter()
    rest = [x0] * (problem.T + 1)
    solved = solver.solve(rest, problem.quasiStatic(rest[:-1]), ITERATIONS, False)
    seconds = time.perf_counter() - begun
    problem.calc(solver.xs, solver.us)
    felt = problem.runningDatas[before].multibody.impulses.impulses["hand"].f.linear
    np.savez(
        directory / "plan.npz",
        states=np.array(solver.xs),
        torques=np.array([u for k, u in enumerate(solver.us) if k != before]),
        impulse=-felt @ task["normal"],
        before=before,
        step=STEP,
        seconds=seconds,
        iterations=solver.iter,
        solved=solved,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
