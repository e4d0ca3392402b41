"""Pages of results: what they say, and whether they work in a browser. No solver is run."""

from __future__ import annotations

import copy
import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from matplotlib.colors import to_rgb
from support.browser import DARK, WITHOUT_3D, Job, Visit, visit
from support.fake_solution import IMPULSE, PROBLEM_FILE, still_problem, still_solution, strike_record
from support.pages import unpack
from support.small_robots import biped
from typer.testing import CliRunner

from impactopt import (
    Board,
    ImpactProblem,
    InputError,
    KelvinVoigt,
    Obstacle,
    Solution,
    Status,
    TargetBody,
    load_problem,
    load_robot,
    planar_arm,
)
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.bodies.visuals import surroundings_of, visuals_of
from impactopt.cli.app import app
from impactopt.files.named_problems import problem_file
from impactopt.files.output import record_of, save_record
from impactopt.files.record import Record
from impactopt.report.animation import animation_of
from impactopt.report.comparison import compare
from impactopt.report.pictures.sheet import sheet
from impactopt.report.pictures.style import ORANGE
from impactopt.report.report import report_of
from impactopt.report.robot_page import bodies_page, bodies_page_of_problem
from impactopt.report.stage import stage_of
from impactopt.report.tracks import tracks_of

NASTY = '# a problem <script>alert("no")</script> & more\n'


@pytest.fixture(scope="module")
def solution() -> Solution:
    return still_solution(problem=still_problem(name="stand <still> & wait"))


@pytest.fixture(scope="module")
def record(solution: Solution) -> Record:
    simulation, replay = solution.validate(), solution.validate(engine="mujoco")
    made = record_of(solution, simulation=simulation, replay=replay, problem=NASTY + PROBLEM_FILE)
    made.summary["command"] = "impactopt solve 'my problem.toml'"
    return made


