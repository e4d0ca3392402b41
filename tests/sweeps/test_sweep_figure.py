"""The picture of a sweep's table: what is drawn is what the table says, and the studies that come with it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from support.picture_checks import frowns
from support.problem_texts import bolted_arm
from typer.testing import CliRunner

from impactopt import InputError
from impactopt.cli.app import app
from impactopt.report.pictures.style import model_colour
from impactopt.report.pictures.sweep import drawn_table, sweep_picture
from impactopt.report.pictures.sweep_columns import Columns
from impactopt.sweeps import read_sweep_file, sweep, sweep_from_data
from impactopt.sweeps.sections import Figure
from impactopt.sweeps.table import read_columns, read_units, unit_of, without_unit

STUDIES = sorted((Path(__file__).resolve().parents[2] / "problems" / "sweeps").glob("collision_*.toml"))
SPEED, MASS = "at_contact.speed_m_s", "target.mass_kg"


def picture(columns: Columns, **section: Any) -> Any:
    drawn = sweep_picture(Figure.model_validate(section), columns)
    assert frowns(drawn) == []
    return drawn


def grid_columns() -> dict[str, Any]:
    speed, mass = (x.ravel() for x in np.meshgrid([1.0, 2.0, 3.0], [0.5, 1.0], indexing="ij"))
    reason = np.array([""] * 6, dtype=object)
    reason[4] = "elbow would be beyond its limit"
    return {SPEED: speed, MASS: mass, "impulse_Ns": speed * mass, "reason": reason}


# ---------------------------------------------------------------- names
@pytest.mark.parametrize(
    ("name", "bare", "unit"),
    [
        ("target.mass_kg", "target.mass", "kg"),
        ("contact.stiffness_N_m", "contact.stiffness", "N/m"),
        ("contact.damping_N_s_m", "contact.damping", "N s/m"),
        ("robot.kd_N_m_s_rad", "robot.kd", "N m s/rad"),
        ("problem.point_m.0", "problem.point.0", "m"),
        ("robot.kd_N_m_s_rad.elbow", "robot.kd.elbow", "N m s/rad"),
        ("zmp_margin_m", "zmp_margin", "m"),
        ("impulse_Ns", "impulse", "N s"),
        ("torque_ratio", "torque_ratio", ""),
    ],
)
def test_units_come_off_names(name: str, bare: str, unit: str) -> None:
    assert unit_of(name) == unit
    assert without_unit(name) == bare


def test_labels_are_words_with_units() -> None:
    joint = "at_contact.joints_rad.arm_right_4_joint"
    columns = {joint: [0.1, 0.2], "zmp_margin_m": [0.0, 1.0]}
    axes = picture(columns, kind="lines", x=joint, y="zmp_margin_m").axes[0]
    assert axes.get_xlabel() == "arm right 4 moved by [rad]"
    assert axes.get_ylabel() == "ZMP margin [m]"
    own = picture(columns, kind="lines", x=joint, y="zmp_margin_m", labels={joint: "elbow"}).axes[0]
    assert own.get_xlabel() == "elbow"


# ---------------------------------------------------------------- heatmap
def test_a_heatmap_has_each_row_in_its_place() -> None:
    columns = grid_columns()
    shuffled = np.random.default_rng(0).permutation(6)
    columns = {name: x[shuffled] for name, x in columns.items()}
    figure = picture(columns, kind="heatmap", x=SPEED, y=MASS, colour="impulse_Ns")
    mesh = figure.axes[0].collections[0]
    shown = np.ma.filled(mesh.get_array(), np.nan)
    # a row of the picture is a mass, lowest first; the impossible one is left out
    np.testing.assert_allclose(shown, [[0.5, 1.0, np.nan], [1.0, 2.0, 3.0]])
    assert "elbow would be beyond its limit" in figure.legends[0].get_texts()[0].get_text()


@pytest.mark.parametrize(
    ("masses", "log"), [([0.5, 1.0, 4.0], []), ([1.0, 10.0, 1e3], ["x"]), ([2.0], []), ([2.0], ["x"])]
)
def test_a_heatmaps_cells_are_around_their_values(masses: list[float], log: list[str]) -> None:
    """A cell ends half-way to the next value on the axis, and a single value has a cell too."""
    mass, speed = (x.ravel() for x in np.meshgrid(masses, [1.0, 2.0], indexing="ij"))
    columns = {SPEED: speed, MASS: mass, "impulse_Ns": speed * mass, "reason": [""] * len(mass)}
    axes = picture(columns, kind="heatmap", x=MASS, y=SPEED, colour="impulse_Ns", log=log).axes[0]
    edges = axes.collections[0].get_coordinates()[0, :, 0]
    assert (edges[:-1] < masses).all() and (masses < edges[1:]).all()
    on_axis = np.log if log else np.asarray
    middles = (on_axis(masses)[1:] + on_axis(masses)[:-1]) / 2
    np.testing.assert_allclose(on_axis(edges)[1:-1], middles)
    low, high = axes.get_xlim()
    assert low < masses[0] and masses[-1] < high


def test_a_contour_is_where_the_level_is() -> None:
    columns = grid_columns()
    columns["reason"] = [""] * 6
    columns["zmp_margin_m"] = 1.75 - columns[SPEED]
    given = {"kind": "heatmap", "x": SPEED, "y": MASS, "colour": "impulse_Ns"}
    axes = picture(columns, **given, contour={"zmp_margin_m": 0.0}).axes[0]
    path = axes.collections[-1].get_paths()[0].vertices
    np.testing.assert_allclose(path[:, 0], 1.75)


@pytest.mark.parametrize("log", [[], ["colour"]])
def test_a_column_without_numbers_is_drawn_empty(log: list[str]) -> None:
    columns = {**grid_columns(), "zmp_margin_m": [None] * 6}
    empty = {"x": SPEED, "y": MASS, "colour": "zmp_margin_m", "log": log}
    drawn = sweep_picture(
        Figure.model_validate({"kind": "heatmap", "contour": {"zmp_margin_m": 0.0}, **empty}), columns
    )
    assert not drawn.axes[0].collections[1:], "no contour of nothing"
    drawn.write(io.BytesIO())
    sweep_picture(Figure.model_validate({"kind": "scatter", **empty}), columns).write(io.BytesIO())


def test_a_logarithmic_colour_leaves_out_what_has_no_logarithm() -> None:
    columns = {**grid_columns(), "energy_J": [0.0, -1.0, 1.0, 10.0, 5.0, 2.0]}
    drawn = picture(columns, kind="scatter", x=SPEED, y=MASS, colour="energy_J", log=["colour"])
    assert drawn.axes[0].collections[0].norm.vmin == 1.0 and drawn.axes[0].collections[0].norm.vmax == 10.0
    # and the picture tells: of five rows with a result one has -1 J and one 0 J
    assert drawn.get_supxlabel() == "3 of 5 rows"
    drawn = picture(
        columns, kind="heatmap", x=SPEED, y=MASS, colour=["impulse_Ns", "energy_J"], log=["colour"]
    )
    (told,) = (text.get_text() for text in drawn.legends[0].get_texts())
    assert told == "no result: elbow would be beyond its limit; energy of 0 or less, which has no logarithm"
    # without any logarithm the colours are linear, and nothing is left out
    columns["energy_J"] = [0.0, -1.0, -1.0, -10.0, -5.0, -2.0]
    drawn = picture(columns, kind="heatmap", x=SPEED, y=MASS, colour="energy_J", log=["colour"])
    (told,) = (text.get_text() for text in drawn.legends[0].get_texts())
    assert told == "no result: elbow would be beyond its limit"


def test_a_reason_that_differs_in_its_details_alone_is_told_once() -> None:
    columns = grid_columns()
    columns["reason"][3:5] = ["no motion; 3 mm off", "no motion; 5 mm off"]
    drawn = picture(columns, kind="heatmap", x=SPEED, y=MASS, colour="impulse_Ns")
    assert [text.get_text() for text in drawn.legends[0].get_texts()] == ["no result: no motion"]


@pytest.mark.parametrize("table", ["against", "contour", "labels"])
def test_what_is_no_table_is_a_mistake(table: str) -> None:
    with pytest.raises(ValidationError, match=rf"{table}\n.*dictionary"):
        Figure.model_validate({"kind": "lines", "x": SPEED, "y": MASS, table: 3})


def test_a_heatmap_needs_a_grid() -> None:
    columns = {name: x[:5] for name, x in grid_columns().items()}
    with pytest.raises(InputError, match="take a scatter"):
        picture(columns, kind="heatmap", x=SPEED, y=MASS, colour="impulse_Ns")


# ---------------------------------------------------------------- lines
def test_lines_are_in_the_order_of_x_and_apart_by_colour() -> None:
    columns = {
        SPEED: [3.0, 1.0, 2.0, 1.0, 2.0, 3.0],
        "problem.robot": ["a", "a", "a", "b", "b", "b"],
        "impulse_Ns": [9.0, 1.0, 4.0, 2.0, None, 6.0],
    }
    figure = picture(columns, kind="lines", x=SPEED, y="impulse_Ns", colour="problem.robot")
    first, second = figure.axes[0].lines
    np.testing.assert_allclose(first.get_xydata(), [[1, 1], [2, 4], [3, 9]])
    np.testing.assert_allclose(second.get_xydata(), [[1, 2], [2, np.nan], [3, 6]])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b"]


def test_errors_against_several_rows_at_one_place_are_refused() -> None:
    """The last of them was the reference of all."""
    columns = {
        SPEED: [1.0, 1.0, 1.0, 1.0],
        MASS: [0.5, 0.5, 2.0, 2.0],
        "at_contact.model": ["full", "sdc", "full", "sdc"],
        "impulse_Ns": [1.0, 1.1, 2.0, 2.1],
        "reason": [""] * 4,
    }
    given = {"kind": "lines", "x": SPEED, "y": "impulse_Ns", "against": {"at_contact.model": "full"}}
    with pytest.raises(InputError, match=r"several rows with .* have the same at_contact.speed_m_s"):
        picture(columns, **given, colour="at_contact.model")
    panels = picture(columns, **given, colour="at_contact.model", panel=MASS).axes
    assert [axes.lines[0].get_ydata()[0] for axes in panels] == pytest.approx([10.0, 5.0])


@pytest.mark.parametrize("kind", ["lines", "scatter"])
@pytest.mark.parametrize("text", [True, False])
def test_a_legend_of_many_is_on_the_page_and_its_colours_are_distinct(kind: str, text: bool) -> None:
    """Its row ended at the page's edge, and every eighth line had the colour of the first."""
    many = 30
    of = np.repeat(np.arange(many) + 0.5, 2)
    columns: dict[str, Any] = {
        MASS: np.array([f"robot number {x:g}" for x in of], dtype=object) if text else of,
        SPEED: np.tile([1.0, 2.0], many),
        "impulse_Ns": of,
        "reason": [""] * (2 * many),
    }
    drawn = picture(columns, kind=kind, x=SPEED, y="impulse_Ns", colour=MASS)
    if kind == "scatter" and not text:
        assert not drawn.legends  # it has a bar
        return
    drawn.draw_without_rendering()
    (legend,) = drawn.legends
    box = legend.get_window_extent()
    assert box.x0 >= 0 and box.x1 <= drawn.bbox.x1 and box.y0 >= 0
    names = [entry.get_text() for entry in legend.get_texts()]
    first, last = ("robot number 0.5", "robot number 29.5") if text else ("0.5", "29.5")
    assert names[0] == first and names[-1] == last and (len(names) == many or not text)
    axes = drawn.axes[0]
    marks = axes.lines if kind == "lines" else axes.collections
    colours = [tuple(np.ravel(m.get_color() if kind == "lines" else m.get_facecolor())) for m in marks]
    assert len(set(colours)) == many


