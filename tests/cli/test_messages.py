"""What a program says of rows that are not met: term, time in this solution, and an amount that is true."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_plans import changed

from impactopt import ContactWrenchCone, Phase, Scenario, Status, TorqueLimit
from impactopt.problem.violation import Measure, Place, degrees, millimetres, percent
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import DescribedProgram, Violation, explain, worst_violations
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.layout import Layout, along
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
SCENARIOS = (
    Scenario(name="heavy {5 kg}", mass=2.0),
    Scenario(name="missing", missing=True, abort_after=0.02),
)


def told(t: Transcription, x: Array, *, count: int = 1000) -> list[Violation]:
    return worst_violations(t.program, x, t.program.constraints(x), tolerance=1e-6, count=count)


@pytest.mark.parametrize("robot", ["arm", "biped"])
@pytest.mark.parametrize("changes", [{"scenarios": SCENARIOS}, {"collision": "rigid"}], ids=["long", "rigid"])
def test_every_row_has_a_measure_and_can_be_told(
    robot: str, changes: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    transcription = changed(request.getfixturevalue(f"{robot}_transcription"), **changes)
    program, x = transcription.program, first_iterate(transcription)
    assert isinstance(program, DescribedProgram)
    for i, row in enumerate(program.origins):
        assert row.measure is not None, str(row)
        what, by = program.describe_violation(i, x, 0.1)
        assert what.startswith(row.term) and "nan" not in what and "{s}" not in what and "{ms}" not in what
        assert re.fullmatch(r"[\d.e+]+ (mm|deg|%|N|N m|m/s|rad/s|N s|N m s) .+", by), by
    if "scenarios" in changes:
        assert any("if heavy {5 kg}" in program.describe_violation(i, x, 1.0)[0] for i in range(program.m))


def test_times_are_those_of_the_solution(biped_transcription: Transcription) -> None:
    """Of the same row, at two solutions that take different times."""
    t, x = biped_transcription, first_iterate(biped_transcription)

    def what(name: str, at: Array) -> str:
        i = next(i for i in range(t.program.m) if t.program.constraint_name(i).startswith(name))
        return t.program.describe_violation(i, at, 0.1)[0]

    hit = t.hit.collisions[0]
    for compression, restitution, follow in ((0.02, 0.01, 0.6), (0.03, 0.015, 0.75)):
        for group, value in zip((*hit.T, t.follow.T), (compression, restitution, follow), strict=True):
            group.write(x, value)
        place = t.follow_nodes[3]
        name = f"closed legs, follow-through, {100 * place:.0f} %"
        assert f"follow-through at {place * follow:.2f} s" in what(name, x)
        stage = next(s for s in t.hit.stages if s.phase == 1)
        after = compression + stage.place * restitution
        assert f"{1e3 * after:.0f} ms after contact" in what(f"contact law, {stage.name}", x)


@pytest.mark.parametrize("outside", [0.008, 0.03])
def test_a_centre_of_pressure_outside_its_sole_is_told_in_millimetres(
    biped_transcription: Transcription, outside: float
) -> None:
    """Beyond the margin's line, whatever the sole bears; of all facets that say so there is one message."""
    t, x = biped_transcription, first_iterate(biped_transcription)
    cone, sole = t.problem.term(ContactWrenchCone), t.coordinates.legs[0].sole
    force = 0.3 * t.builder.limits.weight
    front = sole.polygon[:, 0].max() - cone.margin + outside
    wrench = np.tile([0, 0, 0.5 * t.builder.limits.weight, 0, 0, 0], len(t.coordinates.legs))
    wrench[:6] = [0, 0, force, 0, -front * force, 0]
    t.swing.w.write(x, wrench)
    k = len(t.swing_nodes) // 2
    when = t.swing_nodes[k] * t.problem.swing.duration[0]
    place = f"contact wrench cone, swing at {when:.2f} s, {sole.name} sole"
    found = [v for v in told(t, x) if v.what == place]
    assert [v.by for v in found] == [f"{1e3 * outside:.2g} mm outside"]


def test_a_sole_that_slips_is_told_in_parts_of_its_friction(biped_transcription: Transcription) -> None:
    t, x = biped_transcription, first_iterate(biped_transcription)
    friction, sole = t.problem.term(ContactWrenchCone).friction, t.coordinates.legs[1].sole
    middle = sole.polygon.mean(axis=0)
    force = np.array([1.25 * friction * 0.4 * t.builder.limits.weight, 0, 0.4 * t.builder.limits.weight])
    wrench = np.tile([0, 0, 0.5 * t.builder.limits.weight, 0, 0, 0], len(t.coordinates.legs))
    wrench[6:12] = [*force, *np.cross([*middle, 0.0], force)]
    t.swing.w.write(x, wrench)
    found = [v for v in told(t, x) if v.what.startswith("contact wrench cone, swing")]
    assert len(found) == len(t.swing_nodes)
    assert {v.by for v in found} == {"25 % beyond its friction"}


