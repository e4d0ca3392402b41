"""Stress cases that are not one collision of one compiled model: virtual bases, many freezes, bad models."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.stability_robots import make_robot
from benchmarks.virtual_base import exact_inverse_mass
from impactopt.collision import SDC, effective_mass
from impactopt.contact import FreeMass, SpringDamper
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.kinematics.stance import BothSoles
from impactopt.simulation.reference import FullDynamics

MASSES = tuple(10.0**k for k in range(2, 16))  # [kg] M_g under the soles
FREEZES = (1, 2, 4, 8, 32, 100, 300, 1000)
X = np.array([1.0, 0.0, 0.0])
LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=5.0)

# (verdict, reason, error, case)
Found = tuple[str, str, float, str]


def masses_of(mass: float, cases: int, seed: int) -> list[Found]:
    """Effective masses of a walker on a virtual base, straight legs among its postures, in 60 digits."""
    robot = make_robot("walker")
    stance = BothSoles(base_mass=mass, base_inertia=mass)
    function = effective_mass(robot, striker="tip", normal=X, stance=stance)
    rng = np.random.default_rng([seed, int(np.log10(mass))])
    found = []
    for k in range(cases):
        dq = np.zeros(robot.nv)
        # straight legs, with the arm bent
        first = robot.nv - 3 if k % 3 == 0 else robot.nv - robot.n
        dq[first:] = rng.uniform(-0.8, 0.8, robot.nv - first)
        q = pin.integrate(robot.model, pin.neutral(robot.model), dq)
        body = ConstrainedDynamics.at(
            robot.model, q, stance.sole_frames(robot), robot.striker("tip").model_frame
        )
        expected = 1.0 / float(exact_inverse_mass(body, X, 1 / Decimal(mass)))
        error = abs(float(function(q)) / expected - 1.0)
        verdict = "nan" if np.isnan(error) else "agree" if error < 1e-6 else "wrong"
        found.append((verdict, "60 digits", error, f"effective mass, M_g = {mass:g} kg, q = {q.tolist()}"))
    return found


def freezes_of(counts: tuple[int, ...]) -> list[Found]:
    """The error against full dynamics, which has to fall with the square of the number of freezes.

    From one number to the next, within a factor of two: one freeze is at contact, and better than its order.
    """
    robot = make_robot("arm")
    common: dict[str, Any] = {"robot": robot, "striker": "tip", "normal": X, "law": LAW, "target": TARGET}
    q, v, torque = np.array([0.3, 0.5, 0.4]), np.array([0.3, 0.2, 0.1]), np.zeros(3)
    truth, _ = FullDynamics(**common, horizon=0.2).converged(q, v, torque, tolerance=1e-6)
    found: list[Found] = []
    before: tuple[int, float] | None = None
    for count in counts:
        what = f"{count} freezes"
        try:
            model = SDC(**common, freezes=count, horizon=0.2, accuracy=None)
            impulse = model.collide(q, v, torque).impulse
        except InputError as refusal:
            found.append(("refused", str(refusal)[:60], 0.0, what))
            continue
        error = abs(impulse / truth.impulse - 1.0)
        if np.isnan(error):
            found.append(("nan", "impulse", error, what))
            continue
        allowed = np.inf if before is None else max(2.0 * before[1] * (before[0] / count) ** 2, 1e-5)
        before = count, error
        found.append(("agree" if error <= allowed else "wrong", "full dynamics", error, what))
    return found


def refusals() -> list[Found]:
    """Models and numbers that have to be refused before any work is done."""
    arm = make_robot("arm")
    common: dict[str, Any] = {"robot": arm, "striker": "tip", "normal": X}
    sound = SDC(**common, law=LAW, target=TARGET)
    q, v, torque = np.zeros(3), np.zeros(3), np.zeros(3)
    none, endless = np.full(3, np.nan), np.full(3, np.inf)
    tries: dict[str, Any] = {
        "infinite target mass": lambda: FreeMass(mass=np.inf),
        "no target mass": lambda: FreeMass(mass=0.0),
        "infinite mass in collide": lambda: sound.collide(q, v, torque, target_mass=np.inf),
        "no stiffness": lambda: sound.collide(q, v, torque, contact_stiffness=0.0),
        "negative damping": lambda: sound.collide(q, v, torque, contact_damping=-1.0),
        "negative kd": lambda: sound.collide(q, v, torque, kd=-1.0),
        "no torque limit": lambda: sound.collide(q, v, torque, torque_limit=0.0),
        "NaN kp": lambda: sound.collide(q, v, torque, kp=none),
        "NaN q": lambda: sound.collide(none, v, torque),
        "infinite v": lambda: sound.collide(q, endless, torque),
        "NaN torque": lambda: sound.collide(q, v, none),
        "no torque": lambda: sound.collide(q, v),
        "too many steps": lambda: SDC(**common, law=LAW, target=TARGET, step=1e-9),
        "negative freezes": lambda: SDC(**common, law=LAW, target=TARGET, freezes=-1),
    }
    found: list[Found] = []
    for what, attempt in tries.items():
        try:
            attempt()
        except InputError:
            found.append(("refused", "bad input", 0.0, what))
        else:
            found.append(("wrong", f"not refused: {what}", 0.0, what))
    return found