def test_errors_are_against_the_row_with_the_same_rest() -> None:
    models = ["sdc", "sdc", "full", "full", "sdc", "full"]
    columns = {
        SPEED: [1.0, 2.0, 1.0, 2.0, 1.0, 1.0],
        MASS: [1.0, 1.0, 1.0, 1.0, 4.0, 4.0],
        "at_contact.model": models,
        "impulse_Ns": [1.1, 1.8, 1.0, 2.0, 3.0, 4.0],
    }
    given: dict[str, Any] = {"kind": "lines", "x": SPEED, "y": "impulse_Ns", "colour": "at_contact.model"}
    given |= {"panel": MASS, "against": {"at_contact.model": "full"}}
    one, four = picture(columns, **given).axes
    np.testing.assert_allclose(one.lines[0].get_xydata(), [[1, 10], [2, -10]])
    np.testing.assert_allclose(four.lines[0].get_xydata(), [[1, -25]])
    assert [axes.get_title(loc="left") for axes in (one, four)] == ["target mass 1 kg", "target mass 4 kg"]
    assert one.lines[0].get_color() == model_colour("sdc"), "as in all pictures"
    assert len(one.lines) == len(four.lines) == 1  # not the rows that the others are held against
    sizes = picture(columns, **given, log=["y"]).axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(sizes, [10, 10])
    with pytest.raises(InputError, match="no row has"):
        picture(columns, **{**given, "against": {"at_contact.model": "fuller"}})


