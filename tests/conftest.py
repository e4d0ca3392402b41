"""What several test files share, and is dear: the plans of the demo and of the small robots."""

from __future__ import annotations

import gc
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: tests run on all cores as it is

import pytest
from support.small_plans import Planned, arm_problem, biped_problem, planned, transcribed

from impactopt import Solution, load_problem, solve
from impactopt.transcription.transcription import Transcription

os.environ.setdefault("IMPACTOPT_COMPILE", "quick")  # `as_shipped` takes it away


def pytest_configure(config: pytest.Config) -> None:
    """Workers get files in the order of collection. By the number of their tests, as xdist has it, a long
    file of few tests would be among the last, and the other workers would wait for it.
    """
    config.option.loadscopereorder = False


def pytest_collection_finish() -> None:
    """Collects garbage seldom and without 5000 collected tests: it took an eighth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)


@pytest.fixture
def as_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions compiled as users have them."""
    monkeypatch.delenv("IMPACTOPT_COMPILE")


@pytest.fixture(scope="session")
def punch() -> Solution:
    """The plan of `make demo`; its functions come from the cache after the first time."""
    return solve(load_problem(Path(__file__).resolve().parents[1] / "problems" / "punch.toml"))


@pytest.fixture(scope="session")
def hammered() -> Solution:
    """The plan of `arm_planar`: a blow on a nail, quickly solved."""
    return solve(load_problem("arm_planar"))


@pytest.fixture(scope="session")
def biped_transcription() -> Transcription:
    return transcribed(biped_problem())


@pytest.fixture(scope="session")
def arm_transcription() -> Transcription:
    return transcribed(arm_problem())


@pytest.fixture(scope="session")
def biped_plan(biped_transcription: Transcription) -> Planned:
    return planned(biped_transcription)


@pytest.fixture(scope="session")
def arm_plan(arm_transcription: Transcription) -> Planned:
    return planned(arm_transcription)
