"""Bent plans: the numbers that the bench says it has, of shifts that have a plan."""

from __future__ import annotations

import json

import pytest

from benchmarks.registry import run_bench
from impactopt.codegen.compiler import find_compiler


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_a_row_a_problem() -> None:
    report = run_bench("moved", lambda text: None, problems=("arm_planar",), shifts=3)
    numbers = report.numbers
    (row,) = numbers["rows"]
    assert row["problem"] == "arm_planar" and numbers["shifts"] == row["shifts"] == 3
    for key in ("first_order_ms_median", "polished_ms_median", "polished_ms_worst"):
        assert numbers[key] == row[key] > 0
    assert row["polished_ms_median"] <= row["polished_ms_worst"]
    assert row["first_order_impulse_error_pct_median"] <= row["first_order_impulse_error_pct_worst"]
    assert row["polished_solved"] == 3
    json.dumps(numbers)
    assert report.tables[0].row_count == 1