@pytest.fixture(scope="module")
def page(record: Record, solution: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report_of(record, solution.problem).save(tmp_path_factory.mktemp("page") / "page.html")


class Reader(HTMLParser):
    """Addresses that a page names, elements that are left open, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "action", "data")]
        if tag not in ("meta", "link", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data if self.open[-1:] not in (["script"], ["style"]) else ""


def test_a_page_names_no_address_and_shows_all_text_as_text(page: Path, record: Record) -> None:
    html = page.read_text(encoding="utf-8")
    read = Reader(html)
    assert read.open == [] and read.addresses == ["data:,"]
    assert {*re.findall(r"https?://[^\s\"'<>)]+", html)} == {"http://www.w3.org/2000/svg"}
    for text in (NASTY.strip(), "stand <still> & wait", "impactopt solve 'my problem.toml'", "impulse [N s]"):
        assert text in read.text
    assert f"{IMPULSE:.2f} N s" in read.text and record.summary["versions"]["casadi"] in read.text


def test_an_animation_shows_itself_in_a_notebook(record: Record, solution: Solution) -> None:
    made = animation_of(record, solution.problem)
    frame = made._repr_html_()
    assert frame.startswith("<iframe srcdoc=") and frame.count("<") == 2, "all of the page is escaped"
    attribute = dict(_attributes(frame))
    assert attribute["srcdoc"] == made.html


def _attributes(html: str) -> list[tuple[str, str | None]]:
    found: list[tuple[str, str | None]] = []

    class First(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            found.extend(attrs)

    First().feed(html)
    return found


def test_bad_names_and_missing_motions_are_said(record: Record, solution: Solution, tmp_path: Path) -> None:
    made = animation_of(record, solution.problem)
    with pytest.raises(InputError, match=r"give 'page.pdf' the ending .html"):
        made.save(tmp_path / "page.pdf")
    with pytest.raises(InputError, match="cannot write"):
        made.save(tmp_path / "nowhere" / "page.html")
    stopped = Record(summary={"status": "stopped"}, arrays={})
    with pytest.raises(InputError, match="no motion"):
        animation_of(stopped, solution.problem)
    assert "stopped" in Reader(report_of(stopped).html).text


def test_solutions_animate_and_report_themselves(solution: Solution, tmp_path: Path) -> None:
    made = solution.animate(simulation=solution.validate())
    numbers = re.search(r'id="numbers">([^<]+)<', made.html)
    assert numbers is not None
    header, arrays = unpack(numbers.group(1))
    assert [track["label"] for track in header["tracks"]] == ["planned", "simulated"]
    assert arrays["track0_places"].shape[1] == solution.problem.robot.model.njoints
    path = solution.report(tmp_path / "own.html")
    assert "made in Python" in Reader(path.read_text(encoding="utf-8")).text


def test_the_robots_meshes_fit_in_a_page() -> None:
    """TALOS's and G1's meshes have hundreds of thousands of triangles."""
    for name in ("talos", "g1"):
        robot = load_robot(name)
        assert robot.urdf is not None and len(visuals_of(robot)) >= 30
    problem = still_problem()
    solved = still_solution(problem=problem)
    header, arrays = stage_of(record_of(solved), problem)
    assert len(header["bodies"]) >= biped().model.njoints - 1
    assert sum(len(a) for n, a in arrays.items() if n.endswith("_triangles")) < 120_000


def test_the_command_writes_the_page_into_the_result(tmp_path: Path, record: Record) -> None:
    strike = Record(summary={**record.summary, "note": "stopped early"}, problem="", arrays={})
    save_record(strike, tmp_path / "out")
    runner = CliRunner()
    done = runner.invoke(app, ["show", str(tmp_path / "out")])
    assert done.exit_code == 0 and done.output.strip() == str(tmp_path / "out" / "report.html")
    text = Reader((tmp_path / "out" / "report.html").read_text(encoding="utf-8")).text
    assert "stopped early" in text and "impactopt solve 'my problem.toml'" in text
    named = runner.invoke(app, ["show", str(tmp_path / "out"), "--out", str(tmp_path / "new" / "a.html")])
    assert named.exit_code == 0 and (tmp_path / "new" / "a.html").is_file()
    assert runner.invoke(app, ["show", str(tmp_path / "none")]).exit_code == 2


def _cards(record: Record, **numbers: Any) -> list[tuple[str, str, str]]:
    """Class, value and text of each card of a page without the motion; numbers : of its summary."""
    html = report_of(Record(summary={**record.summary, **numbers}, problem="", arrays={})).html
    return re.findall(r'<div class="card"><b class="(.*?)">(.*?)</b><span>(.*?)</span>', html)


def test_a_page_and_a_comparison_take_the_same_status_for_bad(record: Record) -> None:
    for status in Status:
        kind = next(kind for kind, value, _ in _cards(record, status=status.value) if value == status.value)
        both = {
            n: Record(summary={**record.summary, "status": status.value}, problem="", arrays={}) for n in "ab"
        }
        row = next(row for row in compare(both).rows if row.label == "status")
        assert (kind != "bad") == row.cells[0].good == status.usable


def test_the_least_margin_of_a_sole_is_beside_what_its_own_phase_requires(record: Record) -> None:
    margins = {"left": {"swing": 29.6, "collision": 46.0, "follow": 22.0}, "right": {"swing": 29.9}}
    asked = {"swing": 30.0, "collision": 20.0, "follow": 30.0}
    cards = _cards(record, sole_cop_margin_mm=margins, sole_cop_margin_asked_mm=asked)
    ((kind, value, about),) = (card for card in cards if "centre of pressure" in card[2])
    assert (kind, value) == ("", "22 mm") and "follow" in about
    assert "30\u202fmm required" in about and "20\u202fmm" not in about


def test_a_strikes_page_has_its_numbers_and_says_what_it_is(record: Record) -> None:
    """It had the state at contact in no row, and looked like the page of a motion."""
    numbers = {
        "zmp_margin_m": {"contact": 0.0813, "collision": 0.0212},
        "torque_ratio": {"contact": 0.83, "collision": 0.84},
        "capture_margin_m": 0.0904,
    }
    summary = {k: v for k, v in record.summary.items() if k not in ("simulated", "replayed")} | numbers
    strike = Record(summary=summary, problem="", arrays={"strike_posture": np.zeros(3)})
    text = Reader(report_of(strike).html).text
    assert "the impact alone" in text
    for label, value in (
        ("ZMP margin [mm], contact", "81.3"),
        ("ZMP margin [mm], collision", "21.2"),
        ("torque demand / limit, contact", "0.83"),
        ("capture point's margin after contact [mm]", "90.4"),
    ):
        assert f"{label}{value}" in "".join(text.split("\n"))
    assert "the impact alone" not in Reader(report_of(record).html).text


@pytest.mark.slow
def test_a_door_hides_the_robot_from_no_side_of_a_sheet() -> None:
    """It covered the robot in the front view until it had moved away, or in the view from its side."""
    orange = np.array(to_rgb(ORANGE))
    record = record_of(still_solution(problem=still_problem()))
    ahead, right, everywhere = (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), [True, True, True]
    for width, normal, seen in (  # a box, and a door ahead, on the right, on the left
        (0.18, ahead, everywhere),
        (0.9, ahead, [False, True, True]),
        (0.9, right, [True, False, True]),
        (0.9, (0.0, 1.0, 0.0), everywhere),
    ):
        problem = still_problem(normal=normal, body=TargetBody(size=(width, 2 * width, 0.04)))
        faces = [
            np.asarray(axes.collections[0].get_facecolor())[:, :3]
            for axes in sheet(record, problem).axes[::7]
        ]
        # faces are shaded: their colours are along the target's
        along = [colours / np.linalg.norm(colours, axis=1, keepdims=True) for colours in faces]
        shown = [bool((row @ orange / np.linalg.norm(orange) > 0.9999).any()) for row in along]
        assert shown == seen, (width, normal)


# ---- in a browser

# neither the page nor a table in it is wider than the window
WIDE = """[document.documentElement, ...document.querySelectorAll('.scroll')].every(
  x => x.scrollWidth <= x.clientWidth)"""
THEME = "document.documentElement.dataset.theme"
PAPER = "getComputedStyle(document.body).backgroundColor"
# what of the canvas is drawn, as a share, right after it is drawn
DRAWN = """(() => {
  const v = page.clock.view, gl = v.gl, n = [v.canvas.width, v.canvas.height];
  v.draw(%s);
  const p = new Uint8Array(4 * n[0] * n[1]);
  gl.readPixels(0, 0, n[0], n[1], gl.RGBA, gl.UNSIGNED_BYTE, p);
  let dark = 0;
  for (let k = 3; k < p.length; k += 4) dark += p[k] > 250;
  return [dark / n[0] / n[1], gl.getError()];
})()"""
PLOT = "document.querySelectorAll('.chart .plot > svg')[%d]"
CHART = "document.querySelectorAll('.chart')[%d]"
KEY = "%s.dispatchEvent(new KeyboardEvent('keydown', {key: '%s', bubbles: true, cancelable: true}))"
SCRIPTS = {
    "wide": WIDE,
    "theme": THEME,
    "paper": PAPER,
    "charts": "document.querySelectorAll('.chart path.line').length",
    "unnamed": "[...document.querySelectorAll('button, select, input, canvas, svg[tabindex]')].filter((n) => "
    "!(n.textContent.trim() || n.getAttribute('aria-label') || n.labels?.length)).length",
    "play": "(document.querySelector('.play').click(), page.clock.playing)",
    "pause": "(page.clock.playing && document.querySelector('.play').click(), page.clock.playing)",
    "drawn": DRAWN % "0, 0",
    "contact": "(page.clock.seek(page.header.tracks[0].contact_start + 0.01), "
    "document.querySelector('.label').textContent)",
    "readout": "document.querySelector('.readout').textContent",
    "legend": f"{CHART % 0}.querySelector('.key b').textContent",
    # the number beside the ground's path is the one that the chart of margins draws
    "margin": "(page.arrays.margin_planned_y.fill(12.34), page.clock.seek(0.1234), [2, 3].map((k) => "
    "document.querySelectorAll('.chart')[k].querySelector('.key b').textContent))",
    "hidden": "(page.clock.seek(page.header.tracks[0].contact_start + 0.01), "
    "document.querySelector('.marks .key').click(), document.querySelector('.label').hidden)",
    "motion": "(() => { const s = document.querySelector('.controls select'); s.value = 1; "
    "s.dispatchEvent(new Event('change')); return page.clock.track; })()",
    "turned": "(() => { const v = page.clock.view, before = v.yaw; "
    + KEY % ("v.canvas", "ArrowLeft")
    + "; return v.yaw - before; })()",
    "toggled": f"({CHART % 0}.querySelectorAll('.key')[1].click(), "
    f"{CHART % 0}.querySelectorAll('path.line').length)",
    "range": f"{CHART % 0}.querySelector('.axes').textContent",
    "all": f"({CHART % 0}.querySelectorAll('.tools button')[2].click(), "
    f"{CHART % 0}.querySelector('.axes').textContent)",
    "zoomed": f"({KEY % (PLOT % 0, '+')}, {CHART % 0}.querySelector('.axes').textContent)",
    "joint": "(() => { const s = document.querySelector('.chart select'), c = s.closest('.chart'), "
    "d = () => c.querySelector('path.line').getAttribute('d'), before = d(); "
    "s.value = s.value === '0' ? '1' : '0'; s.dispatchEvent(new Event('change')); "
    "return d() !== before; })()",
    "place": "(() => { const v = page.clock.view, t = page.header.tracks[0]; "
    "const now = v.instant(t, 0.05); "
    "return Array.from({length: now.joints}, (_, j) => [...v.pose(now, j)]); })()",
    "seen": "[0, 0.5, 0.75, 1, 2].map((s) => page.clock.view.seen(-s * page.header.far))",
    "switch": f"(document.getElementById('theme').click(), [{THEME}, {PAPER}])",
}


def checked(seen: Visit, names: dict[str, str]) -> dict[str, Any]:
    """Values by name; nothing was logged, and nothing but the page itself was asked for."""
    assert seen.console == []
    assert [re.sub(r".*/", "", url) for url in seen.requests] == ["page.html"] and "file://" in seen.requests[
        0
    ]
    return dict(zip(names, seen.values, strict=True))


@pytest.fixture(scope="module")
def seen(page: Path) -> list[dict[str, Any]]:
    """At 1280 and at 400 pixels, and for one who prefers dark pages."""
    wide, narrow = visit(
        Job(page=page, scripts=tuple(SCRIPTS.values())), Job(page=page, width=400, scripts=(WIDE,))
    )
    (dark,) = visit(Job(page=page, width=400, scripts=(WIDE, THEME, PAPER)), flags=DARK)
    return [
        checked(wide, SCRIPTS),
        checked(narrow, {"wide": WIDE}),
        checked(dark, {"wide": WIDE, "theme": THEME, "paper": PAPER}),
    ]


def test_a_page_loads_in_a_browser_without_errors_and_fits(seen: list[dict[str, Any]]) -> None:
    wide, narrow, dark = seen
    assert wide["wide"] and narrow["wide"] and dark["wide"]
    assert wide["charts"] >= 15 and wide["unnamed"] == 0


def test_light_and_dark(seen: list[dict[str, Any]]) -> None:
    wide, _, dark = seen
    assert (wide["theme"], dark["theme"]) == ("light", "dark")
    assert wide["switch"] == ["dark", dark["paper"]] and dark["paper"] != wide["paper"]


def test_the_animation_works(seen: list[dict[str, Any]], record: Record, solution: Solution) -> None:
    wide = seen[0]
    assert wide["play"] in (True, False) and wide["pause"] is False
    share, error = wide["drawn"]
    assert 0.02 < share < 0.9 and error == 0, "the robot covers a part of the view"
    assert wide["contact"] == "400 N" and wide["legend"] == "400 N", "the plan's force after 10 ms"
    assert wide["readout"] == "0.110 s · contact · 10 x slower"
    assert wide["margin"] == ["12.34 mm", "12.3 mm inside"]
    assert wide["hidden"] is True and wide["motion"] == 1
    assert wide["turned"] == pytest.approx(-0.1)
    track = tracks_of(record, solution.problem)[0]
    places = np.array([pin.XYZQUATToSE3(place).homogeneous.T for place in track.places[0]])  # it stands still
    np.testing.assert_allclose(np.reshape(wide["place"], (-1, 4, 4)), places, atol=1e-5)


@pytest.mark.slow
def test_what_is_drawn_is_named_as_what_it_is(record: Record, solution: Solution, tmp_path: Path) -> None:
    """One polygon is drawn in all phases of a motion with steps, one arrow for two hands."""
    stances = [{"soles": ["left", "right"], "from_s": 0.0, "to_s": 1.0}]
    stepping = dataclasses.replace(record, summary={**record.summary, "stances": stances})
    two_hands = copy.copy(solution.problem)
    object.__setattr__(two_hands, "second", "another hand")  # the biped has one
    marks = "document.querySelector('.marks').innerText.split('\\n').map((text) => text.trim())"
    usual = report_of(record, solution.problem).save(tmp_path / "usual.html")
    other = report_of(stepping, two_hands).save(tmp_path / "other.html")
    found = visit(Job(page=usual, scripts=(marks,)), Job(page=other, scripts=(marks,)))
    for seen, names in zip(
        found,
        (
            ["force on the target", "support polygon"],
            ["force of both hands on the target", "support polygon at contact"],
        ),
        strict=True,
    ):
        assert seen.console == []
        assert [text for text in seen.values[0] if "target" in text or "polygon" in text] == names


def test_a_target_that_flies_off_fades(seen: list[dict[str, Any]]) -> None:
    assert seen[0]["seen"] == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0]), "over the second half of its way"


# ---- the world and the robot's bodies

BOARD = Board(mass=0.1, stiffness=5e4, breaking_force=400.0)
TRAVELS = (0.0, 0.004, 0.06, 1.0)  # [m]
WORLD = {
    "kinds": "page.header.world.map((part) => part.kind)",
    "places": f"{list(TRAVELS)}.map((travel) => "
    "page.clock.view.surroundings(travel).map((w) => [...w.place]))",
    "gone": "page.clock.view.surroundings(page.header.far).map((w) => w.part.kind)",
    "all": DRAWN % "0, 0",
    "hidden": "([...document.querySelectorAll('.marks .key')].find((k) => k.textContent === 'obstacles')"
    ".click(), "
    "page.clock.view.surroundings(0).map((w) => w.part.kind))",
    "fewer": DRAWN % "0, 0",
    # the tip of the largest force's arrow, for a target that is hit upwards
    "tips": "(page.header.normal = [0, 0, 1], page.clock.view.frame(), ['3/4', 'side'].map((n) => { "
    "const v = page.clock.view; v.look(n); const now = v.draw(0, page.header.tracks[0].contact_start); "
    "const [x, y] = v.project(now.tip), { clientWidth: w, clientHeight: h } = v.canvas; "
    "return now.force > 0 && x > 0 && x < w && y > 0 && y < h; }))",
}
MARKS = "[...document.querySelectorAll('.marks .key')]"
BODIES = {
    "wide": WIDE,
    "drawn": DRAWN % "",
    "marks": f"{MARKS}.map((k) => [k.textContent, k.getAttribute('aria-pressed')])",
    "readout": "document.querySelector('.readout').textContent",
    "sliders": "document.querySelectorAll('.controls input').length",
    "pointed": "(document.querySelectorAll('tr[data-joint]')[2].dispatchEvent(new Event('focus')), "
    "[page.clock.view.pointed, +document.querySelectorAll('tr[data-joint]')[2].dataset.joint])",
    "left": "(document.querySelectorAll('tr[data-joint]')[2].dispatchEvent(new Event('blur')), "
    "page.clock.view.pointed)",
    "bare": f"({MARKS}.forEach((k) => k.getAttribute('aria-pressed') === 'true' && k.click()), {DRAWN % ''})",
}


@pytest.fixture(scope="module")
def board() -> ImpactProblem:
    table = Obstacle(name="table", size=(1.0, 1.0, 0.5), position=(0.9, 0.0, 0.25))
    return still_problem(target=BOARD, law=KelvinVoigt(stiffness=1e5, damping=100.0), obstacles=(table,))


@pytest.fixture(scope="module")
def shown(board: ImpactProblem, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """A board that is hit, and a robot that stands still."""
    folder = tmp_path_factory.mktemp("bodies")
    pages = [folder / name / "page.html" for name in ("board", "robot")]
    made = [report_of(record_of(still_solution()), board), bodies_page(biped())]
    for page, report in zip(pages, made, strict=True):
        page.parent.mkdir()
        report.save(page)
    scripts = [WORLD, BODIES]
    visits = visit(*(Job(page=p, scripts=tuple(s.values())) for p, s in zip(pages, scripts, strict=True)))
    return [checked(seen, names) for seen, names in zip(visits, scripts, strict=True)]


@pytest.mark.slow
def test_the_world_moves_on_a_page_as_it_does_in_pictures(
    shown: list[dict[str, Any]], board: ImpactProblem
) -> None:
    page, parts = shown[0], surroundings_of(board.world)
    assert page["kinds"] == [p.kind for p in parts] == ["target"] * 2 + ["held"] * 2 + ["obstacle"]
    for travel, places in zip(TRAVELS, page["places"], strict=True):
        for part, place in zip(parts, places, strict=True):
            matrix = np.reshape(place, (4, 4)).T
            drawn = part.solid.vertices @ matrix[:3, :3].T + matrix[:3, 3]
            np.testing.assert_allclose(drawn, part.placed(travel, board.normal), atol=1e-5)
    assert page["gone"] == ["held"] * 2 + ["obstacle"], "what has flown off is not shown"
    assert page["hidden"] == ["target"] * 2 + ["held"] * 2
    assert page["all"][1] == page["fewer"][1] == 0
    assert page["tips"] == [True] * 2


@pytest.mark.slow
def test_a_robots_bodies_are_drawn_over_it(shown: list[dict[str, Any]]) -> None:
    page = shown[1]
    assert page["wide"] and page["readout"] == "posture: half_sitting" and page["sliders"] == 0
    assert page["marks"] == [["what the robot looks like", "true"], ["hulls", "true"]]
    assert page["pointed"][0] == page["pointed"][1] and page["left"] is None
    (share, error), (bare, _) = page["drawn"], page["bare"]
    assert 0.02 < share < 0.9 and error == 0 and share > bare == 0.0


@pytest.mark.parametrize(("name", "floor"), [("standin", 0.0), ("planar_arm", None), ("space_arm", None)])
def test_a_robot_without_soles_is_shown_without_ground(name: str, floor: float | None) -> None:
    """It has ground only in a problem with [ground]."""
    numbers = re.search(r'id="numbers">(.*?)<', bodies_page(load_robot(name)).html)
    assert numbers is not None
    assert unpack(numbers.group(1))[0]["floor"] == floor


def test_a_problems_bodies_are_seen_from_the_side_of_its_hit_point() -> None:
    """They were seen from the side of the robot's first striker, which may be another one."""
    problem = load_problem("kick")
    numbers = re.search(r'id="numbers">(.*?)<', bodies_page_of_problem(problem).html)
    assert numbers is not None
    np.testing.assert_array_equal(unpack(numbers.group(1))[0]["point"], problem.point)


def test_a_robots_page_says_which_bodies_may_touch() -> None:
    robot = biped()
    robot = dataclasses.replace(robot, disable_collisions=(("left knee", "right knee"),))
    text = Reader(bodies_page(robot).html).text
    links = bodies_of(robot)
    assert links.source in text
    for j in links.joints:
        assert f"{links.name(j)}{len(links.of_joint[j])}" in text
    connected, said, touch = (
        text.index(why) for why in ("A joint connects", "exclude them", "They touch, or nearly, in")
    )
    assert connected < text.index("left knee" + "left hip pitch") < said
    assert said < text.index("left knee" + "right knee") < touch
    _, touching = links.piece_pairs(robot.posture("half_sitting"))
    assert all(touch < text.rindex("".join(sorted(pair))) for pair in touching)


def test_the_command_shows_robots_and_the_worlds_of_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    runner = CliRunner()
    done = runner.invoke(app, ["show", "planar_arm"])
    assert done.exit_code == 0 and done.output.split() == [str(Path("results", "planar_arm.html"))]
    text = Reader(Path("results", "planar_arm.html").read_text(encoding="utf-8")).text
    assert "boxes of its links' inertia" in text and "The world" not in text
    file = tmp_path / "mine.toml"
    rail = '\n[[obstacles]]\nname = "rail"\nstart_m = [2, 2, 0]\nend_m = [2, 2, 1]\nradius_m = 0.05\n'
    file.write_text(problem_file("arm_planar").read_text(encoding="utf-8") + rail, encoding="utf-8")
    done = runner.invoke(app, ["show", str(file), "--out", "mine.html"])
    assert done.exit_code == 0, done.output
    text = Reader(Path("mine.html").read_text(encoding="utf-8")).text
    assert "railcapsule 1 m long, radius 0.05 m(2, 2, 0.5) m" in text
    save_record(strike_record(planar_arm(), *np.zeros((3, 3))), Path("strike"))
    for words, said in (
        (["planar_arn"], "planar_arm"),
        (["planar_arm", "--problem", str(file)], "--problem is for a result"),
        (["strike", "--problem", str(file)], "--problem is for a whole motion"),  # was ignored
    ):
        done = runner.invoke(app, ["show", *words])
        assert done.exit_code == 2 and said in " ".join(done.output.split())
    Path("planar_arm").mkdir()  # a directory's name is a result's
    done = runner.invoke(app, ["show", "planar_arm"])
    assert done.exit_code == 2 and "solution.npz" in done.output


def test_without_3d_the_plots_still_work(page: Path) -> None:
    scripts = {
        "note": "document.querySelector('.stage').innerText",
        "charts": "document.querySelectorAll('.chart path.line').length",
        "moved": f"({KEY % (PLOT % 0, 'ArrowRight')}, page.clock.time - page.header.tracks[0].contact_start)",
        "value": f"{CHART % 0}.querySelector('.key b').textContent",
    }
    # the note is there before the plots are drawn
    job = Job(page=page, scripts=tuple(scripts.values()), ready=f"{scripts['charts']} >= 15")
    values = checked(visit(job, flags=WITHOUT_3D)[0], scripts)
    assert "cannot be shown here: no WebGL 2" in values["note"] and values["charts"] >= 15
    # the view is from 10 ms before the contact of 40 ms to 30 ms after it, a step a hundredth of that
    assert values["moved"] == pytest.approx(0.08 / 100, abs=1e-6)
    assert float(values["value"].removesuffix(" N")) == pytest.approx(
        700 - 300 * values["moved"] / 0.01, rel=1e-3
    )


def test_the_plots_work(seen: list[dict[str, Any]]) -> None:
    wide = seen[0]
    assert wide["toggled"] == 2, "one of three lines is hidden"
    assert len({wide["range"], wide["all"], wide["zoomed"]}) == 3 and wide["joint"] is True
