"""Pictures: what is drawn is the solution's own numbers, with units, and nothing lies over anything else."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.figures import FIGURES, app, chosen, drawn
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from PIL import Image
from support.fake_solution import MissingSolution, still_problem, still_solution
from support.picture_checks import frowns
from support.small_plans import Planned, solution_of
from typer.testing import CliRunner

from impactopt import FreeMass, Ground, InputError, Phase, effective_mass, load_problem, solve
from impactopt.files.output import record_of
from impactopt.files.record import Record
from impactopt.kinematics.stance import zmp
from impactopt.report.charts import charts_of
from impactopt.report.pictures import PICTURES, hierarchy, overview
from impactopt.report.pictures.compare import comparison_picture
from impactopt.report.pictures.poses import effective_masses
from impactopt.report.pictures.style import DPI, PAGE, Picture
from impactopt.simulation.reference.poses import inverse_mass, poses_of

ROOT = Path(__file__).resolve().parents[3]
DRAWS: dict[str, Callable[[Record], Picture | None]] = {"overview": overview, **PICTURES}
LABELLED = re.compile(r"\[[^\]]+\]|/ limit")


@pytest.fixture(scope="module")
def punch_record(biped_plan: Planned) -> Record:
    """A biped's plan, solved and simulated; its replay on free soles is made up."""
    solution = solution_of(biped_plan)
    made = still_solution(problem=still_problem()).validate(engine="mujoco")
    q = np.tile(solution.trajectory.q[0], (len(made.time), 1))
    made = dataclasses.replace(made, q=q, expected=np.nan)
    return record_of(solution, simulation=biped_plan.simulation, replay=made)


@pytest.fixture(scope="module")
def arm_record(arm_plan: Planned) -> Record:
    return record_of(solution_of(arm_plan), simulation=arm_plan.simulation)


@pytest.fixture(scope="module")
def records(punch_record: Record, arm_record: Record) -> dict[str, Record]:
    still, missing = still_solution(), still_solution(kind=MissingSolution)
    return {
        "biped": punch_record,
        "arm": arm_record,
        "plan alone": record_of(still),
        "missed": record_of(missing, simulation=missing.validate()),
    }


# ---------------------------------------------------------------- what a person would frown at
# Of poses and iterations there is nothing that a plan alone, or a missed target, changes.
BY_ROBOT = ("strobe", "ellipsoid", "iterations")
DRAWN = [(which, name) for which in ("biped", "arm") for name in DRAWS]
DRAWN += [(which, name) for which in ("plan alone", "missed") for name in DRAWS if name not in BY_ROBOT]
DRAWN.remove(("plan alone", "overview"))  # whose parts are drawn each, and beside each other for the others


@pytest.mark.parametrize(("which", "name"), DRAWN)
def test_nothing_is_cut_or_lies_over_anything_else(records: dict[str, Record], which: str, name: str) -> None:
    picture = DRAWS[name](records[which])
    if picture is None:
        assert name in ("zmp", "replay")
        return
    assert frowns(picture) == []
    assert picture.get_size_inches()[0] <= PAGE
    for axes in picture.axes:
        for text in (axes.get_xlabel(), axes.get_ylabel()):
            assert not text or LABELLED.search(text), text
    assert any(axes.get_xlabel() for axes in picture.axes)


def test_a_long_title_takes_two_lines(punch_record: Record) -> None:
    """As of a robot with a long name that fell, for a reason with numbers."""
    name = "first strike of a robot with quite a long name, as its exporter wrote it, and of its friends"
    long = dataclasses.replace(punch_record, summary={**punch_record.summary, "problem": {"name": name}})
    picture = PICTURES["replay"](long)
    assert picture is not None and name in picture.get_suptitle().replace("\n", " ")
    assert frowns(picture) == []


def test_frowns_are_found() -> None:
    picture = Picture(3.0, 2.0)
    axes = picture.subplots()
    axes.plot([0, 1], [0, 1], label="a line")
    assert frowns(picture) == []
    axes.legend(loc="center")
    axes.text(0.2, 0.8, "one text", transform=axes.transAxes)
    axes.text(0.25, 0.8, "another text", transform=axes.transAxes)
    picture.text(0.9, 0.3, "a text that leaves the picture")
    found = " ".join(frowns(picture))
    assert "a legend" in found and "'one text' lies over 'another text'" in found
    assert "cut: 'a text that leaves the picture'" in found


def test_a_picture_is_sharp_and_as_large_as_it_says(punch_record: Record) -> None:
    picture = PICTURES["zmp"](punch_record)
    assert picture is not None
    content, shown = picture._repr_png_()
    image = Image.open(io.BytesIO(content))
    assert image.size[0] == round(PAGE * DPI)
    assert shown["width"] == image.size[0] // 2


