"""A folder of solved problems: which one is near, and what starting from it brings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from support.native_cases import HARDENING
from typer.testing import CliRunner

from impactopt import FreeMass, Impulse, InputError, Solution, Status, load_solution, sensitivity_of
from impactopt.cli.app import app
from impactopt.files.problem_file import ProblemFile, read_problem_file
from impactopt.files.record import NUMBERS
from impactopt.files.solution_library import SolvedFolder
from impactopt.planning.solve import solve
from impactopt.sweeps import sweep_from_data
from impactopt.sweeps.design import Unit, Work
from impactopt.sweeps.evaluate import evaluate
from impactopt.sweeps.progress import START, ProgressCounter

ARM = Path(__file__).resolve().parents[2] / "problems" / "arm_planar.toml"


def arm(**settings: Any) -> ProblemFile:
    return read_problem_file(ARM, {key.replace("__", "."): value for key, value in settings.items()})


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(arm().build(), refine=False)


def two_kept(solution: Solution, path: Path) -> SolvedFolder:
    folder = SolvedFolder(path)
    folder.keep(solution, arm(), "plain")
    folder.keep(solution, arm(contact__stiffness_N_m=1e6), "stiff")
    return folder


@pytest.fixture
def folder(solution: Solution, tmp_path: Path) -> SolvedFolder:
    return two_kept(solution, tmp_path / "solved")


@pytest.fixture(scope="module")
def library(solution: Solution, tmp_path_factory: pytest.TempPathFactory) -> SolvedFolder:
    """To be read only."""
    return two_kept(solution, tmp_path_factory.mktemp("library"))


@pytest.mark.parametrize(
    ("settings", "name", "distance"),
    [
        ({"contact__stiffness_N_m": 1e6}, "stiff", 0.0),
        ({"target__mass_kg": 0.1}, "plain", 1.0),
        ({"problem__point_m": [0.72, 0.0, 0.75]}, "plain", 0.2),
        ({"problem__name": "other", "solver__time_limit_s": 60.0}, "plain", 0.0),
        ({"contact__stiffness_N_m": 8e5}, "stiff", 0.322),
    ],
)
def test_the_nearest_is_found(
    library: SolvedFolder, settings: dict[str, Any], name: str, distance: float
) -> None:
    near = library.nearest(arm(**settings))
    assert near is not None and near.path.name == name
    assert near.distance == pytest.approx(distance, abs=1e-3)


@pytest.mark.parametrize(
    "settings",
    [
        {"contact__stiffness_N_m": 1e9},  # ten factors of two
        {"swing__intervals": 40},  # 2 ** 2
        {"terms__gear_load__limit": 3.0},
        {"contact__law": "spring damper"},
    ],
    ids=lambda settings: next(iter(settings)),
)
def test_what_is_far_or_of_another_kind_is_none(library: SolvedFolder, settings: dict[str, Any]) -> None:
    assert library.nearest(arm(**settings)) is None


@pytest.mark.slow
def test_a_start_from_a_neighbour_is_quicker(folder: SolvedFolder) -> None:
    file = arm(target__mass_kg=0.055)
    problem = file.build()
    found, near = folder.solve(problem, file, refine=False)
    assert near is not None and near.path.name == "plain"
    cold = solve(problem, refine=False)
    assert found.status.value == "solved" and found.result.iterations < cold.result.iterations / 2
    assert found.result.objective == pytest.approx(cold.result.objective, rel=1e-5)


def test_a_damaged_neighbour_is_no_start(folder: SolvedFolder) -> None:
    for name in ("plain", "stiff"):
        numbers = folder.path / name / NUMBERS
        numbers.write_bytes(numbers.read_bytes()[:-2000])
    found, near = folder.solve(arm().build(), arm(), refine=False)
    assert near is None and found.status.usable
    with pytest.raises(InputError, match="several starts"):
        folder.solve(arm().build(), arm(), starts=2)


@pytest.mark.slow
def test_cases_of_a_sweep_start_from_each_other(tmp_path: Path) -> None:
    chosen = sweep_from_data(
        {
            "sweep": {"problem": "arm_planar", "start": "neighbour"},
            "grid": {"target.mass": [0.05, 0.055]},
        }
    )
    work = Work(
        data=chosen.problem.data, path=chosen.problem.path, settings=chosen.settings, solved=tmp_path / "s"
    )
    counter, rows = ProgressCounter(2), list[Any]()
    for case, mass in enumerate((0.05, 0.055)):
        unit = Unit(index=case, first=case, count=1, columns={"target.mass_kg": [mass]})
        found = evaluate(work, unit)
        counter.add(case, found.columns, 0.0)
        rows.append(found.columns)
    assert [row[START][0] for row in rows] == ["", "000000"]
    assert rows[1]["iterations"][0] < rows[0]["iterations"][0] / 2
    assert counter.iterations == {
        "neighbour": rows[1]["iterations"][0],
        "reach": rows[0]["iterations"][0],
    }


@pytest.mark.parametrize("other", [{"case_kind": "strike"}, {"starts": 2}])
def test_sweeps_without_neighbours_say_so(other: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="neighbour"):
        sweep_from_data(
            {
                "sweep": {"problem": "arm_planar", "start": "neighbour", **other},
                "grid": {"target.mass": [0.05]},
            }
        )


@pytest.mark.slow
def test_solve_keeps_and_finds_plans(tmp_path: Path) -> None:
    options = ["--store", str(tmp_path / "store"), "--no-validate", "--out", str(tmp_path / "out")]
    runner = CliRunner()
    first = runner.invoke(app, ["solve", str(ARM), *options])
    assert first.exit_code == 0 and "near enough" in first.output, first.output
    again = runner.invoke(app, ["solve", str(ARM), "--set", "target.mass=0.055", *options])
    assert again.exit_code == 0 and "warm start from" in again.output, again.output
    assert len(list((tmp_path / "store").iterdir())) == 2


@pytest.mark.slow
def test_a_saved_result_is_a_solution_again(folder: SolvedFolder, solution: Solution, tmp_path: Path) -> None:
    again, price = load_solution(folder.path / "plain"), "terms.torque_limit.collision"
    assert again.status is solution.status and again.impulse == pytest.approx(solution.impulse, rel=1e-12)
    assert again.trajectory.q == pytest.approx(solution.trajectory.q, abs=1e-12)
    expected = sensitivity_of(solution, price).impulse
    assert again.sensitivity(price).impulse == pytest.approx(expected, rel=1e-6)
    with pytest.raises(InputError, match=r"there is no .*solution\.npz"):
        load_solution(tmp_path / "nothing")
    with pytest.raises(InputError, match="path of its directory, not None"):
        load_solution(None)  # type: ignore[arg-type]


def test_a_solution_is_saved_from_python(hammered: Solution, tmp_path: Path) -> None:
    folder = hammered.save(tmp_path / "nail")
    loaded = load_solution(folder)
    assert folder == tmp_path / "nail" and loaded.problem.hash == hammered.problem.hash
    assert loaded.trajectory.q == pytest.approx(hammered.trajectory.q, abs=1e-9)
    # with the forces between the program's points, where the peak may be
    assert loaded.collision.time == pytest.approx(hammered.collision.time, abs=1e-12)
    assert loaded.collision.peak_force == pytest.approx(hammered.collision.peak_force, rel=1e-9)
    assert loaded.contact_error_pct == pytest.approx(hammered.contact_error_pct, rel=1e-6)
    shown = CliRunner().invoke(app, ["verify", str(folder), "--quiet"])
    assert shown.exit_code == 0, shown.output
    result = dataclasses.replace(hammered.result, status=Status.FAILED)
    failed = dataclasses.replace(hammered, result=result)
    assert failed.save(folder) == folder / "failed"
    mass = dataclasses.replace(
        hammered.problem, target=FreeMass(mass=1.0), law=HARDENING, objectives=(Impulse(),)
    )
    own = dataclasses.replace(hammered, problem=mass)
    with pytest.raises(InputError, match="CustomLaw"):
        own.save(tmp_path / "own")
    assert not (tmp_path / "own").exists()
