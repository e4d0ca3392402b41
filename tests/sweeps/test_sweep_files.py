"""Sweep files: which cases they mean, and what is said of mistakes."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fake_solution import strike_record

from impactopt import InputError, holding_torque, planar_arm
from impactopt.files.output import save_record
from impactopt.sweeps import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.design import Axis, Design, Draws, Span


def sweep(**tables: Any) -> Sweep:
    return sweep_from_data({"sweep": {"problem": "arm_planar"}, **tables})


def cases(chosen: Sweep) -> list[tuple[Any, ...]]:
    columns = chosen.design.columns(0, chosen.design.cases)
    return list(zip(*columns.values(), strict=True))


# ---------------------------------------------------------------- cases
def test_a_grid_is_every_combination_the_last_key_fastest() -> None:
    log = {"from": 1e4, "to": 1e6, "count": 3, "scale": "log"}
    found = sweep(grid={"target.mass": [0.05, 0.1], "contact": {"stiffness_N_m": log}})
    assert list(found.design.columns(0, 1)) == ["target.mass_kg", "contact.stiffness_N_m"]
    np.testing.assert_allclose(cases(found), list(product([0.05, 0.1], [1e4, 1e5, 1e6])), rtol=1e-12)


def test_a_list_is_read_side_by_side_and_draws_go_fastest() -> None:
    found = sweep(
        grid={"contact.damping": [100.0, 200.0]},
        list={
            "target.mass": [0.05, 0.1, 0.2],
            "problem.point": [[0.7, 0, 0.75], [0.65, 0, 0.75], [0.6, 0, 0.75]],
        },
        draw={"method": "random", "count": 4, "over": {"target.resistance": {"from": 400, "to": 800}}},
    )
    assert found.design.cases == 2 * 3 * 4
    for k, (damping, mass, point, resistance) in enumerate(cases(found)):
        row = k // 4 % 3
        assert (damping, mass, point[0]) == (
            [100.0, 200.0][k // 12],
            [0.05, 0.1, 0.2][row],
            [0.7, 0.65, 0.6][row],
        )
        assert resistance == cases(found)[k % 4][3]
    some = found.design.columns(7, 11)
    assert list(zip(*some.values(), strict=True)) == cases(found)[7:11]


@pytest.mark.parametrize("method", ["random", "sobol", "latin hypercube"])
@pytest.mark.parametrize("count", [1, 48, 64])
def test_draws_are_in_range_and_of_the_seed(method: str, count: int) -> None:
    over = {"a": Span(first=2.0, last=8.0), "b": Span(first=1e-3, last=1e3, scale="log"), "c": ["x", "y"]}
    draws = {seed: Draws(method=method, count=count, seed=seed, over=over).columns() for seed in (0, 1)}
    again = Draws(method=method, count=count, seed=0, over=over).columns()
    a, b, c = (axis.values for axis in draws[0])
    assert len(a) == len(b) == len(c) == count
    assert np.min(a) >= 2 and np.max(a) <= 8 and np.min(b) >= 1e-3 and np.max(b) <= 1e3
    assert set(c) <= {"x", "y"}
    np.testing.assert_array_equal(a, again[0].values)
    assert not np.array_equal(a, draws[1][0].values)


def test_sobol_and_latin_hypercubes_are_spread_better_than_chance() -> None:
    from scipy.stats import qmc  # takes a quarter of a second, in every process that collects this file

    over = {name: Span(first=0.0, last=1.0) for name in "abc"}

    def discrepancy(method: str) -> float:
        axes = Draws(method=method, count=128, seed=3, over=over).columns()
        return float(qmc.discrepancy(np.column_stack([axis.values for axis in axes])))

    assert discrepancy("sobol") < discrepancy("latin hypercube") < discrepancy("random")
    # one point in each of so many equal parts, on every side
    axes = Draws(method="latin hypercube", count=50, seed=0, over=over).columns()
    for axis in axes:
        assert sorted((np.asarray(axis.values) * 50).astype(int)) == list(range(50))


def test_spans_end_where_they_say_and_may_go_down() -> None:
    assert Span(first=3.0, last=1.0).spread(3).tolist() == [3.0, 2.0, 1.0]
    third = Span(first=0.1, last=0.3, scale="log").at(np.linspace(0, 1, 1001))
    assert third.min() == 0.1 and third.max() == 0.3


def test_nothing_varied_is_one_case_and_whole_numbers_stay_whole() -> None:
    assert Design().cases == 1 and Design().columns(0, 1) == {}
    values = Design(grid=[Axis(key="k", values=np.array([8, 12]))]).columns(0, 2)["k"]
    assert [type(v) for v in np.asarray(values).tolist()] == [int, int]


# ---------------------------------------------------------------- files
TEXT = """\
[sweep]
problem = "arm.toml"
case_kind = "strike"
seed = 3

