"""What other programs take for the same collision: MuJoCo, Pinocchio, and CasADi's interface to CVODES."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.setup import Setup
from impactopt.collision import Collision
from impactopt.collision.graph import frozen_dynamics, joint_space_model, target_start
from impactopt.simulation.mujoco_world import mujoco_module, no_log_file
from impactopt.simulation.pinocchio_robot import PinocchioBody
from impactopt.simulation.reference import FullDynamics, MujocoDynamics
from impactopt.simulation.reference.mujoco_dynamics import WeldedRobot, march

Array = NDArray[np.float64]


# ---------------------------------------------------------------- MuJoCo
def _world(setup: Setup, step: float) -> tuple[MujocoDynamics, WeldedRobot]:
    model = setup.model(MujocoDynamics, step=step)
    robot, frames, _, striker = model._body_arguments
    with no_log_file():
        return model, WeldedRobot(robot, frames, striker, step)


def mujoco_loop(setup: Setup, step: float) -> Callable[[], Collision]:
    """A collision in MuJoCo, with servo, contact law and records from Python, in a world made once."""
    model, world = _world(setup, step)
    case = setup.case
    soles = len(model.held_by.sole_names(case.robot))

    def run() -> Collision:
        forces, normal = model._forces(case.v, case.torque, {})
        world.mujoco.mj_resetData(world.world, world.data)
        world.start(case.q, case.v)
        with no_log_file():
            return march(world, forces, normal, model.horizon, soles)

    return run


def mujoco_steps(setup: Setup, step: float, duration: float) -> Callable[[], None]:
    """MuJoCo's own steps for as long as the contact [s], and nothing else: no law, no servo, no records.

    Its solver has MuJoCo's default tolerance and iterations. A bound from below on what a collision costs it.
    """
    world, count = _steps_alone(setup, step), max(1, round(duration / step))
    mujoco = world.mujoco

    def run() -> None:
        mujoco.mj_resetData(world.world, world.data)
        world.start(setup.case.q, setup.case.v)
        world.data.qfrc_applied[world.dof] = setup.case.torque
        mujoco.mj_step(world.world, world.data, count)

    return run


def mujoco_rollouts(
    setup: Setup, step: float, duration: float, batch: int, threads: int
) -> Callable[[], Any]:
    """`batch` times those steps, by MuJoCo's own batched rollout."""
    from mujoco import rollout

    world, count = _steps_alone(setup, step), max(1, round(duration / step))
    mujoco = world.mujoco
    world.start(setup.case.q, setup.case.v)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(world.world, kind))
    mujoco.mj_getState(world.world, world.data, state, kind)
    many = np.tile(state, (batch, 1))
    data = [mujoco.MjData(world.world) for _ in range(threads)]
    # servo and law need the interpreter: the robot moves freely
    pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
    return lambda: pool.rollout(world.world, data, many, nstep=count)


def _steps_alone(setup: Setup, step: float) -> WeldedRobot:
    mujoco = mujoco_module()
    _, world = _world(setup, step)
    usual = mujoco.MjSpec().compile().opt
    world.world.opt.iterations, world.world.opt.tolerance = usual.iterations, usual.tolerance
    return world


# ---------------------------------------------------------------- Pinocchio
def pinocchio_calls(setup: Setup) -> dict[str, Callable[[], Any]]:
    """Pinocchio's functions for each stage, called from Python; `call` is the call of one on a pendulum."""
    case = setup.case
    robot, q, v = case.robot, case.q, case.v
    model, data = robot.model, robot.model.createData()
    body = PinocchioBody(*setup.model(FullDynamics)._body_arguments, case.normal)
    torque = np.concatenate([np.zeros(robot.nv - robot.n), case.torque])
    held = (body._constraints, body._constraint_data, body._proximal)
    pendulum = pin.Model()
    pendulum.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "pendulum")
    pendulum.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    own_data, zero = pendulum.createData(), np.zeros(1)

    def kinematics() -> None:
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)

    pin.crba(model, data, q)
    return {
        "call": lambda: pin.crba(pendulum, own_data, zero),
        "kinematics": kinematics,
        "H": lambda: pin.crba(model, data, q),
        "factorization": lambda: pin.cholesky.decompose(model, data),
        "bias": lambda: pin.nonLinearEffects(model, data, q, v),
        "constrained dynamics": (
            lambda: (
                pin.constraintDynamics(model, body._dynamics, q, v, torque, *held)
                if body.frames
                else pin.aba(model, body._dynamics, q, v, torque)
            )
        ),
    }


# ---------------------------------------------------------------- CVODES
def cvodes(setup: Setup, duration: float, tolerance: float) -> tuple[Callable[[], Any], Callable[[], float]]:
    """The frozen collision from contact to a duration [s] that is given to it, by CasADi's `integrator`.

    Returns what makes one, and what gives the impulse [N s]. Its right-hand side runs in CasADi's virtual
    machine, as CVODES is not for code generation; the freeze is not in it.
    """
    sdc, case = setup.model(), setup.case
    model = joint_space_model(sdc)
    y, data = ca.SX.sym("y", model.n_states), model.symbols()
    rate = model.rate_of_change(y, model.velocity_change(y, data), data)
    problem = {"x": y, "p": ca.vertcat(*map(ca.vec, data.values())), "ode": rate}
    options = {"reltol": tolerance, "abstol": 1e-2 * tolerance, "max_num_steps": 100_000}
    solver = ca.integrator("collision", "cvodes", problem, 0.0, duration, options)
    freeze = frozen_dynamics(sdc).function("frozen", model.frozen)
    yields = target_start(model.target, model.target_numbers(dict(sdc.settings)))
    frozen = dict(zip(freeze.name_out(), freeze.call([case.q, case.v, case.normal, yields]), strict=True))
    known = {**frozen, **sdc.settings, "feedforward": case.torque}
    p = ca.vertcat(*[ca.vec(ca.DM(known[name])) for name in data])
    start = ca.DM(model.start())

    def run() -> Any:
        return solver(x0=start, p=p)["xf"]

    return run, lambda: float(model.part(run(), "impulse"))