# ---------------------------------------------------------------- scatter
def test_a_scatter_shows_rows_with_their_colours() -> None:
    figure = picture(grid_columns(), kind="scatter", x=SPEED, y="impulse_Ns", colour=MASS)
    marks = figure.axes[0].collections[0]
    np.testing.assert_allclose(marks.get_offsets(), [[1, 0.5], [1, 1], [2, 1], [2, 2], [3, 3]])
    np.testing.assert_allclose(marks.get_array(), [0.5, 1.0, 0.5, 1.0, 1.0])


def test_text_is_no_number() -> None:
    with pytest.raises(InputError, match="no column of numbers"):
        picture(
            {"problem.robot": ["a", "b"], "impulse_Ns": [1.0, 2.0]},
            kind="lines",
            x="problem.robot",
            y="impulse_Ns",
        )


# ---------------------------------------------------------------- sweep files
def collisions_data(**figure: Any) -> dict[str, Any]:
    return {
        "sweep": {"problem": "arm7", "case_kind": "collision", "outputs": ["impulse_Ns"]},
        "grid": {"at_contact.speed": {"from": 0.1, "to": 0.5, "count": 3}, "target.mass": [0.1, 0.2]},
        "figure": {"kind": "heatmap", "x": "at_contact.speed", "y": "target.mass", **figure},
    }