# ---------------------------------------------------------------- what is drawn
def test_the_polygon_of_a_plan_with_steps_is_that_at_contact(punch_record: Record) -> None:
    end = float(punch_record.arrays["reference_time"][-1])
    stances = [{"soles": ["left", "right"], "from_s": 0.0, "to_s": end}]
    stepping = dataclasses.replace(punch_record, summary={**punch_record.summary, "stances": stances})
    for record, name in ((punch_record, "support polygon"), (stepping, "support polygon at contact")):
        picture = PICTURES["zmp"](record)
        assert picture is not None
        assert name in [text.get_text() for text in picture.legends[0].get_texts()]
        notes = "".join(chart.get("note", "") for chart in charts_of(record)[0])
        assert ("The polygon is that at contact." in notes) == (record is stepping)


def test_the_force_is_the_plans_and_the_simulations(punch_record: Record) -> None:
    a, picture = punch_record.arrays, PICTURES["force"](punch_record)
    assert picture is not None
    planned, simulated = picture.axes[0].lines
    np.testing.assert_array_equal(planned.get_ydata(), a["collision_force"])
    np.testing.assert_array_equal(planned.get_xdata(), 1e3 * a["collision_time"])
    assert np.max(simulated.get_ydata()) == punch_record.summary["simulated"]["peak_force_N"]
    x, y = simulated.get_data()
    impulse = float(np.trapezoid(y, 1e-3 * np.asarray(x)))
    assert impulse == pytest.approx(punch_record.summary["simulated"]["impulse_Ns"], rel=1e-3)


def test_a_pull_of_a_plan_that_is_no_solution_is_in_the_pictures(punch_record: Record) -> None:
    force = punch_record.arrays["collision_force"].copy()
    force[1] = -240.0
    pulls = dataclasses.replace(punch_record, arrays={**punch_record.arrays, "collision_force": force})
    for picture in (PICTURES["force"](pulls), comparison_picture({"one": pulls, "other": punch_record})):
        assert picture is not None
        assert picture.axes[0].get_ylim()[0] <= -240.0
    usual = PICTURES["force"](punch_record)
    assert usual is not None and usual.axes[0].get_ylim()[0] == pytest.approx(0.0, abs=1e-6)


def test_the_zero_moment_point_is_the_plans_with_time_as_colour(punch_record: Record) -> None:
    a, picture = punch_record.arrays, PICTURES["zmp"](punch_record)
    assert picture is not None
    (marks,) = [c for c in picture.axes[1].collections if isinstance(c, PathCollection)]
    points = zmp(a["collision_ground"])
    np.testing.assert_allclose(marks.get_offsets(), np.column_stack([-points[:, 1], points[:, 0]]))
    np.testing.assert_allclose(np.asarray(marks.get_array()), 1e3 * a["collision_time"][1:])
    assert any(isinstance(c, LineCollection) for c in picture.axes[1].collections), "simulated"
    polygon = next(line for line in picture.axes[1].lines if len(line.get_xdata()) == len(a["polygon"]) + 1)
    np.testing.assert_allclose(np.asarray(polygon.get_ydata())[:-1], a["polygon"][:, 0])


def test_poses_are_the_motions_by_forward_kinematics(biped_plan: Planned, punch_record: Record) -> None:
    problem, reference = biped_plan.problem, biped_plan.trajectory
    a = punch_record.arrays
    k = int(a["pose_contact"])
    assert a["pose_time"][k] == pytest.approx(reference.contact_start)
    assert a["pose_time"][0] == 0.0 and abs(a["pose_time"][-1] - reference.end) < 1e-3
    # at contact the striking point is where it is to hit, and the soles are on the ground, all the time
    np.testing.assert_allclose(a["pose_links"][k][0][1], problem.point, atol=1e-6)
    soles = a["pose_links"][:, -1], a["pose_links"][:, -3]
    np.testing.assert_allclose([sole[..., 2] for sole in soles], 0.0, atol=1e-6)
    # links are rigid
    lengths = np.linalg.norm(np.diff(a["pose_links"], axis=2), axis=-1)[..., 0]
    np.testing.assert_allclose(lengths, np.tile(lengths[0], (len(lengths), 1)), atol=1e-9)
    np.testing.assert_allclose(a["pose_path"][0], a["pose_links"][0][0][1])


