"""The paper's tables and figures: its own numbers, ours beside them, their JSON, and the command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import trapezoid
from support.small_robots import biped
from typer.testing import CliRunner

from benchmarks import costs, registry
from benchmarks.cases import Case, paper_motions
from benchmarks.paper import (
    fig3,
    fig4,
    fig7,
    motions,
    paper,
    table1,
    table2,
    table3,
    timing,
)
from benchmarks.paper.__main__ import app
from benchmarks.trees import random_robot, tip_speed
from impactopt import SDC, InputError

HEADS = {"seconds", "versions", "machine"}
TABLE_2 = {
    "robot",
    "motion",
    "m_a_kg",
    "v_c_m_s",
    "model",
    "freezes",
    "impulse_Ns",
    "impulse_reference_Ns",
    "impulse_error_pct",
    "f_max_error_pct",
    "zmp_error_mm",
    "torque_error_pct",
    "impulse_paper_Ns",
    "f_max_paper_N",
}
SHORT = tuple(fidelity for fidelity in motions.HIERARCHY if not fidelity.freezes)

runner = CliRunner()


def quiet(_text: str) -> None:
    pass


# ---------------------------------------------------------------- what the paper prints
def test_the_papers_errors_follow_from_its_own_numbers() -> None:
    """Eq. (24) on the printed digits: a slip in copying them would show."""
    for printed in (paper.TABLE_2, paper.TABLE_3):
        assert list(printed) == list(paper.MOTIONS) == list(paper.OPENHRP3)
        for name, estimate in printed.items():
            true = paper.OPENHRP3[name]
            assert 100 * (1 - estimate.f_max / true.f_max) == pytest.approx(estimate.f_max_error, abs=0.2)
            # impulses are printed to 0.1 N s, of 2.5 to 7
            allowed = 100 * 0.05 * (1 / true.impulse + estimate.impulse / true.impulse**2) + 0.1
            error = 100 * (1 - estimate.impulse / true.impulse)
            assert error == pytest.approx(estimate.impulse_error, abs=allowed)


# ---------------------------------------------------------------- costs
def test_the_formulas_give_the_papers_ratios() -> None:
    at = {step: costs.iterations(step) for step in (1e-3, 1e-4)}
    hrp2 = costs.HRP2
    assert round(costs.cost_sdc(hrp2, at[1e-3]) / costs.cost_full(hrp2, at[1e-3]), 4) == 0.0156
    assert round(costs.cost_sdc(hrp2, at[1e-4]) / costs.cost_aba(hrp2, at[1e-4]), 3) == 0.264
    assert fig3.ratios(1e-3)["C_r1"] == pytest.approx(0.0156, abs=5e-5)
    assert 96 < fig4.crossing() < 97
    assert fig4.ratios(fig4.crossing())["C_r3"] == pytest.approx(1.0)


def test_freezing_once_costs_about_as_much_as_one_step_of_full_dynamics() -> None:
    """(18) and (20) differ in the terms that grow with n, and not in those with n^2 and n^3."""
    once = costs.cost_sdc(costs.HRP2, 0)
    assert costs.cost_full(costs.HRP2, 1) - once == pytest.approx(12.5 * 28 + 15)


def test_iterations_need_times() -> None:
    with pytest.raises(InputError, match=r"step, total \[s\]: 0, 0.1"):
        costs.iterations(0.0)


# ---------------------------------------------------------------- what is timed
def test_the_dense_route_is_full_dynamics() -> None:
    robot = random_robot(8)
    model, data, rng = robot.model, robot.model.createData(), np.random.default_rng(3)
    q, v, tau = (rng.uniform(-1, 1, 8) for _ in range(3))
    found = timing._full(robot, "tip")(*[timing._many(x) for x in (q, v, tau, np.array(30.0))])
    frame = model.getFrameId("striker:tip")
    pin.computeJointJacobians(model, data, q)
    push = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[0] * 30.0
    a = pin.aba(model, data, q, v, tau - push)
    pin.forwardKinematics(model, data, q, v, a)
    expected = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    assert np.allclose(np.array(found)[:, 0], expected, rtol=1e-9)
    assert np.array_equal(np.array(found)[:, 0], np.array(found)[:, -1])


def test_what_is_timed_of_the_sdc_is_the_sdc() -> None:
    robot = random_robot(8)
    sdc = SDC.paper(robot, striker="tip", normal=[1.0, 0.0, 0.0])
    rng = np.random.default_rng(5)
    q, v = rng.uniform(-1, 1, 8), rng.normal(size=8)
    v *= np.sign(tip_speed(robot, q, v))
    freeze, steps = timing._sdc_functions(sdc)
    frozen = freeze.call(
        [np.tile(np.reshape(x, (-1, 1)), (1, timing.MANY)) for x in (q, v, [1, 0, 0], [0.2, 0.0])]
    )
    given = {name: x[:, 0] for name, x in zip(freeze.name_out(), frozen, strict=True)} | dict(sdc.settings)
    end = np.array(steps(np.zeros(steps.size1_in(0)), *[given[k] for k in steps.name_in()[1:]])).ravel()
    whole = sdc.collide(q, v, require_separation=False)
    time = min(timing.STEPS * sdc.step_length, whole.duration)
    assert end[0] == pytest.approx(time)
    assert end[1] == pytest.approx(np.interp(time, whole.time, whole.penetration), rel=1e-9)


def test_ratios_come_from_times() -> None:
    times = timing.Times(full=10.0, freeze=20.0, stage=1.0, aba=5.0, call=1.0)
    assert times.ratio_1(10) == pytest.approx((20 + 10) / 100)
    assert times.ratio_3(10) == pytest.approx((20 + 10) / 50)
    row = fig3.row(1e-3, times)
    assert row["C_r1"] == pytest.approx(row["C_r1_paper"], abs=5e-4)
    assert row["C_r1_measured"] == times.ratio_1(100) and row["C_r3_paper"] is None


def test_random_trees_have_four_limbs() -> None:
    robot = random_robot(12)
    assert robot.n == 12 and sum(parent == 0 for parent in list(robot.model.parents)[1:]) == 4
    with pytest.raises(InputError, match="n: 10; give a positive multiple of 4"):
        random_robot(10)


def test_fig4_has_formulas_for_all_sizes_and_times_for_some() -> None:
    report = fig4.run(quiet, measured=(8,))
    numbers = report.numbers
    assert numbers["C_r3_first_n_not_below_1"] == 97
    timed = [row for row in numbers["rows"] if row["times"]]
    assert [row["n"] for row in timed] == [8]
    assert 0 < timed[0]["C_r1_measured"] < 1 and 0 < timed[0]["C_r3_measured"] < 1
    assert all(value > 0 for value in timed[0]["times"].values())
    report.figures["fig4"]()


# ---------------------------------------------------------------- table III
def test_table3_equals_the_papers() -> None:
    numbers = table3.run(quiet).numbers
    assert [row["motion"] for row in numbers["rows"]] == list(paper.MOTIONS)
    for row in numbers["rows"]:
        assert round(row["impulse_Ns"], 1) == row["impulse_paper_Ns"] and row["impulse_equal"]
        assert row["f_max_N"] == pytest.approx(row["f_max_paper_N"], rel=0.005)
    assert numbers["impulses_equal"] == 9 and numbers["f_max_worst_error_pct"] < 0.5


def test_the_commands_json_is_all_there_is_on_stdout() -> None:
    result = runner.invoke(app, ["table3", "--json"])
    assert result.exit_code == 0, result.output
    numbers = json.loads(result.stdout)
    assert numbers.keys() >= HEADS | {"rows"}
    keys = {"m_a_kg", "v_c_m_s", "f_max_N", "f_max_paper_N", "impulse_Ns", "impulse_paper_Ns"}
    assert len(numbers["rows"]) == 9 and all(row.keys() >= keys for row in numbers["rows"])


# ---------------------------------------------------------------- the nine motions, on a small robot
@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> list[Case]:
    """One motion of a small biped under the stand-in's name, with a short horizon."""
    robot = biped()
    found = paper_motions(robot, striker="fist", masses={"C": 2.0}, speeds=(0.4,))

    def one(_robots: Any, _say: Any) -> Iterator[tuple[str, list[Case]]]:
        yield "standin", found

    for module in (table1, table2, fig7):
        monkeypatch.setattr(module, "motions", one)
    monkeypatch.setattr(motions, "STRIKER", "fist")
    monkeypatch.setattr(motions, "HORIZON", 0.1)
    return found


