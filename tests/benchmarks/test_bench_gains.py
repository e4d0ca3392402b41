"""The bench of gains: its ends, its rows and its picture."""

from __future__ import annotations

import pytest

from benchmarks import gains
from benchmarks.registry import run_bench


def test_the_impulse_goes_from_free_joints_to_one_rigid_body(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gains, "FACTORS", (1e-8, 1.0, 1e2, 1e8))
    said: list[str] = []
    report = run_bench("gains", said.append, robots=("planar_arm",))
    rows = report.numbers["rows"]
    assert said == ["planar_arm"]
    assert [row["factor"] for row in rows] == [1e-8, 1.0, 1e2, 1e8]
    shares = [row["share"] for row in rows]
    assert shares[0] == pytest.approx(0.0, abs=1e-6) and shares[-1] == pytest.approx(1.0, abs=1e-6)
    assert shares == sorted(shares)
    # a wall gives back all that the damper has not taken
    assert rows[0]["locked_Ns"] == gains.impulse_of(float("inf")) > gains.impulse_of(1.0) > 0.5
    (line, own) = report.figures["gains"]().axes[0].lines
    assert list(line.get_ydata()) == shares and set(own.get_xdata()) == {1.0}


def test_quick_is_of_arms() -> None:
    assert set(gains.QUICK) == {"planar_arm", "arm7"}