def test_the_strobe_draws_every_pose_and_the_way(punch_record: Record) -> None:
    a, picture = punch_record.arrays, PICTURES["strobe"](punch_record)
    assert picture is not None
    (axes,) = picture.axes
    assert [t.get_text() for t in axes.get_xticklabels()] == [f"{t:.2f}" for t in a["pose_time"]]
    heights = np.concatenate([np.asarray(line.get_ydata()) for line in axes.lines])
    for links in a["pose_links"]:
        assert np.isin(links[:, :, 2].ravel(), heights).all()


@pytest.mark.parametrize(("which", "heights"), [("biped", [0.0]), ("arm", []), ("arm on a floor", [-0.7])])
def test_the_strobe_draws_a_ground_where_there_is_one(
    records: dict[str, Record], arm_plan: Planned, which: str, heights: list[float]
) -> None:
    record = records[which.split()[0]]
    if "floor" in which:
        problem = dataclasses.replace(arm_plan.problem, ground=Ground(height=-0.7))
        poses = poses_of(problem, arm_plan.trajectory)
        record = dataclasses.replace(record, arrays={**record.arrays, "pose_ground": poses.ground})
    picture = PICTURES["strobe"](record)
    assert picture is not None
    (axes,) = picture.axes
    lines = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]
    across = [np.asarray(line.get_xdata(), dtype=float) for line in axes.lines]
    found = [y[0] for x, y in zip(across, lines, strict=True) if list(x) == [0, 1] and y[0] == y[-1]]
    assert found == heights
    assert all(axes.get_ylim()[0] < height for height in heights)


def test_the_strobe_draws_the_target_as_large_as_it_is(biped_plan: Planned, punch_record: Record) -> None:
    picture = PICTURES["strobe"](punch_record)
    assert picture is not None
    (target,) = [body for body in biped_plan.problem.world if body.name == "target"]
    drawn = [np.asarray(patch.get_xy()) for patch in picture.axes[0].patches]
    assert len(drawn) == len(punch_record.arrays["pose_time"])
    for corners in drawn:
        deep, high = 2 * target.half[2], 2 * target.half[1]
        np.testing.assert_allclose(np.ptp(corners, axis=0), [deep, high], atol=1e-9)
        assert corners[:, 1].mean() == pytest.approx(target.place[2], abs=0.5 * high)


def test_the_mass_at_the_fist_is_the_collision_models_effective_mass(biped_plan: Planned) -> None:
    """One computed with Pinocchio's mass matrix, the other from our symbolic frozen dynamics."""
    problem, q = biped_plan.problem, biped_plan.trajectory.q[10]
    inverse = inverse_mass(problem, q)
    for n in (problem.normal, np.array([0.6, 0.0, 0.8]), np.array([0.0, -1.0, 0.0])):
        symbolic = effective_mass(problem.robot, striker=problem.striker, normal=n, stance=problem.stance)
        assert effective_masses(inverse, n[None])[0] == pytest.approx(float(symbolic(q)), rel=1e-9)


def test_the_mass_of_the_blow_is_marked(punch_record: Record) -> None:
    a, picture = punch_record.arrays, PICTURES["ellipsoid"](punch_record)
    assert picture is not None
    mass = 1.0 / (a["pose_normal"] @ a["pose_inverse_mass"] @ a["pose_normal"])
    (marked,) = [line for line in picture.axes[-1].lines if line.get_marker() == "o"]
    assert np.asarray(marked.get_ydata()).item() == pytest.approx(mass)
    assert f"{mass:.1f} kg" in str(picture.get_suptitle())


def test_the_solvers_way_is_its_history(punch_record: Record) -> None:
    a, picture = punch_record.arrays, PICTURES["iterations"](punch_record)
    assert picture is not None
    (gain,) = picture.axes[0].lines
    np.testing.assert_array_equal(gain.get_ydata(), -a["history_objective"])
    low, high = picture.axes[0].get_ylim()
    assert low <= -a["history_objective"][-1] <= high
    # the history has only the time in the iterations, less than `solve_seconds` on the page and in the table
    assert picture.axes[1].get_xlabel() == "iterations [-]"


def test_the_torque_map_is_the_demand_over_the_limit(arm_record: Record) -> None:
    a, picture = arm_record.arrays, PICTURES["torque"](arm_record)
    assert picture is not None
    largest = max(float(np.max(np.asarray(axes.collections[0].get_array()))) for axes in picture.axes[:3])
    assert largest == pytest.approx(np.abs(a["simulated_demand"] / a["torque_limit"]).max(), rel=1e-6)


# ---------------------------------------------------------------- the hierarchy
def blow(force: float, end: float) -> Any:
    time = np.linspace(0.0, end, 200)
    return SimpleNamespace(
        time=time, force=force * (1 - time / end), impulse=force * end / 2, duration=end, peak_force=force
    )


