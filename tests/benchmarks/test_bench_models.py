"""Plan time against plan truth: rows, a model that cannot, and the picture."""

from __future__ import annotations

import json

import pytest

from benchmarks import models
from benchmarks.registry import run_bench
from impactopt.codegen.compiler import find_compiler


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_a_row_a_model() -> None:
    said: list[str] = []
    rungs = (("virtual-mass", 0), ("sdc", 0), ("full", 0))
    report = run_bench("models", said.append, problems=("arm_planar",), models=rungs)
    rows = report.numbers["rows"]
    assert [(row["problem"], row["model"], row["freezes"]) for row in rows] == [
        ("arm_planar", *rung) for rung in rungs
    ]
    mass, frozen, full = rows
    assert mass["planned_Ns"] is None and "SpringDamper only" in mass["reason"]
    for row in (frozen, full):
        assert row["status"] == "solved" and row["seconds"] > 0 and row["iterations"] > 0
        assert row["error_pct"] == pytest.approx(100 * (row["planned_Ns"] / row["replayed_Ns"] - 1))
        assert row["stands"] is None and row["zmp_margin_planned_mm"] is None  # an arm on a fixed base
    assert abs(full["error_pct"]) < 0.1 < abs(frozen["error_pct"]) < 1
    # what a frozen model says of itself is what its replay says
    assert frozen["model_error_pct"] == pytest.approx(frozen["error_pct"], abs=0.1)
    json.dumps(rows)
    assert report.tables[0].row_count == 3 and "arm_planar: sdc" in said
    axes = report.figures["models"]().axes
    assert [a.get_title(loc="left") for a in axes] == ["arm_planar"]
    assert len(axes[0].lines) == 2


def test_the_quick_one_has_arms_only() -> None:
    assert set(models.QUICK) == {"arm_planar", "arm7"}