def test_a_figure_names_keys_without_units() -> None:
    found = sweep_from_data(collisions_data(colour="impulse_Ns", labels={"target.mass": "m"}))
    assert found.figure is not None
    assert found.figure.columns == (SPEED, MASS, "impulse_Ns")
    assert found.figure.labels == {MASS: "m"}


def test_what_a_figure_names_has_to_be_there() -> None:
    with pytest.raises(InputError, match=r"\[figure\].*did you mean 'impulse_Ns'"):
        sweep_from_data(collisions_data(colour="impulse_N"))
    with pytest.raises(InputError, match="heatmap"):
        sweep_from_data(collisions_data(kind="heat map"))


def test_a_heatmap_has_one_case_in_each_cell() -> None:
    """It was refused after the whole sweep."""
    data = collisions_data()
    data["grid"]["contact.stiffness"] = [1e4, 2e4]
    with pytest.raises(InputError, match=r"kind: 12 cases for the heatmap's 6 cells of at_contact.speed"):
        sweep_from_data(data)
    del data["grid"]["contact.stiffness"]
    data["grid"]["target.mass"] = [0.1, 0.1]  # the same cell twice
    with pytest.raises(InputError, match=r"6 cases for the heatmap's 3 cells"):
        sweep_from_data(data)


@pytest.mark.parametrize(
    ("figure", "says"),
    [
        ({"kind": "lines", "y": "impulse_Ns", "contour": {"impulse_Ns": 1.0}}, "contour: of kind = 'heatm"),
        ({"panel": "target.mass"}, "panel: of kind = 'lines' or 'scatter' only, not 'heatmap'"),
        ({"kind": "scatter", "against": {"target.mass": 1.0}}, "against: of kind = 'lines' only"),
        ({"kind": "scatter", "y": ["impulse_Ns", "target.mass"]}, "y: several are of kind = 'lines' only"),
        ({"kind": "scatter", "colour": ["impulse_Ns", "target.mass"]}, "colour: several are of"),
        ({"contour": {"impulse_Ns": 1.0, "peak_force_N": 1.0, "target.mass": 1.0, "at_contact.speed": 1.0}},
         "4 lines; give at most 3"),
    ],
)  # fmt: skip
def test_what_a_figures_kind_does_not_draw_is_refused(figure: dict[str, Any], says: str) -> None:
    """It was left out silently."""
    with pytest.raises(InputError, match=rf"\[figure\] .*{says}"):
        sweep_from_data(collisions_data(**figure))


