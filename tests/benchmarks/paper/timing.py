"""Measured computation times of our own implementations, to set beside the paper's counts of operations.

What the paper counts is one evaluation of the equations of motion an iteration, without the integration
method's own cost:

* full: steps 1a to 4a with dense matrices: H by the composite-rigid-body algorithm, J, the bias, Cholesky
  decomposition and solve. The soles are not held, as the paper's virtual base is nothing but more mass.
* freeze: steps 1b and 2b of `SDC.paper`.
* stage: steps 3b to 7b, a quarter of one of its Runge-Kutta steps.
* aba: Pinocchio's articulated-body algorithm, without its Python call, which is measured on a pendulum.

The first three are compiled functions that run many times inside C. All are timed in turns, so that the
machine's moods meet them alike; each time is a median of the thread's own, as a busy machine would make short
calls appear longer than long ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.clock import medians, runner
from impactopt.codegen.cache import cached, model_hash
from impactopt.collision import SDC
from impactopt.collision.graph import frozen_dynamics, joint_space_model, rk4_step
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot

Array = NDArray[np.float64]
MANY = 20  # evaluations inside C a call; with more their outputs would fill the caches
STEPS = 200  # of the time loop a call
STAGES = 4  # of a Runge-Kutta step


@dataclass(frozen=True, kw_only=True)
class Times:
    """[s] of one evaluation each; `call` is Pinocchio's call from Python, taken off from `aba`. `full` is
    None where it has not been measured."""

    full: float | None
    freeze: float
    stage: float
    aba: float
    call: float

    def ratio_1(self, count: float) -> float | None:
        """C_2 / C_1 (21) for that many iterations."""
        return None if self.full is None else (self.freeze + self.stage * count) / (self.full * count)

    def ratio_3(self, count: float) -> float:
        """C_2 / C_3 (23)."""
        return (self.freeze + self.stage * count) / (self.aba * count)

    def microseconds(self) -> dict[str, float | None]:
        values = {name: getattr(self, name) for name in ("full", "freeze", "stage", "aba", "call")}
        return {f"{name}_us": None if x is None else 1e6 * x for name, x in values.items()}


def measure(robot: Robot, q: Array, v: Array, striker: str, *, full: bool = True) -> Times:
    """Times on a robot at q (nq), v (nv); compiles what it needs.

    full : whether to measure steps 1a to 4a, whose dense code takes long to compile for large robots.
    """
    sdc = SDC.paper(robot, striker=striker, normal=[1.0, 0.0, 0.0])
    freeze, steps = _sdc_functions(sdc)
    numbers = {**sdc.settings, "target_start": np.array([0.2, 0.0])}
    frozen = freeze.call([q, v, numbers["normal"], numbers["target_start"]])
    frozen = [np.array(x)[:, :1] for x in frozen]
    start = np.zeros(steps.size1_in(0))
    given = dict(zip(freeze.name_out(), frozen, strict=True)) | dict(sdc.settings)
    tau = np.zeros(robot.n)
    runs: dict[str, Callable[[], Any]] = {
        "freeze": runner(freeze, [_many(x) for x in (q, v, numbers["normal"], numbers["target_start"])]),
        "stage": runner(steps, [start, *(given[name] for name in steps.name_in()[1:])]),
        **_pinocchio(robot.model, q, v),
    }
    shares = {"freeze": MANY, "stage": STEPS * STAGES, "aba": 1, "call": 1}
    if full:
        runs["full"] = runner(_full(robot, striker), [_many(x) for x in (q, v, tau, np.array(100.0))])
        shares["full"] = MANY
    medians_of = medians(runs, clock=time.thread_time)
    found = {name: seconds / shares[name] for name, seconds in medians_of.items()}
    return Times(
        full=found.get("full"),
        freeze=found["freeze"],
        stage=found["stage"],
        aba=found["aba"] - found["call"],
        call=found["call"],
    )


# ---------------------------------------------------------------- functions
def _sdc_functions(sdc: SDC) -> tuple[Any, Any]:
    """(freeze, MANY times; STEPS steps of the time loop)."""
    model, frozen = joint_space_model(sdc), frozen_dynamics(sdc)

    def build() -> list[Any]:
        step = rk4_step(model, sdc.step_of_graph)
        y, data = ca.MX.sym("y", model.n_states), model.symbols(ca.MX)
        end = y
        for _ in range(STEPS):
            end = step(end, *data.values())
        once = frozen.function("once", model.frozen)
        return [
            _repeated("freeze", once),
            ca.Function("steps", [y, *data.values()], [end], ["y", *data], ["end"]),
        ]

    frame = sdc.robot.striker(sdc.striker).model_frame
    recipe = (
        model_hash(sdc.robot.model),
        frame,
        repr(sdc.held_by),
        sdc.effects,
        sdc.step_length,
        MANY,
        STEPS,
    )
    functions = cached("timing_sdc", recipe, build)
    return functions["freeze"], functions["steps"]


def _full(robot: Robot, striker: str) -> Any:
    """Steps 1a to 4a, MANY times: (q, v, torque, force) -> acceleration of the striking point."""
    frame = robot.striker(striker).model_frame

    def build() -> list[Any]:
        rb = RigidBody(robot.model)
        n, base = robot.nv, robot.nv - robot.n
        # dense, whatever the tree's shape
        tree = ca.Function(
            "tree",
            [rb.q, rb.v],
            [
                ca.densify(rb.mass_matrix()),
                ca.densify(rb.jacobian(frame)[:3, :]),
                ca.densify(rb.rnea(rb.v, None)),
                ca.densify(rb.frame_acceleration(frame, rb.v, None)[:3]),
            ],
        )
        q, v = ca.MX.sym("q", rb.nq), ca.MX.sym("v", n)
        torque, force = ca.MX.sym("torque", robot.n), ca.MX.sym("force")
        H, J, bias, drift = tree(q, v)
        push = ca.vertcat(ca.MX.zeros(base), torque) - J[0, :].T * force - bias
        acceleration = _cholesky_solve(n)(H, push)
        once = ca.Function("once", [q, v, torque, force], [ca.mtimes(J, acceleration) + drift])
        return [_repeated("full", once)]

    return cached("timing_full", (model_hash(robot.model), frame, MANY), build)["full"]


def _cholesky_solve(n: int) -> Any:
    """ca.Function (H (n, n) dense, b (n)) -> H^-1 b."""
    H, b = ca.SX.sym("H", n, n), ca.SX.sym("b", n)
    R: list[list[Any]] = [[] for _ in range(n)]
    x: list[Any] = []
    for i in range(n):
        for j in range(i + 1):
            entry = H[i, j]
            for k in range(j):
                entry = entry - R[i][k] * R[j][k]
            R[i].append(ca.sqrt(entry) if i == j else entry / R[j][j])
        entry = b[i]
        for k in range(i):
            entry = entry - R[i][k] * x[k]
        x.append(entry / R[i][i])
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] = x[i] - R[k][i] * x[k]
        x[i] = x[i] / R[i][i]
    return ca.Function("cholesky_solve", [H, b], [ca.vertcat(*x)])


def _repeated(name: str, once: Any) -> Any:
    """MANY evaluations as a loop in C, over columns."""
    many = once.map(MANY)
    inputs = [ca.MX.sym(key, *many.size_in(key)) for key in once.name_in()]
    return ca.Function(name, inputs, many.call(inputs), once.name_in(), once.name_out())


def _many(x: Any) -> Array:
    return np.tile(np.reshape(x, (-1, 1)), (1, MANY))


def _pinocchio(model: Any, q: Array, v: Array) -> dict[str, Callable[[], Any]]:
    data, tau = model.createData(), np.zeros(model.nv)
    pendulum = pin.Model()
    pendulum.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "pendulum")
    pendulum.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    own, zero = pendulum.createData(), np.zeros(1)
    return {
        "aba": lambda: pin.aba(model, data, q, v, tau),
        "call": lambda: pin.aba(pendulum, own, zero, zero, zero),
    }
