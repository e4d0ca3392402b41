"""Predicts a program's solution for changed parameters by a few quadratic programs.

Each has the changed program's constraints made linear, and the known solution's Hessian. Its active set is
found by Newton's method on its augmented Lagrangian, with exact line searches: constraints that begin to hold
and constraints that let go are no matter, where a step with the solution's own active set is off.

Source: Hermans, Themelis, Patrinos, "QPALM: a Newton-type proximal augmented Lagrangian method for quadratic
programs", CDC 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from impactopt.solvers.ipm.newton import acquire
from impactopt.solvers.program import Matrix, NonlinearProgram, Vector, max_violation
from impactopt.solvers.threads import threads

__all__ = ["Prediction", "Predictor"]

Sides = npt.NDArray[np.int8]
_WEIGHT = 1e6  # of the augmented Lagrangian: a constraint is off by a multiplier's change over it
_WEAK = 1e-4  # multiplier of a constraint that hardly holds
_PROXIMAL = 1e-2  # curvature more of every variable, so that what hardly matters stays
_STEPS, _SETS = 5, 20  # QPs, and active sets of each
_SHORT, _JAMMED = 0.1, 5  # so many line searches that are so short: it stalls
_ENOUGH = 1e-4  # of constraints: no more QPs


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Variables (n,), multipliers of rows (m,) and bounds (n,), by how much constraints or bounds are off at
    most, and after how many QPs.
    """

    x: Vector
    y: Vector
    z: Vector
    violation: float
    steps: int


class Predictor:
    """Predicts from one solution of a program: x (n,), y (m,) and z (n,) as of
    `impactopt.solvers.program.SolverResult`.

    A solver leaves it with slack at constraints that hold, and with small multipliers at those that do not.
    Both are kept, so that numbers that do not change give back the solution itself.
    """

    def __init__(self, program: NonlinearProgram, x: Vector, y: Vector, z: Vector) -> None:
        self.x, self.y, self.z = x, y, z
        jacobian, self._hessian = program.jacobian(x), program.hessian(x, 1.0, y).copy()
        self._moves = program.x_upper - program.x_lower > 1e-12
        bounded = (np.isfinite(program.x_lower) | np.isfinite(program.x_upper)) & self._moves
        self._newton = acquire(
            jacobian,
            self._hessian,
            determined=getattr(program, "determined", ()),
            equal=program.g_lower == program.g_upper,
            bounded=bounded,
            moves=self._moves,
        )
        # variables whose bounds are no rows of the condenser
        self._free = np.zeros(program.n, dtype=bool)
        self._free[self._newton.condenser.free] = bounded[self._newton.condenser.free]
        lower, upper = self._bounds(program)
        self._equal = lower == upper
        limited = np.isfinite(lower) | np.isfinite(upper)
        self._inequal = rows = np.flatnonzero(~self._equal & limited)
        values, own = np.concatenate([program.constraints(x), x])[rows], np.concatenate([y, z])[rows]
        self._weak = np.where(np.abs(own) < _WEAK, own, 0.0)
        slack = np.maximum(np.where(own > 0, upper[rows] - values, values - lower[rows]), 0.0)
        self._slack = np.where(self._weak == own, 0.0, slack)
        self._sides = np.sign(own - self._weak).astype(np.int8)

    def _bounds(self, program: NonlinearProgram) -> tuple[Vector, Vector]:
        """Bounds of constraints and variables; infinite for variables that do not move."""
        lower, upper = (
            np.where(self._moves, program.x_lower, -np.inf),
            np.where(self._moves, program.x_upper, np.inf),
        )
        return np.concatenate([program.g_lower, lower]), np.concatenate([program.g_upper, upper])

    def predict(self, program: NonlinearProgram) -> Prediction | None:
        """Prediction for the same program with other parameters; None if a QP's active set is not found.

        QP after QP from where the one before led, while constraints are off and it helps.
        """
        found: Prediction | None = None
        x, y, z, sides = self.x, self.y, self.z, self._sides
        g = program.constraints(x)
        with threads().limit(limits=1, user_api="blas"):
            for k in range(_STEPS):
                if not np.isfinite(g).all():
                    break
                qp = _QP(self, program, x, g, np.concatenate([y, z]))
                if not qp.solve(sides):
                    break
                x = np.clip(x + qp.d, program.x_lower, program.x_upper)
                (y, z), sides, g = qp.multipliers(), qp.sides, program.constraints(x)
                violation = max_violation(program, x, g)
                if found is not None and not violation < found.violation:
                    break
                found = Prediction(x=x, y=y, z=z, violation=violation, steps=k + 1)
                if violation <= _ENOUGH:
                    break
        return found


