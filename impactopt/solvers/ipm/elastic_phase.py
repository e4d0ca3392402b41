"""The elastic phase: when rows may be violated at a price, when only their violation counts, and its end.

It begins where no step is progress any more. Where rows are met again they are hard again, at a higher price
the next time; where the price does not bring that about the objective is left out, until the violation is
gone or least. So an infeasible program ends at a point of least violation.
"""

from __future__ import annotations

from impactopt.solvers.ipm.barrier_problem import BarrierProblem
from impactopt.solvers.options import IPMOptions
from impactopt.solvers.program import Status, Vector, is_stationary_violation

# violation from which on elastic rows are made hard again where they do not get further, or this part of what
# it was when nothing else began to count
_NEAR, _LESS = 1e-2, 1e-2
_RESTORED = 1e-3  # violation from which on they are where nothing else counted
_CHANGES = 12  # of what is aimed at, at most
_AGAIN = 1e-4  # the least barrier after such a change
_LINGERS = 20  # so many iterations with elastic rows that are met are enough


class ElasticPhase:
    """Aim of the method, and how long it lasts.

    Where one of its methods changes that, a line search has to forget what it knows.
    """

    def __init__(self, options: IPMOptions):
        self._options = options
        self._price = options.price  # of elastic rows
        self._met = 0  # iterations of elastic rows that are met
        self._began = 0.0  # violation where only that began to count
        self._changes = 0

    def begin(self) -> None:
        """Begin an attempt from a point of its own: the price stays what it has come to."""
        self._changes = 0

    def verdict(self, problem: BarrierProblem) -> Status | None:
        """Decide at a solution, or where rows are restored: the end, unless rows are violated, or only the
        violation counted.
        """
        elastic = problem.elastic
        met = elastic is None or elastic.largest() <= self._options.violation_tolerance
        if met and problem.sigma:
            return Status.SOLVED
        near = _NEAR if problem.sigma else _RESTORED  # the price may only have been too low
        return self.change_aim(problem, met=met or problem.point.max_violation <= near)

    def restored(self, problem: BarrierProblem) -> bool:
        """True if the violation, which alone counts, is so small that hard rows get further with it."""
        elastic = problem.elastic
        if elastic is None or problem.sigma or elastic.price >= self._options.price_max:
            return False
        return problem.point.max_violation <= _RESTORED

    def lingers(self, problem: BarrierProblem) -> bool:
        """True if elastic rows have been met for long, and the rest is left to do: hard rows do it sooner."""
        met = problem.elastic is not None and problem.point.max_violation <= self._options.violation_tolerance
        self._met = self._met + 1 if met and problem.sigma else 0
        return self._met > _LINGERS and self._price < self._options.price_max

    def change_aim(self, problem: BarrierProblem, *, met: bool) -> Status | None:
        """Go on where elastic rows stall: let only the violation count, until it is gone or least."""
        assert problem.elastic is not None
        self._changes += 1
        if self._changes > _CHANGES:
            return Status.FAILED
        price = problem.elastic.price
        if met and price < self._options.price_max:
            problem.elastic, problem.sigma = None, 1.0  # from where rows are met, as if nothing had been
            self._price = min(10.0 * price, self._options.price_max)
        elif problem.sigma:
            problem.sigma, self._began = 0.0, problem.point.max_violation
        else:
            return self._least(problem)
        problem.mu = max(problem.mu, _AGAIN)
        return None

    def give_way(self, problem: BarrierProblem, residual: Vector) -> str | Status:
        """Next aim where no step is progress: let rows be violated at a price, or end.

        Text: what has been changed.
        """
        if problem.error(0.0, residual) <= self._options.acceptable_tolerance:
            if problem.elastic is None:
                return Status.ACCEPTABLE
            if not problem.sigma:  # the violation is least, but for rounding
                return self.verdict(problem) or "rows are hard again"
        point = problem.point
        if problem.elastic is None:
            problem.soften(residual, self._price)
            return "rows become elastic"
        near = point.max_violation <= max(_NEAR, _LESS * self._began)
        if problem.sigma or near:
            end = self.change_aim(problem, met=near)
            if end is not None:
                return end
            return "rows are hard again" if problem.elastic is None else "only the violation counts"
        if is_stationary_violation(problem.program, point.x, point.g, point.jacobian):
            return self._least(problem)
        return Status.FAILED

    def _least(self, problem: BarrierProblem) -> Status:
        """The end where the violation is least: a program whose rows are met there is not infeasible."""
        met = problem.point.max_violation <= self._options.violation_tolerance
        return Status.FAILED if met else Status.INFEASIBLE
