"""What an interpreter prints of a result is a line, not its arrays."""

import copy
import sys

import pytest

from impactopt import FreeMass, InputError, Solution, VirtualMass, optimize_strike, striking_velocity
from impactopt.files.output import record_of


def test_a_solution_is_one_line(hammered: Solution) -> None:
    solution = hammered
    for thing in (solution, solution.plan, solution.problem, record_of(solution)):
        assert "planar arm" in repr(thing) and len(repr(thing)) < 130
    assert "planar_arm" in repr(solution.problem.robot) and len(repr(solution.problem.robot)) < 130
    for thing in (solution.trajectory, solution.plan.collision, solution.plan.motion()):
        assert type(thing).__name__ in repr(thing) and len(repr(thing)) < 130
    simulation = solution.validate()
    assert len(repr(simulation)) < 600
    plan, strike = solution.plan, optimize_strike(solution.problem).strike
    for thing in (solution.trajectory, plan, plan.collision, plan.motion(), strike, simulation):
        assert len({thing, copy.copy(thing)}) == 2  # arrays neither compare nor hash
    p = solution.problem
    scene = {"robot": p.robot, "striker": p.striker, "normal": p.normal, "law": p.law}
    q = p.start_posture
    v = striking_velocity(p.robot, q, p.striker, p.normal, 1.0)
    hit = VirtualMass(**scene, target=FreeMass(mass=1.0)).collide(q, v)
    assert f"{hit.impulse:.4g} N s" in repr(hit) and len(repr(hit)) < 130


def test_a_motion_is_a_table_of_pandas(hammered: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    table, way, robot = hammered.to_frame(), hammered.trajectory, hammered.problem.robot
    assert table.index.name == "time [s]" and list(table.index) == list(way.time)
    for k, name in enumerate(robot.joint_names):
        assert list(table[f"torque {name}"]) == list(way.torque[:, k])
        assert list(table[f"v {name}"]) == list(way.v[:, k])
    assert table.notna().all().all() and {*table.phase} == {0, 1, 2}
    assert not [name for name in table if name.startswith("ground")]  # a bolted base's force is not known
    with pytest.raises(InputError, match="no motion that follows a missed blow"):
        hammered.to_frame(missed=True)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match=r"pandas.*\[frame\]"):
        hammered.to_frame()
