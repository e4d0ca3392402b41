"""The bench of infeasible arms: its counts are those of its rows."""

from __future__ import annotations

import json

import pytest

from benchmarks.registry import run_bench
from impactopt.codegen.compiler import find_compiler


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_a_row_a_draw() -> None:
    report = run_bench("causes", lambda text: None, problems=("arm_planar",), draws=2, seed=2)
    numbers = report.numbers
    assert len(numbers["rows"]) == numbers["draws"] == 2
    kinds = ("solved", "confirmed", "not_confirmed", "point_masses", "no_cause")
    assert sum(numbers[kind] for kind in kinds) == 2
    assert numbers["not_confirmed"] == 0
    for row in numbers["rows"]:
        assert (row["moved"] in ("solved", "acceptable")) == (row["kind"] == "confirmed")
    json.dumps(numbers)
    assert report.tables[0].row_count == 2