def test_what_a_figure_of_plans_names_has_to_be_there() -> None:
    """Told before a case is solved; columns of target, objectives and scenarios are known by prefixes."""
    names = ("target.mass", "impulse_Ns", "target_speed_m_s", "torque_ratio_swing", "heavy_slow_impulse_Ns")
    given: dict[str, Any] = {
        "sweep": {"problem": "arm_planar"},
        "grid": {"target.mass": [0.5, 1.0]},
        "set": {"scenarios": [{"name": "heavy slow", "mass": 4.0}]},
    }
    for name in names:
        assert sweep_from_data(given | {"figure": {"kind": "lines", "x": "target.mass", "y": name}}).figure
    with pytest.raises(InputError, match=r"\[figure\]: 'impulse_N' is .*did you mean 'impulse_Ns'"):
        sweep_from_data(given | {"figure": {"kind": "lines", "x": "target.mass", "y": "impulse_N"}})


def test_a_sweep_is_the_same_with_another_figure() -> None:
    assert sweep_from_data(collisions_data()).hash == sweep_from_data(collisions_data(title="new")).hash


@pytest.mark.slow
def test_the_command_draws(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(
        """
        [sweep]
        problem = "arm7"
        case_kind = "collision"
        [grid]
        at_contact.speed = {from = 0.1, to = 0.5, count = 3}
        target.mass = [0.1, 0.2]
        [figure]
        kind = "lines"
        x = "at_contact.speed"
        y = "impulse_Ns"
        colour = "target.mass"
        """,
        encoding="utf-8",
    )
    result = CliRunner().invoke(app, ["sweep", str(file), "--out", str(tmp_path / "out"), "--workers", "1"])
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "figure.png").read_bytes().startswith(b"\x89PNG")
    table = tmp_path / "out" / "table.parquet"
    assert len(read_columns(table, ["impulse_Ns"])["impulse_Ns"]) == 6
    with pytest.raises(InputError, match="did you mean 'impulse_Ns'"):
        read_columns(table, ["impulse_N"])


PRESS = """<robot name="press">
<link name="base"/>
<joint name="slide" type="prismatic"><parent link="base"/><child link="ram"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="300" velocity="3"/></joint>
<link name="ram"><inertial><mass value="3"/>
<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""


@pytest.mark.slow
def test_a_prismatic_joint_has_metres(tmp_path: Path) -> None:
    """In the table and the picture: moved by metres, with a servo in N s/m."""
    (tmp_path / "robot.urdf").write_text(PRESS, encoding="utf-8")
    text = bolted_arm(
        frame="ram",
        point=[0.0, 0.0, 0.0],
        normal=[1.0, 0.0, 0.0],
        start="zero",
        postures={"zero": {"slide": 0.0}},
        robot="kd_N_m_s_rad.slide = 100.0",
    )
    (tmp_path / "press.toml").write_text(text, encoding="utf-8")
    place, gain = "at_contact.joints_rad.slide", "robot.kd_N_m_s_rad.slide"
    study = sweep_from_data(
        {
            "sweep": {"problem": str(tmp_path / "press.toml"), "case_kind": "collision"},
            "at_contact": {"speed": 1.0},
            "grid": {"at_contact.joints_rad.slide": [0.0, 0.1], "robot.kd.slide": [100.0, 200.0]},
            "figure": {"kind": "lines", "x": place, "y": "impulse_Ns", "colour": gain},
        }
    )
    table = sweep(study, tmp_path / "out", workers=1, progress=False).table
    units = read_units(table)
    assert (units[place], units[gain], units["impulse_Ns"]) == ("m", "N s/m", "N s")
    assert study.figure is not None
    drawn = drawn_table(study.figure, table)
    assert drawn.axes[0].get_xlabel() == "slide moved by [m]"
    assert drawn.legends[0].get_title().get_text() == "kd slide [N s/m]"


@pytest.mark.parametrize("file", STUDIES, ids=lambda file: file.stem)
def test_studies_are_sound(file: Path) -> None:
    study = read_sweep_file(file)
    assert study.settings.case_kind == "collision" and study.figure is not None
