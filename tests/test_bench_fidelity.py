"""The benches of models: errors of the ladder against full dynamics, of virtual bases against held soles."""

from __future__ import annotations

import json
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from impactopt.bench import virtual_base
from impactopt.bench.virtual_base import Hand
from impactopt.cli import app
from impactopt.collision import effective_mass
from impactopt.plotting.virtual_base import virtual_base_picture
from impactopt.presets import standin
from impactopt.robot import Robot
from impactopt.stance import BothSoles

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
    hand = Hand.of(robot, robot.postures["half_sitting"])
    rows = np.vstack([hand.soles, hand.row])
    inner = rows @ np.linalg.solve(hand.H, rows.T)
    for compliance in (0.0, 1e-5):
        held = inner[:12, :12] + compliance * np.eye(12)
        expected = inner[12, 12] - inner[12, :12] @ np.linalg.solve(held, inner[:12, 12])
        assert float(hand.inverse_mass(Decimal(compliance))) == pytest.approx(expected, rel=1e-12)


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
    result = runner.invoke(app, ["bench", "virtual-base", "--json", "--out", out])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert {"robot", "M_g", "error_model", "error_literal", "reason"} <= set(found["rows"][0])
    assert {path.name for path in (tmp_path / "kept").iterdir()} == {"virtual-base.json", "virtual_base.png"}
