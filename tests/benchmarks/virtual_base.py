"""How exact is the paper's virtual base, and how heavy may it be?

The paper holds the soles by a mass M_g and an inertia I_g added to them (its eqs. 1 to 4). Here M_g and I_g
go from 1e2 to 1e16 kg (kg m2), and two forms of the same thing are compared with soles that are held exactly:
ours, 1/M_g on the diagonal of the soles' Delassus matrix; and the paper's to the letter, huge inertias in H
and its Cholesky factorization. What is measured is the effective mass at the hand, and the impulse of one
collision of the paper's model. Effective masses also in 60-digit arithmetic, which tells what the model
leaves out from what rounding adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Context, Decimal, localcontext
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.pictures.virtual_base import virtual_base_picture
from benchmarks.report import Report, Say, columns_table
from impactopt.collision import SDC
from impactopt.collision.graph import frozen_dynamics, joint_space_model, rk4_step
from impactopt.collision.graph import run as time_loop
from impactopt.collision.stepped import number_of_steps
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.kinematics.stance import BothSoles
from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot

Array = NDArray[np.float64]

ROBOTS = ("standin", "talos")
# [kg] on to where the literal form's factorization breaks down; the paper has 1e5
MASSES = tuple(float(f"{m:.4g}") for m in np.logspace(2, 16, 29))
POSTURE, STRIKER, NORMAL = "half_sitting", "right_hand", (1.0, 0.0, 0.0)
SPEED = 0.7  # [m/s] of the hand at contact: the middle one of the paper's
DIGITS = 60

COLUMNS = (
    ("M_g kg", "M_g", ".0e"),
    ("model alone", "error_60_digits", ".0e"),
    ("ours", "error_model", ".0e"),
    ("literal", "error_literal", ".0e"),
    ("impulse, ours", "impulse_error_model", ".0e"),
    ("impulse, literal", "impulse_error_literal", ".0e"),
    ("rounding, ours", "rounding_model", ".0e"),
    ("rounding, literal", "rounding_literal", ".0e"),
)
EXACT = (
    ("robot", "robot", 0),
    ("posture", "posture", 0),
    ("effective mass kg", "mass_kg", 3),
    ("rounding", "rounding", ".0e"),
)


def run(say: Say, *, robots: Sequence[str] = ROBOTS, masses: Sequence[float] = MASSES) -> Report:
    """One row a robot and mass; errors are relative, against soles that are held exactly."""
    rows, exact = [], []
    for name in robots:
        say(f"{name}: virtual bases of {min(masses):g} to {max(masses):g} kg")
        robot = load_robot(name)
        rows += rows_of(robot, masses)
        exact += exact_rows(robot)
    tables = tuple(
        columns_table(
            f"{name}: relative errors against exactly fixed soles",
            COLUMNS,
            [_shown(r) for r in rows if r["robot"] == name],
        )
        for name in robots
    )
    shown = [_shown(r) for r in exact]
    tables += (columns_table("soles held exactly (the default): rounding", EXACT, shown),)
    numbers = {
        "rows": rows,
        "exact": exact,
        "posture": POSTURE,
        "striker": STRIKER,
        "normal": list(NORMAL),
        "approach_speed_m_s": SPEED,
        "digits": DIGITS,
    }
    figures = {"virtual_base": lambda: virtual_base_picture(rows)}
    return Report(name="virtual-base", numbers=numbers, tables=tables, figures=figures)


def rows_of(robot: Robot, masses: Sequence[float]) -> list[dict[str, Any]]:
    """One row a mass. `rounding_...`: against 60-digit arithmetic with the same mass."""
    q = robot.postures[POSTURE]
    ours = _ours(robot, None, q)
    body = _body(robot, q)
    exact = exact_inverse_mass(body, NORMAL, 0)
    strike = _strike(robot)
    impulse = strike(ours)
    rows = []
    for mass in masses:
        wanted = exact_inverse_mass(body, NORMAL, Decimal(1) / Decimal(mass))
        found = _ours(robot, mass, q)
        row: dict[str, Any] = {
            "robot": robot.name,
            "M_g": mass,
            "error_60_digits": _off(exact, wanted),
            "error_model": _off(exact, found["m"]),
            "rounding_model": _off(wanted, found["m"]),
            "impulse_error_model": abs(strike(found) / impulse - 1),
            **dict.fromkeys(("error_literal", "rounding_literal", "impulse_error_literal", "reason")),
        }
        try:
            literal = _literal(robot, mass, q)
            row |= {
                "error_literal": _off(exact, literal["m"]),
                "rounding_literal": _off(wanted, literal["m"]),
                "impulse_error_literal": abs(strike(literal) / impulse - 1),
            }
        except InputError as error:
            row["reason"] = str(error)
        rows.append(row)
    return rows


def exact_rows(robot: Robot) -> list[dict[str, Any]]:
    """Rounding of the default, held exactly, in the bench's posture and on straight legs."""
    rows = []
    for name, q in ((POSTURE, robot.postures[POSTURE]), ("straight", pin.neutral(robot.model))):
        wanted, found = exact_inverse_mass(_body(robot, q), NORMAL, 0), _ours(robot, None, q)["m"]
        row = {"robot": robot.name, "posture": name, "mass_kg": 1 / float(wanted)}
        rows.append(row | {"rounding": _off(wanted, found)})
    return rows