[grid]
target.mass_kg = [0.05, 0.1]  # dots or quotes
"contact.damping" = [100.0]
"""


def written(folder: Path, text: str = TEXT) -> Path:
    from impactopt.files.named_problems import problem_file

    (folder / "arm.toml").write_bytes(problem_file("arm_planar").read_bytes())
    (folder / "sweep.toml").write_text(text, encoding="utf-8")
    return folder / "sweep.toml"


def message(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_sweep_file(path)
    return str(caught.value)


def test_a_file_names_its_problem_relative_to_itself(tmp_path: Path) -> None:
    found = read_sweep_file(written(tmp_path))
    assert (found.name, found.settings.case_kind, found.settings.seed) == ("sweep", "strike", 3)
    assert cases(found) == [(0.05, 100.0), (0.1, 100.0)]
    assert found.problem.path == tmp_path / "arm.toml"


def test_settings_stand_in_for_what_the_file_says(tmp_path: Path) -> None:
    settings = {"grid.target.mass_kg": [0.2], "grid.contact.damping": [50.0, 60.0], "set.problem.name": "b"}
    found = read_sweep_file(written(tmp_path), settings)
    assert cases(found) == [(0.2, 50.0), (0.2, 60.0)]
    assert found.problem.content.problem.name == "b"
    again = tmp_path / "as_it_was_kept.toml"
    again.write_text(found.text, encoding="utf-8")
    assert read_sweep_file(again).hash == found.hash != read_sweep_file(written(tmp_path)).hash
    for key, value in (("sweep.case_kind", "collisions"), ("grid", 3), ("draw", "much"), ("draw.over", 1)):
        with pytest.raises(InputError, match=key.split(".")[-1]):
            read_sweep_file(written(tmp_path), {key: value})


def test_a_setting_that_varies_is_refused_without_a_line_that_no_file_has(tmp_path: Path) -> None:
    """The command's --set changed nothing where the grid has the key."""
    with pytest.raises(InputError, match=r"sweep\.toml, as set, \[set\] target\.mass: varies in grid"):
        read_sweep_file(written(tmp_path), {"set.target.mass": 8.0})
    coordinate = read_sweep_file(
        written(tmp_path), {"set.problem.point": [0.7, 0.0, 0.8], "grid.problem.point.0": [0.6]}
    )
    assert coordinate.design.cases == 2, "a coordinate of a constant point may vary"


def test_constants_that_no_collision_depends_on_are_let_be(tmp_path: Path) -> None:
    """They are those of a problem whose plans are swept, too."""
    text = (
        TEXT.replace('"strike"', '"collision"')
        + "\n[at_contact]\nspeed_m_s = 1.0\n[set]\nswing.duration = 1.0"
    )
    assert read_sweep_file(written(tmp_path, text)).design.cases == 2


def test_sweeps_of_the_package_go_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = read_sweep_file("collision_target")
    assert found.design.cases == 10_000 and found.problem.path.name == "punch.toml"
    listed = r"no sweep 'colision_target' .did you mean 'collision_target'.*collision_million.*path of a file"
    with pytest.raises(InputError, match=listed):
        read_sweep_file("colision_target")
    with pytest.raises(InputError, match=r"no file collision_target\.toml here.*sweep is named"):
        read_sweep_file("collision_target.toml")