class _QP:
    """Minimize 1/2 d'Hd + q'd with all constraints and bounds made linear at x.

    Attributes
    ----------
    d : the step (n,).  sides : of inequalities, 1 where the upper bound holds, -1 the lower one, 0 none.
    """

    def __init__(self, of: Predictor, program: NonlinearProgram, x: Vector, g: Vector, own: Vector) -> None:
        self._of, self._newton = of, of._newton
        self._m, rows = program.m, of._inequal
        self._jacobian: Matrix = program.jacobian(x)
        lower, upper = of._bounds(program)
        values = np.concatenate([g, x])
        self._off = np.where(of._equal, values - lower, 0.0)
        self._off[program.m :] = 0.0
        self._values = values[rows]
        self._lower = lower[rows] + np.where(of._sides < 0, of._slack, 0.0)
        self._upper = upper[rows] - np.where(of._sides > 0, of._slack, 0.0)
        self._own = own[rows] - of._weak
        self._constant = np.zeros(len(values))
        self._constant[rows] = of._weak
        self._gradient = program.gradient(x)
        self._q = self._gradient + self._pulled(self._constant)
        self.d, self.sides = np.zeros(len(x)), of._sides

    def _pulled(self, multipliers: Vector) -> Vector:
        out: Vector = self._jacobian.T @ multipliers[: self._m] + multipliers[self._m :]
        return out

    def solve(self, sides: Sides) -> bool:
        """Iterates from an active set (as of `sides`) towards the solution's; true if it gets there."""
        rows, short = self._of._inequal, 0
        at = np.zeros(len(rows))
        for k in range(_SETS):
            d = self._step(sides)
            if d is None or not np.isfinite(d).all():
                return False
            moved = np.concatenate([self._jacobian @ d, d])[rows]
            # later steps end where the augmented Lagrangian is least: full ones may jump between active sets
            # for ever
            part = 1.0 if not k else self._length(d - self.d, at, moved - at)
            short += part < _SHORT
            if short == _JAMMED:
                return False
            self.d, at = self.d + part * (d - self.d), at + part * (moved - at)
            new = np.sign(self._pull(at)).astype(np.int8)
            settled = bool((new == sides).all())
            self.sides = sides = new
            if settled:
                break
        return True

    def _pull(self, at: Vector) -> Vector:
        """Multipliers of inequalities whose linear values have changed by ``at``."""
        values, weight = self._values + at, _WEIGHT
        above = self._own + weight * (values - self._upper)
        below = self._own + weight * (values - self._lower)
        out: Vector = np.where(above > 0, above, np.where(below < 0, below, 0.0))
        return out

    def _step(self, sides: Sides) -> Vector | None:
        """The minimum where these sides hold, and its multipliers."""
        c, of, m, rows = self._newton.condenser, self._of, self._m, self._of._inequal
        weights, off = np.zeros(len(self._off)), self._off.copy()
        on = sides != 0
        weights[rows[on]] = _WEIGHT
        bound = np.where(sides > 0, self._upper, self._lower)[on]
        off[rows[on]] = self._values[on] - bound + self._own[on] / _WEIGHT
        of_free = weights[m:] * of._free
        condensed = np.concatenate([weights[:m], weights[m:][c.bounded]])[c.rows]
        try:
            factored = self._newton.factor(
                self._jacobian,
                of._hessian,
                of_free[c.free],
                lambda more: condensed,
                hard=True,
                proximal=_PROXIMAL,
            )
        except np.linalg.LinAlgError:
            return None
        if not factored:
            return None
        d, found = self._newton.solve(
            self._q + of_free * off[m:], np.concatenate([off[:m], off[m:][c.bounded]])
        )
        self._y = np.zeros(len(self._off))
        self._y[:m] = found[:m]
        self._y[m:][c.bounded] = found[m:]
        self._y[m:] += of_free * (d + off[m:])
        return d

    def _length(self, step: Vector, at: Vector, along: Vector) -> float:
        """Step length that minimizes the augmented Lagrangian along a step, 1 at most."""
        hessian, more = self._of._hessian, _PROXIMAL + self._newton.shift
        linear = float((self._q + hessian @ self.d + more * self.d) @ step)
        square = float(step @ (hessian @ step) + more * (step @ step))

        def slope(part: float) -> float:
            return linear + part * square + float(self._pull(at + part * along) @ along)

        if slope(1.0) <= 0 or slope(0.0) >= 0:
            return 1.0
        return float(brentq(slope, 0.0, 1.0, xtol=1e-6))

    def multipliers(self) -> tuple[Vector, Vector]:
        """Multipliers of constraints (m,) and bounds (n,), as of the last active set."""
        found = self._y + self._constant
        y, z = found[: self._m], found[self._m :].copy()
        held = ~self._of._moves
        z[held] = -(self._gradient + self._jacobian.T @ y + self._of._hessian @ self.d)[held]
        return y, z
