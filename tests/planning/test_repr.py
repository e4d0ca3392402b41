"""What an interpreter prints of a result is a line, not its arrays."""

from impactopt import load_problem, solve


def test_a_solution_is_one_line() -> None:
    solution = solve(load_problem("arm_planar"))
    for thing in (solution, solution.plan):
        assert "planar arm" in repr(thing) and len(repr(thing)) < 130
