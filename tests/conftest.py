"""What several test files share, and is dear: the demo's plan."""

from __future__ import annotations

from pathlib import Path

import pytest

from impactopt.planner import solve
from impactopt.problem_file import load_problem
from impactopt.solution import Solution


@pytest.fixture(scope="session")
def punch() -> Solution:
    """The plan of `make demo`; its functions come from the cache after the first time."""
    return solve(load_problem(Path(__file__).resolve().parents[1] / "problems" / "punch.toml"))