def _off(exact: Decimal, found: Any) -> float:
    """Relative error of the effective mass, from the inverse masses [1/kg]."""
    with localcontext(Context(prec=DIGITS)):
        other = found if isinstance(found, Decimal) else Decimal(np.asarray(found).item())
        return float(abs(exact / other - 1))


# ---------------------------------------------------------------- two forms in double precision
def _model(robot: Robot, mass: float | None) -> SDC:
    return SDC.paper(
        robot, striker=STRIKER, normal=NORMAL, stance=BothSoles(base_mass=mass, base_inertia=mass)
    )


def _ours(robot: Robot, mass: float | None, q: Array) -> dict[str, Array]:
    """What the SDC freezes: A, s and m of `impactopt.collision.frozen`; None: soles held exactly."""
    function = frozen_dynamics(_model(robot, mass)).function("frozen", ("A", "s", "m"))
    found = function(q, np.zeros(robot.nv), NORMAL, 0.0)
    return {name: np.array(x) for name, x in zip(("A", "s", "m"), found, strict=True)}


def _literal(robot: Robot, mass: float, q: Array) -> dict[str, Array]:
    """The same three with mass and inertia added to the links of the soles, so that nothing is held.

    Raises
    ------
    InputError : H is not positive definite any more.
    """
    model = pin.Model(robot.model)
    for name in BothSoles().sole_frames(robot):
        frame = model.frames[model.getFrameId(name)]
        inertia = pin.Inertia(mass, np.zeros(3), mass * np.eye(3))
        model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
    body = _body(robot, q, model)
    try:
        root = np.linalg.cholesky(body.inertia)
    except np.linalg.LinAlgError as error:
        raise InputError(f"Cholesky factorization of H: {error}") from error
    joints = np.linalg.solve(root, np.eye(robot.nv)[:, -robot.n :])
    row = np.linalg.solve(root, np.array(NORMAL) @ body.hand)
    A = joints.T @ joints
    # its lower triangle by columns is its upper one by rows
    return {"A": A[np.triu_indices(robot.n)], "s": joints.T @ row, "m": np.atleast_1d(row @ row)}


def _strike(robot: Robot) -> Any:
    """Function of A, s and m -> impulse [N s] of the paper's collision, the same time loop for both forms."""
    collision = _model(robot, None)
    model = joint_space_model(collision)
    data = model.symbols(ca.MX)
    step = rk4_step(model, collision.step_of_graph)
    steps = number_of_steps(collision)
    final, _ = time_loop(model, step, ca.MX(model.start()), steps, list(data.values()), record=False)
    function = ca.Function("impulse", list(data.values()), [model.part(final, "impulse")])
    settings: dict[str, Any] = {**collision.settings, "hand_speed": SPEED}
    return lambda frozen: float(function(*[(settings | frozen)[name] for name in data]))


# ---------------------------------------------------------------- many digits
def _body(robot: Robot, q: Array, model: Any = None) -> ConstrainedDynamics:
    """Of the robot, or of a model with its frames."""
    frames = BothSoles().sole_frames(robot)
    return ConstrainedDynamics.at(
        robot.model if model is None else model, q, frames, robot.striker(STRIKER).model_frame
    )


def exact_inverse_mass(body: ConstrainedDynamics, normal: Any, compliance: Decimal | int) -> Decimal:
    """[1/kg] n' J P J' n with that compliance [1/kg, 1/(kg m2)] of the soles, in 60-digit arithmetic."""
    with localcontext(Context(prec=DIGITS)):
        rows = _decimals(np.vstack([body.held, np.asarray(normal) @ body.hand]))
        inner = rows @ _solved(_decimals(body.inertia), rows.T)
        c = len(body.held)
        held = inner[:c, :c] + np.diag([Decimal(compliance)] * c)
        lost = inner[c, :c] @ _solved(held, inner[:c, c:])
        return Decimal(inner[c, c] - lost[0])


def _decimals(numbers: Array) -> Any:
    """The same numbers, exactly."""
    return np.vectorize(Decimal, otypes=[object])(numbers)


def _solved(matrix: Any, right: Any) -> Any:
    """matrix^-1 right by elimination without pivots, as the matrix is positive definite."""
    n = len(matrix)
    both = np.hstack([matrix, right])
    for k in range(n):
        both[k] = both[k] / both[k, k]
        others = [i for i in range(n) if i != k]
        both[others] = both[others] - np.outer(both[others, k], both[k])
    return both[:, n:]


def _shown(row: dict[str, Any]) -> dict[str, Any]:
    return {key: "fails" if value is None else value for key, value in row.items()}