def test_table1_measures_masses_and_speeds(small: list[Case]) -> None:
    (row,) = table1.run(quiet).numbers["rows"]
    assert row["m_a_kg"] == pytest.approx(2.0, abs=1e-6) and row["m_a_paper_kg"] == 8.0
    assert row["v_c_error_m_s"] == pytest.approx(0.0, abs=1e-9)
    assert row["joints_rad"].keys() == set(small[0].robot.joint_names)


@pytest.mark.slow
def test_table2_and_fig7_have_every_model_beside_the_papers_numbers(small: list[Case]) -> None:
    report = table2.run(quiet, fidelities=SHORT)
    rows, numbers = report.numbers["rows"], report.numbers
    assert [row["model"] for row in rows] == ["virtual-mass", "sdc-paper", "sdc"]
    assert all(row.keys() >= TABLE_2 for row in rows)
    point, published, sdc = rows
    assert point["impulse_paper_Ns"] == 1.7 and published["impulse_paper_Ns"] == 2.7
    assert sdc["impulse_paper_Ns"] is None and sdc["impulse_openhrp3_Ns"] == 2.8
    assert point["zmp_error_mm"] is None and sdc["zmp_error_mm"] > 0
    # the better model is better
    assert abs(sdc["impulse_error_pct"]) < 2 < abs(point["impulse_error_pct"])
    assert numbers["worst"][2]["worst_impulse_error_pct"] == abs(sdc["impulse_error_pct"])
    assert numbers["forms"][0]["relative_difference"] < 1e-9
    assert numbers["reference"][0]["tighter_tolerance_changed_Ns"] < 1e-5
    json.dumps(dict(numbers))
    # the same collisions, as a picture
    report = fig7.run(quiet, fidelities=SHORT)
    found = {row["model"]: row for row in report.numbers["rows"]}
    true = found["full dynamics"]
    assert found["SDC, frozen at contact"]["impulse_Ns"] == sdc["impulse_Ns"]
    assert true["impulse_Ns"] == sdc["impulse_reference_Ns"]
    assert trapezoid(true["force_N"], true["time_s"]) == pytest.approx(true["impulse_Ns"], rel=1e-2)
    picture = report.figures["fig7"]()
    assert len(picture.axes) == 2, "the force, and what the models are off"
    errors = {text.get_text() for text in picture.axes[1].get_legend().get_texts()}
    assert f"{sdc['impulse_error_pct']:+.2f} %" in errors