def test_all_mistakes_are_told_with_their_lines(tmp_path: Path) -> None:
    text = TEXT.replace('case_kind = "strike"', 'case_kind = "strik"\nworkers = 2')
    said = message(written(tmp_path, text))
    assert "line 3, [sweep] case_kind: 'strik' is unknown (did you mean 'strike'?)" in said
    assert "line 4, [sweep] workers: unknown key" in said


def test_keys_and_values_are_the_problem_files(tmp_path: Path) -> None:
    bad = TEXT.replace("[0.05, 0.1]", "[0.05, -1.0]").replace("contact.damping", "contact.dampin")
    said = message(written(tmp_path, bad))
    assert "line 8, [grid] contact.dampin: " in said and "did you mean 'damping" in said
    said = message(written(tmp_path, TEXT.replace("[0.05, 0.1]", "[0.05, -1.0]")))
    assert "line 7, [grid] target.mass_kg: with target.mass_kg = -1.0: " in said
    assert said.endswith("give a number > 0")


@pytest.mark.parametrize(
    ("more", "wrong"),
    [
        ("[set]\ntarget.mas = 3.0", "has no key 'mas'"),
        ("[list]\ntarget.mass = [1.0]", "line 11, [list] target.mass: is also given by grid.target.mass_kg"),
        (
            "[list]\ncontact.stiffness = [1e5, 2e5]\ntarget.resistance = [1.0]",
            "1 values, but contact.stiffness_N_m has 2",
        ),
        ("[list]\ncontact.stiffness = 3", "[list] contact.stiffness: 3; give a list of values"),
        ("[draw]\ncount = 3\n[draw.over]\n", "[draw.over]: empty"),
        ("[list]\ntarget.resistance = {from = 1.0, to = 2.0, count = 1000000000}", "10000000"),
        ("[draw]\ncount = 1000000000\nover.target.resistance = {from = 1.0, to = 3.0}", "10000000"),
        (
            "[draw]\ncount = 3\nover.target.resistance = {from = -1.0, to = 3.0}",
            "[draw.over] target.resistance: with",
        ),
        (
            "[draw]\ncount = 3\nover.target.resistance = {from = 0.0, to = 3.0, scale = 'log'}",
            "must be > 0 for a log",
        ),
        ("[draw]\ncount = 3\nover.target.resistance = {from = 1.0, count = 2}", "to: missing"),
        ("[list]\ntarget.resistance = {from = 1.0, to = 2.0, count = 1}", "count = 1 leaves out to"),
        ("[set]\ntarget.mass = 3.0", "line 11, [set] target.mass: varies in grid.target.mass_kg"),
        ("[set]\nat_contact.speed = 3.0", "[set] at_contact.speed: give it in the table [at_contact]"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, more: str, wrong: str) -> None:
    assert wrong in message(written(tmp_path, f"{TEXT}\n{more}\n"))


def test_the_hash_is_of_what_is_done_not_of_how_it_is_written(tmp_path: Path) -> None:
    first = read_sweep_file(written(tmp_path)).hash
    assert read_sweep_file(written(tmp_path, f"# a comment\n{TEXT}")).hash == first
    assert read_sweep_file(written(tmp_path, TEXT.replace("0.1]", "0.11]"))).hash != first
    path = written(tmp_path)
    problem = tmp_path / "arm.toml"
    problem.write_text(problem.read_text().replace("mass_kg = 0.05", "mass_kg = 0.06"), encoding="utf-8")
    assert read_sweep_file(path).hash != first


def test_the_hash_is_of_the_saved_result_too(tmp_path: Path) -> None:
    robot, hashes = planar_arm(), set()
    q = robot.posture("ready")
    for rate in (1.0, 1.0, 2.0):
        v = np.array([0.3, rate, 0.4])
        save_record(strike_record(robot, q, v, holding_torque(robot, q, v)), tmp_path)
        data = {"problem": "arm_planar", "case_kind": "collision"}
        hashes.add(sweep_from_data({"sweep": data, "at_contact": {"result": str(tmp_path)}}).hash)
    assert len(hashes) == 2
