"""What an interpreter prints of a result is a line, not its arrays."""

from impactopt import Solution
from impactopt.files.output import record_of


def test_a_solution_is_one_line(hammered: Solution) -> None:
    solution = hammered
    for thing in (solution, solution.plan, solution.problem, record_of(solution)):
        assert "planar arm" in repr(thing) and len(repr(thing)) < 130
    assert "planar_arm" in repr(solution.problem.robot) and len(repr(solution.problem.robot)) < 130
    for thing in (solution.trajectory, solution.plan.collision, solution.plan.motion()):
        assert type(thing).__name__ in repr(thing) and len(repr(thing)) < 130
    assert len(repr(solution.validate())) < 600
