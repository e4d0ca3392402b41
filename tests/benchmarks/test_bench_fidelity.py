"""The benches of models: the hierarchy against full dynamics, virtual bases against fixed soles."""

from __future__ import annotations

import json
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from benchmarks import fidelity, virtual_base
from benchmarks.__main__ import app
from benchmarks.cases import PAPER_SPEEDS
from benchmarks.fidelity import Task
from benchmarks.hierarchy import GAINS, HORIZON, MASS_RATIOS, TARGETS, Fidelity, situations
from benchmarks.pictures.fidelity import fidelity_picture
from benchmarks.pictures.virtual_base import virtual_base_picture
from benchmarks.report import Report
from benchmarks.virtual_base import _body, exact_inverse_mass
from impactopt import BothSoles, InputError, Robot, effective_mass, standin

runner = CliRunner()


def silent(_text: str) -> None:
    pass


@pytest.fixture(scope="module")
def robot() -> Robot:
    return standin()


# ---------------------------------------------------------------- virtual base
@pytest.fixture(scope="module")
def bases() -> dict[float, dict[str, Any]]:
    masses = (1e2, 1e3, 1e4, 1e5, 1e6, 1e8, 1e12, 1e17)
    report = virtual_base.run(silent, robots=("standin",), masses=masses)
    return {row["M_g"]: row for row in report.numbers["rows"]}


@pytest.mark.slow
@pytest.mark.parametrize("key", ["error_model", "error_literal", "impulse_error_model", "error_60_digits"])
def test_the_virtual_base_s_error_falls_with_its_mass(bases: dict[float, dict[str, Any]], key: str) -> None:
    masses = [1e3, 1e4, 1e5, 1e6]  # 1e2 kg is no more than the robot's own mass: the law's beginning
    assert bases[1e2][key] > bases[1e3][key]
    slope = np.polyfit(np.log(masses), np.log([bases[mass][key] for mass in masses]), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.01)


def test_ours_does_not_round_and_the_literal_form_does(bases: dict[float, dict[str, Any]]) -> None:
    assert all(row["rounding_model"] < 3e-15 for row in bases.values())
    assert bases[1e12]["error_model"] < 1e-13
    assert bases[1e12]["error_literal"] > bases[1e8]["error_literal"]
    assert bases[1e12]["rounding_literal"] > 1e-8


def test_a_factorization_that_fails_says_so(bases: dict[float, dict[str, Any]]) -> None:
    row = bases[1e17]
    assert row["error_literal"] is None and "Cholesky" in row["reason"]
    assert row["error_model"] < 1e-14
    assert all(bases[mass]["reason"] is None for mass in bases if mass < 1e13)


def test_many_digits_agree_with_numpy(robot: Robot) -> None:
    body = _body(robot, robot.postures["half_sitting"])
    rows = np.vstack([body.held, virtual_base.NORMAL @ body.hand])
    inner = rows @ np.linalg.solve(body.inertia, rows.T)
    for compliance in (0.0, 1e-5):
        held = inner[:12, :12] + compliance * np.eye(12)
        expected = inner[12, 12] - inner[12, :12] @ np.linalg.solve(held, inner[:12, 12])
        found = exact_inverse_mass(body, virtual_base.NORMAL, Decimal(compliance))
        assert float(found) == pytest.approx(expected, rel=1e-12)


def test_the_bench_measures_what_the_package_computes(
    robot: Robot, bases: dict[float, dict[str, Any]]
) -> None:
    at = {"striker": virtual_base.STRIKER, "normal": virtual_base.NORMAL}
    q = robot.postures[virtual_base.POSTURE]
    exact = float(effective_mass(robot, **at)(q))
    base = BothSoles(base_mass=1e4, base_inertia=1e4)
    found = float(effective_mass(robot, stance=base, **at)(q))
    assert found / exact - 1 == pytest.approx(-bases[1e4]["error_model"], rel=1e-6)


def test_the_default_is_exact(robot: Robot) -> None:
    assert all(row["rounding"] < 3e-15 for row in virtual_base.exact_rows(robot))