def test_rows_of_a_term_at_a_place_are_told_once_by_the_worst(biped_transcription: Transcription) -> None:
    t, x = biped_transcription, first_iterate(biped_transcription)
    t.swing.legs.write(x, t.legs0 + 0.1)
    g = t.program.constraints(x)
    over = np.maximum(np.maximum(t.program.g_lower - g, g - t.program.g_upper), 0)
    groups = {t.program.constraint_group(i) for i in np.flatnonzero(over > 1e-6)}
    found = told(t, x, count=t.program.m)
    assert len(found) == len(groups) < np.count_nonzero(over > 1e-6)
    assert [v.amount for v in found] == sorted((v.amount for v in found), reverse=True)
    assert found[0].amount == over.max()
    worst = worst_violations(t.program, x, g, tolerance=1e-6, count=t.program.m, once_a_term=True)
    assert len(worst) == len({term for term, _ in groups})
    assert worst == [v for v in found if v in worst]
    message = explain(t.program, Status.INFEASIBLE, x, g, tolerance=1e-6)
    told_of = [v for v in worst[:5] if v.amount >= 0.01 * worst[0].amount]
    assert ": " + "; ".join(str(v) for v in told_of) + "; " in message
    assert f"; {np.count_nonzero(over > 1e-6)} constraints in all." in message
    assert len({v.what for v in found}) == len(found)


def test_torques_that_cannot_be_held_are_told_with_joint_and_time(arm_transcription: Transcription) -> None:
    """An arm that cannot carry itself; by Pinocchio's inverse dynamics, what the message says is so."""
    fraction = 0.03
    t = changed(arm_transcription, terms=(TorqueLimit(fraction=fraction, collision=fraction),))
    result = solve_ipopt(t.program, first_iterate(t))
    assert result.status is Status.INFEASIBLE
    assert "Constraints that cannot be met: torque limit, swing at " in result.message
    model, joints = t.robot.model, list(t.robot.joint_names)
    swing = t.swing.spline(result.x)
    checked = 0
    for violation in told(t, result.x):
        said = re.fullmatch(
            r"torque limit, swing at ([\d.]+) s, (\w+): (\d+) % over its limit", str(violation)
        )
        if said is None:
            continue
        at = t.swing_nodes * swing.duration  # the message has two digits
        node = at[np.argmin(np.abs(at - float(said[1])))]
        q, v, a = (sample[0] for sample in swing.sample(node))
        q = t.coordinates.join(q, t.legs0)
        torque = np.abs(pin.rnea(model, model.createData(), q, v, a) / t.robot.torque_limit)
        over = torque[joints.index(said[2])] / fraction - 1
        assert float(said[3]) == pytest.approx(100 * over, abs=1.0)
        checked += 1
    assert checked > 3


def test_a_point_that_is_out_of_time_is_told_in_millimetres(arm_transcription: Transcription) -> None:
    t = changed(arm_transcription, swing=Phase(duration=0.05, intervals=8))
    result = solve_ipopt(t.program, first_iterate(t))
    assert result.status is Status.INFEASIBLE
    model = t.robot.model
    swing = t.swing.spline(result.x)
    data, q = model.createData(), t.coordinates.join(swing.sample(swing.duration)[0][0], t.legs0)
    pin.framesForwardKinematics(model, data, q)
    at = data.oMf[model.getFrameId(f"striker:{t.problem.striker}")].translation
    for violation in told(t, result.x):
        if said := re.fullmatch(r"hit point, ([xyz]): ([\d.]+) mm away", str(violation)):
            off = abs(at - t.problem.point)
            assert "xyz"[int(np.argmax(off))] == said[1]
            assert float(said[2]) == pytest.approx(1e3 * off.max(), rel=0.05, abs=0.5)
            return
    assert any("velocity limit, swing at about" in str(v) for v in told(t, result.x))


@pytest.mark.parametrize(
    ("measure", "amount", "text"),
    [
        (millimetres("away"), 0.0234, "23 mm away"),
        (millimetres("left", scale=0.01), 0.5, "5 mm left"),
        (degrees("outside"), np.pi / 90, "2 deg outside"),
        (percent("over its limit", of=0.8), 0.4, "50 % over its limit"),
        (percent("over its limit", of=0.0), 0.4, "40 % over its limit"),
        (Measure("N", 700.0, "too light"), 0.0005, "0.35 N too light"),
        (Measure("N", 700.0, "off"), np.inf, "inf N off"),
    ],
)
def test_measures(measure: Measure, amount: float, text: str) -> None:
    assert measure.describe(np.zeros(0), amount) == text


def test_a_measure_over_an_expression_and_a_place_with_a_time() -> None:
    layout = Layout()
    force, time = layout.add("force", 1, 1, scale=100.0), layout.add("time", 1, 1)
    x = np.array([2.0, 0.5])
    assert Measure("mm", 1e3, "outside", force[0]).describe(x, 1.0) == "5 mm outside"
    assert Measure("mm", 1e3, "outside", force[0], 400.0).describe(x, 1.0) == "2.5 mm outside"
    assert Place("p", "{ms} after contact", time[0] * 0.1).describe(x) == "50 ms after contact"
    assert Place.plain("a {b}").describe(x) == "a {b}"
    assert [m.unit for m in along(["base x", "base roll", "elbow", "left sole z"], "off")] == [
        "mm",
        "deg",
        "deg",
        "mm",
    ]