def test_a_robot_that_is_not_installed_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> Any:
        raise InputError(f"{name} needs a package")

    monkeypatch.setattr(motions, "load_robot", load)
    said: list[str] = []
    with pytest.raises(InputError, match="talos needs a package"):
        list(motions.motions(("talos",), said.append))
    assert said == ["talos is left out: talos needs a package"]


# ---------------------------------------------------------------- command
@pytest.mark.slow
def test_all_keeps_everything_under_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "REPRODUCED", ("table3", "table1"))
    result = runner.invoke(app, ["all", "--json", "--quiet", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert list(json.loads(result.stdout)) == ["table3", "table1"]
    assert (tmp_path / "table3.json").exists()


def test_an_unknown_name_is_one_message_and_exit_code_2() -> None:
    result = runner.invoke(app, ["tabel2"])
    assert result.exit_code == 2 and "Traceback" not in result.output
    assert "'tabel2' (did you mean 'table2'?): table1, table2" in result.output
    assert runner.invoke(app, []).exit_code == 2


def test_every_name_has_its_module_and_is_in_the_help() -> None:
    text = runner.invoke(app, ["--help"], env={"COLUMNS": "200"}).stdout
    folder = Path(registry.__file__).parent / "paper"
    for name in registry.REPRODUCED:
        assert name in text and (folder / f"{name}.py").exists()