def test_the_ladder_holds_each_model_against_the_reference() -> None:
    models = {"coarse": blow(300.0, 0.04), "fine": blow(399.0, 0.05), "full dynamics": blow(400.0, 0.05)}
    picture = hierarchy({"one": models, "two": models})
    assert frowns(picture) == []
    left, right = picture.axes[:2]
    assert len(left.lines) == 3
    legend = right.get_legend()
    assert legend is not None
    assert [t.get_text() for t in legend.get_texts()] == ["-40.00 %", "-0.25 %"]
    # what the impulse is off by at the end: 10 N s true, 6 and 9.975 N s
    ends = [np.asarray(line.get_ydata())[-1] for line in right.lines if len(line.get_xdata())]
    np.testing.assert_allclose(ends, [4.0, 0.025], rtol=1e-3)


def test_a_ladder_without_its_reference_is_refused() -> None:
    with pytest.raises(InputError, match="needs the model 'full dynamics'"):
        hierarchy({"one": {"coarse": blow(300.0, 0.04)}})
    with pytest.raises(InputError, match="at most 7 models"):
        hierarchy({"one": {**{str(k): blow(1.0, 0.1) for k in range(8)}, "full dynamics": blow(1.0, 0.1)}})


# ---------------------------------------------------------------- of a solution
def test_a_solution_draws_itself() -> None:
    solution = still_solution()
    assert len(solution.plot().axes) >= 4
    with_simulation = solution.plot("force", simulation=solution.validate())
    assert len(with_simulation.axes[0].lines) == 2 and len(solution.plot("force").axes[0].lines) == 1
    assert solution.plot("replay", replay=solution.validate(engine="mujoco")) is not None
    with pytest.raises(InputError, match=r"no picture 'forse' \(did you mean 'force'"):
        solution.plot("forse")
    with pytest.raises(InputError, match="nothing to draw as 'replay': it needs replay"):
        solution.plot("replay")


def test_a_replay_draws_every_sole() -> None:
    solution = still_solution()
    record = record_of(solution, replay=solution.validate(engine="mujoco"))
    arrays = {name: record.arrays[f"replayed_{name}"] for name in ("soles", "sole_ground", "slip", "lift")}
    both = {f"replayed_{name}": np.concatenate([x, x], axis=min(x.ndim - 1, 1)) for name, x in arrays.items()}
    drawn = PICTURES["replay"](dataclasses.replace(record, arrays={**record.arrays, **both}))
    assert drawn is not None
    _, force, move = drawn.axes
    assert len(force.lines) == len(both["replayed_soles"]) == 4 and len(move.lines) == 8
    assert len({line.get_color() for line in force.lines}) == 4


def test_poses_of_an_instant_impact_have_no_end_of_contact(biped_plan: Planned) -> None:
    import dataclasses

    reference = biped_plan.trajectory
    instant = dataclasses.replace(reference, contact_end=reference.contact_start)
    assert (
        len(poses_of(biped_plan.problem, instant).time)
        == len(poses_of(biped_plan.problem, reference).time) - 1
    )


# ---------------------------------------------------------------- figures of the docs
def test_every_figure_of_the_documents_has_its_command() -> None:
    used = set()
    for file in [*ROOT.glob("docs/**/*.md"), ROOT / "README.md"]:
        used |= set(re.findall(r"figures/([\w-]+)\.(?:png|svg)", file.read_text(encoding="utf-8")))
    assert len(used) > 8
    rendered = {"hero", "robots"}
    assert used - rendered <= set(FIGURES), "add them to FIGURES; docs/hero.py makes the rendered ones"
    kept = {path.stem for path in (ROOT / "docs" / "figures").glob("*.png")}
    assert kept == used, "figures that are made but not shown, or shown but not there"