def test_a_picture_with_a_failure_in_it(bases: dict[float, dict[str, Any]]) -> None:
    assert isinstance(virtual_base_picture(list(bases.values())), Figure)


def test_the_command_virtual_base(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr(virtual_base.run, "__kwdefaults__", {"robots": ("standin",), "masses": (1e3, 1e17)})
    out = str(tmp_path / "kept")
    result = runner.invoke(app, ["virtual-base", "--json", "--out", out])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert {"robot", "M_g", "error_model", "error_literal", "reason"} <= set(found["rows"][0])
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"virtual-base.json", "virtual_base.png"}


# ---------------------------------------------------------------- fidelity
SHORT = (Fidelity(model="virtual-mass"), Fidelity(model="sdc", freezes=0), Fidelity(model="sdc", freezes=2))


@pytest.fixture(scope="module")
def short() -> Report:
    return fidelity.run(silent, hierarchy=SHORT, workers=1, quick=True)


def made_up(errors: dict[int | None, list[float | None]]) -> list[dict[str, Any]]:
    """Collisions of one robot with these impulse errors, by freezes."""
    count = len(next(iter(errors.values())))
    out = []
    for k in range(count):
        models = [
            {
                "model": "sdc",
                "freezes": n,
                "impulse_error_pct": given[k],
                "zmp_error_mm": given[k],
                "torque_error_pct": given[k],
                "torque_joint": f"joint {k}",
            }
            for n, given in errors.items()
        ]
        common = {"robot": "r", "case": f"case {k}", "mujoco_vs_pinocchio_pct": None, "separated": k != 1}
        out.append({**common, "models": models})
    return out


@pytest.mark.parametrize("name", ["standin", pytest.param("g1", marks=pytest.mark.slow)])
def test_the_collisions_are_what_the_bench_says(name: str) -> None:
    cases = situations(name)
    assert len({case.name for case in cases}) == len(MASS_RATIOS) * len(PAPER_SPEEDS) * len(GAINS) == 27
    masses = {round(case.effective_mass / TARGETS[name], 6) for case in cases}
    assert masses == set(MASS_RATIOS)
    ratios = {float(np.max(case.overrides["kp"] / case.robot.kp)) for case in cases}
    assert ratios == set(GAINS)
    for case in cases:
        np.testing.assert_allclose(
            case.overrides["kd"] / case.robot.kd, case.overrides["kp"] / case.robot.kp, rtol=1e-12
        )
        assert np.all(np.abs(case.torque) < case.robot.torque_limit)


def test_mujoco_gets_each_pair_of_posture_speed_and_gains_once() -> None:
    chosen = [task.index for task in fidelity.tasks_of("standin", SHORT, quick=False) if task.mujoco]
    places = np.array(np.unravel_index(chosen, (3, 3, 3)))
    assert len(chosen) == 9
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert len({(i, j) for i, j in places[[a, b]].T.tolist()}) == 9


@pytest.mark.slow
def test_freezing_again_makes_it_better_and_a_point_mass_is_far_off(short: Report) -> None:
    rows = {(row["model"], row["freezes"]): row for row in short.numbers["rows"]}
    virtual, once, again = (rows[fidelity.model, fidelity.freezes] for fidelity in SHORT)
    assert virtual["worst_impulse_error_pct"] > 10.0
    assert virtual["worst_zmp_error_mm"] is None and virtual["worst_torque_error_at"] is None
    assert once["worst_impulse_error_pct"] < 2.0
    for key in ("worst_impulse_error_pct", "median_impulse_error_pct", "worst_torque_error_pct"):
        assert again[key] < 0.5 * once[key]
    assert once["worst_torque_joint"] in standin().joint_names
    assert all(row["failed"] == 0 and row["pushes"] == [] for row in rows.values())


@pytest.mark.slow
def test_mujoco_agrees_with_the_reference(short: Report) -> None:
    assert short.numbers["mujoco_collisions"] == 1
    assert short.numbers["mujoco_vs_pinocchio_pct"] < 0.01
    for collision in short.numbers["collisions"]:
        assert collision["separated"] and 0.01 < collision["duration_s"] < HORIZON