def test_figures_are_made_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def maker(source: str, say: Any) -> Callable[[str], Picture]:
        made.append(source)
        return lambda name: Picture(1.0, 1.0)

    monkeypatch.setattr(
        "benchmarks.figures._MAKERS",
        dict.fromkeys(("plot", "reproduce", "bench", "sweep"), maker),
    )
    result = CliRunner().invoke(app, ["zmp", "fig7", "force", "--quiet", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in tmp_path.iterdir()) == ["fig7.png", "force.png", "zmp.png"]
    assert made == ["punch", "fig7"], "what has one source is computed once"
    result = CliRunner().invoke(app, ["figg7"])
    assert result.exit_code == 2 and "fig7" in result.output


def test_every_figure_has_a_source_that_exists() -> None:
    from benchmarks.registry import BENCHES, REPRODUCED

    studies = {path.stem for path in (ROOT / "problems" / "sweeps").glob("*.toml")}
    problems = {path.stem for path in (ROOT / "problems").glob("*.toml")}
    known = {"plot": DRAWS, "sheet": problems, "reproduce": REPRODUCED, "bench": BENCHES, "sweep": studies}
    assert chosen(FIGURES) == list(FIGURES)
    for name, (how, source) in FIGURES.items():
        assert (name if how == "plot" else source) in known[how]


@pytest.mark.slow
def test_figures_of_the_formulas_are_drawn() -> None:
    ((name, picture),) = drawn(["fig3"], lambda text: None)
    assert name == "fig3" and frowns(picture) == []


# ---------------------------------------------------------------- in axes of one's own
def test_a_picture_of_one_panel_is_drawn_in_given_axes(biped_plan: Planned) -> None:
    figure = Figure()
    left, right = figure.subplots(1, 2)
    left.plot([0.0, 10.0], [0.0, 5.0])
    found = solution_of(biped_plan).plot("force", ax=left)
    assert found is left and figure.axes == [left, right]
    assert len(left.lines) == 2 and not right.lines
    np.testing.assert_array_equal(left.lines[1].get_ydata(), biped_plan.plan.collision.force)


# one panel, several, and parts with panels of their own
@pytest.mark.parametrize("name", ["strobe", "ellipsoid", "overview"])
def test_panels_of_others_take_the_place_of_given_axes(biped_plan: Planned, name: str) -> None:
    """As many as in a picture of their own, within the place, whatever is drawn beside."""
    solution, figure = solution_of(biped_plan), Figure(figsize=(14, 14), layout="constrained")
    (above, below), _ = figure.subplots(2, 2)
    found = solution.plot(name, ax=below)
    panels = [found] if isinstance(found, Axes) else found
    assert below not in figure.axes and above in figure.axes
    assert len(panels) == len(solution.plot(name).axes)
    figure.draw_without_rendering()
    for axes in panels:
        box = axes.get_position().transformed(axes.figure.transSubfigure)
        box = box.transformed(figure.transFigure.inverted())
        assert box.x0 >= 0.49 and box.y0 >= 0.49, name


def test_axes_without_a_grid_are_refused(biped_plan: Planned) -> None:
    free = Figure().add_axes((0.1, 0.1, 0.8, 0.8))
    with pytest.raises(InputError, match="no part of a grid"):
        solution_of(biped_plan).plot("motion", ax=free)


def test_simulations_of_another_plan_are_refused(arm_plan: Planned) -> None:
    """Their impulse and picture would be taken for those of this plan."""
    solution, own = solution_of(arm_plan), arm_plan.simulation
    later = dataclasses.replace(own, expected=solution.trajectory.contact_start + 0.1)
    for other in (later, dataclasses.replace(own, q=np.zeros((len(own.time), 9)))):
        with pytest.raises(InputError, match="simulation is of another plan: give this solution's"):
            solution.plot("force", simulation=other)
        with pytest.raises(InputError, match="replay is of another plan"):
            solution.summary(replay=other)
    assert solution.summary(own)["simulated"]["impulse_Ns"] == pytest.approx(own.impulse)


@pytest.mark.slow
def test_a_simulation_of_a_plan_of_the_same_duration_is_refused() -> None:
    """All plans whose swing has a given duration meet their targets at the same time."""
    problem = dataclasses.replace(load_problem("arm_planar"), swing=Phase(duration=(0.4, 0.4)))
    problem = dataclasses.replace(problem, target=FreeMass(mass=1.0))
    light = solve(problem)
    heavy, simulation = light.moved(mass=1.3), light.validate()
    assert heavy.trajectory.contact_start == light.trajectory.contact_start
    with pytest.raises(InputError, match="simulation is of another plan"):
        heavy.plot("force", simulation=simulation)
    assert light.plot("force", simulation=simulation)


@pytest.mark.parametrize("name", ["ax", "simulation", "replay"])
def test_arguments_of_other_types_are_refused(arm_plan: Planned, tmp_path: Path, name: str) -> None:
    solution, given = solution_of(arm_plan), {name: 3}
    with pytest.raises(InputError, match=f"{name} must be an? .*, not 3"):
        solution.plot("force", **given)
    if name == "ax":
        return
    with pytest.raises(InputError, match=f"{name} must be a Simulation, not 3"):
        solution.summary(**given)
    with pytest.raises(InputError, match=f"{name} must be a Simulation, not 3"):
        solution.animate(**given)
    with pytest.raises(InputError, match=f"{name} must be a Simulation, not 3"):
        solution.report(tmp_path / "page.html", **given)