def test_the_order_is_minus_the_slope_of_the_logarithms() -> None:
    fidelities = [Fidelity(model="sdc", freezes=n) for n in (0, 1, 2, 4, 8)]
    errors: dict[int | None, list[float | None]] = {
        n: [-9.0 / n**2, 1.0 / n**3, 0.5 / n**3] if n else [9.0] * 3 for n in (0, 1, 2, 4, 8)
    }
    found = fidelity.orders(made_up(errors), fidelities)
    assert found["order_in_freezes"] == pytest.approx(2.0)
    assert found["order_in_freezes_median"] == pytest.approx(3.0)
    assert found["orders"]["r"]["order_in_freezes"] == pytest.approx(2.0)
    assert fidelity.orders(made_up({0: [1.0]}), fidelities[:1])["order_in_freezes"] is None


def test_a_row_has_the_worst_and_where_and_drops_nothing() -> None:
    collisions = made_up({4: [0.1, -0.7, None, 0.3]})
    row = fidelity.row_of("r", Fidelity(model="sdc", freezes=4), collisions)
    assert row["worst_impulse_error_pct"] == 0.7 and row["worst_impulse_error_at"] == "case 1"
    assert row["worst_torque_joint"] == "joint 1"
    assert row["median_impulse_error_pct"] == 0.3
    assert (row["collisions"], row["failed"], row["pushes"]) == (4, 1, ["case 1"])


def test_a_model_that_refuses_a_collision_is_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refusing:
        def collide(self, *_given: Any, **_options: Any) -> Any:
            raise InputError("no")

        converged = collide

    whole = fidelity._model
    monkeypatch.setattr(
        fidelity,
        "_model",
        lambda robot, fidelity: whole(robot, fidelity) if fidelity.model == "reference" else Refusing(),
    )
    task = Task(robot="standin", index=0, hierarchy=SHORT[1:2], mujoco=True)
    found = fidelity.measured(None, task)
    assert found["reason"] == "mujoco: no" and found["mujoco_vs_pinocchio_pct"] is None
    assert found["models"][0]["reason"] == "no" and found["models"][0]["impulse_error_pct"] is None
    monkeypatch.setattr(fidelity, "_model", lambda _robot, _rung: Refusing())
    assert fidelity.measured(None, task)["reason"] == "reference: no"


def test_a_process_that_dies_is_a_failure_of_its_collision() -> None:
    found = {"robot": "r", **fidelity._crashed(-11)}
    assert fidelity.row_of("r", SHORT[0], [found])["failed"] == 1
    assert fidelity.second_opinion([found]) == {"mujoco_vs_pinocchio_pct": None, "mujoco_collisions": 0}


@pytest.mark.slow
def test_a_picture_of_the_rows(short: Report) -> None:
    figure = fidelity_picture(short.numbers["rows"])
    assert len(figure.axes) == 1 and figure.axes[0].get_title(loc="left") == "standin"


@pytest.mark.slow
def test_the_command_fidelity(monkeypatch: pytest.MonkeyPatch, short: Report, tmp_path: Any) -> None:
    asked: dict[str, Any] = {}

    def run(_say: Any, **options: Any) -> Report:
        asked.update(options)
        return short

    monkeypatch.setattr(fidelity, "run", run)
    out = str(tmp_path / "kept")
    result = runner.invoke(app, ["fidelity", "--quick", "--workers", "1", "--json", "--out", out])
    assert result.exit_code == 0, result.output
    assert asked == {"quick": True, "workers": 1}
    found = json.loads(result.stdout)
    keys = {
        "worst_impulse_error_pct",
        "median_impulse_error_pct",
        "worst_zmp_error_mm",
        "worst_torque_error_pct",
    }
    assert {"robot", "model", "freezes"} | keys <= set(found["rows"][0])
    assert {"order_in_freezes", "mujoco_vs_pinocchio_pct"} <= set(found)
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"fidelity.json", "fidelity.png"}
    screen = runner.invoke(app, ["fidelity", "--quick", "--workers", "1"])
    assert screen.exit_code == 0 and "MuJoCo against the reference" in screen.stdout
