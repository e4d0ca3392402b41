"""A live look at a planned arm: what its controls do to the plan, and whether its page works in a browser."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import signal
import subprocess
import sys
import types
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote, urlsplit

import numpy as np
import pinocchio as pin
import pytest
import viser
import websockets.asyncio.server
from support.browser import Job, visit
from support.small_plans import biped_problem
from typer.testing import CliRunner
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from impactopt import (
    FreeMass,
    InputError,
    RigidWall,
    Solution,
    SpringDamper,
    Status,
    load_problem,
    load_record,
    load_solution,
    moved_solution,
    solve,
    write_problem,
)
from impactopt.cli.app import app
from impactopt.files.output import record_of, save_record
from impactopt.files.replay import load_planned, problem_of, resumed
from impactopt.kinematics.operational_space import striking_point
from impactopt.live import plan_page as look_module
from impactopt.live import replanning as replanning_module
from impactopt.live.drawing import moment_of
from impactopt.live.plan_page import PlanPage, plan_message
from impactopt.live.replanning import Answer, Replanning
from impactopt.live.requests import PlanRequest, request_of, slider_parameters
from impactopt.report.tracks import planned_track, tracks_of
from impactopt.solvers.program import SolverResult

FILE = Path(__file__).resolve().parents[2] / "problems" / "arm_planar.toml"
LONG = 60.0  # [s]


@pytest.fixture(scope="module")
def arm(hammered: Solution) -> Solution:
    return hammered


@pytest.fixture
def look(arm: Solution) -> Iterator[PlanPage]:
    with PlanPage(arm) as made:
        yield made


@pytest.fixture(scope="module")
def saved(arm: Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("arm")
    save_record(record_of(arm, problem=FILE.read_text(encoding="utf-8")), directory)
    return directory


# ---- controls


@pytest.mark.slow
def test_a_standing_robots_answer_has_the_impulse_of_its_optimum() -> None:
    """Looser tolerances leave the barrier on: its many bounds must not take a visible part of the impulse."""
    biped = solve(biped_problem(), refine=False)
    mass = 1.1 * biped.problem.target.parameters["mass"]
    own = request_of(biped.problem)
    numbers = tuple((name, mass if name == "mass" else value) for name, value in own.parameters)
    answer = Replanning(biped)(dataclasses.replace(own, parameters=numbers), lambda: False)
    optimum = biped.moved(mass=mass, options={"kkt_tolerance": 1e-6, "complementarity_tolerance": 1e-6})
    assert answer.solution is not None
    assert answer.solution.impulse == pytest.approx(optimum.impulse, rel=1e-3)


@pytest.mark.slow
def test_a_slider_makes_a_new_plan(look: PlanPage, arm: Solution) -> None:
    mass = 1.2 * arm.problem.target.mass
    look.sliders["mass"].value = mass
    assert look.wait(LONG)
    wanted = arm.moved(mass=mass)
    assert look.answer.solution is not None
    assert look.answer.solution.problem.target.mass == mass
    assert look.answer.solution.impulse == pytest.approx(wanted.impulse, rel=1e-3)
    assert look.answer.solution.impulse != arm.impulse
    assert f"**{look.answer.solution.impulse:.2f} N s**" in look.text.content
    assert "All constraints are met." in look.text.content
    assert look.status.content == ""


def test_a_dragged_hit_point_is_hit_where_it_is(look: PlanPage, arm: Solution) -> None:
    point = arm.problem.point + np.array([0.01, 0.0, -0.01])
    look.hit.position = point
    look.changed()
    assert look.wait(LONG)
    track = look.answer.track
    assert track is not None
    hand = moment_of(track, track.contact_start).hand
    assert hand @ arm.problem.normal == pytest.approx(point @ arm.problem.normal, abs=2e-3)
    assert hand[0] == pytest.approx(point[0], abs=2e-3)


@pytest.mark.slow
def test_what_cannot_be_hit_leaves_the_old_plan_and_says_why(look: PlanPage, arm: Solution) -> None:
    look.hit.position = arm.problem.point + np.array([0.0, 0.5, 0.0])  # out of the arm's plane
    look.changed()
    assert look.wait(LONG)
    assert look.answer.solution is arm
    assert "out of reach" in look.status.content
    look.reset()
    assert look.wait(LONG)
    assert look.status.content == ""
    assert look.hit.position == pytest.approx(arm.problem.point)


def test_a_fault_of_ours_is_told_and_leaves_the_old_plan(
    look: PlanPage, arm: Solution, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> Solution:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("impactopt.live.replanning.moved_solution", broken)
    look.sliders["stiffness"].value *= 1.1
    assert look.wait(LONG)
    assert look.answer.solution is arm
    assert "by nothing" in look.status.content
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_controls_that_move_while_a_plan_is_drawn_leave_the_page_planning(
    arm: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan that is drawn is then not of the controls, though there was no newer request before."""
    told, pages = list[str](), list[PlanPage]()

    class Answering(Replanning):
        def __call__(self, request: PlanRequest, stale: Callable[[], bool]) -> Answer:
            told.extend(page.status.content for page in pages)
            return super().__call__(request_of(arm.problem), stale)

    monkeypatch.setattr(look_module, "Replanning", Answering)
    with PlanPage(arm) as look:
        pages.append(look)
        assert look.status.order < look.text.order, "it is above the numbers that it is about"

        def drawn(answer: Answer, first: Solution) -> str:
            look.sliders["stiffness"].value *= 1.01 if len(told) == 1 else 1.0
            look.changed()
            return plan_message(answer, first)

        monkeypatch.setattr(look_module, "plan_message", drawn)
        look.sliders["mass"].value *= 1.1
        assert look.wait(LONG)
        assert told == ["Planning ...", "Planning ..."] and look.status.content == ""


def test_a_stale_request_stops_the_solver(arm: Solution) -> None:
    replanning = Replanning(arm)
    request = request_of(arm.problem)
    heavy = dataclasses.replace(
        request, parameters=(("mass", 3 * arm.problem.target.mass), request.parameters[1])
    )
    answer = replanning(heavy, lambda: True)
    assert answer.solution is None
    assert Status.INTERRUPTED.message.split(";")[0] in answer.why
    assert replanning.latest is arm


@pytest.mark.parametrize("other_program", [True, False])
def test_what_is_not_replanned_is_solved(
    arm: Solution, monkeypatch: pytest.MonkeyPatch, other_program: bool
) -> None:
    """From the latest plan if that has another program; from a reach if it is too far to go on from: of a
    mass four times as heavy there was no plan in time.
    """
    replanning, starts = Replanning(arm), list[object]()

    def fails(*_: object, **__: object) -> Solution:
        if other_program:
            raise InputError("the program has other constraints then")
        return dataclasses.replace(arm, result=dataclasses.replace(arm.result, status=Status.TIME_LIMIT))

    def solved(problem: Any, *, start: Any, **options: Any) -> Solution:
        inspect.signature(solve).bind(problem, start=start, **options)
        starts.append(start)
        return dataclasses.replace(arm, problem=problem)

    monkeypatch.setattr(replanning_module, "moved_solution", fails)
    monkeypatch.setattr(replanning_module, "solve", solved)
    mass = 1.1 * arm.problem.target.mass
    request = dataclasses.replace(request_of(arm.problem), parameters=(("mass", mass),))
    answer = replanning(request, lambda: False)
    assert starts == [arm if other_program else "reach"]
    assert answer.solution is not None
    assert answer.solution.problem.target.mass == mass
    replanning(dataclasses.replace(request, parameters=(("mass", 1.1 * mass),)), lambda: False)
    assert starts[1:] == [answer.solution]


def test_the_motion_plays_and_begins_again(look: PlanPage) -> None:
    assert look.answer.track is not None
    end = float(look.answer.track.time[-1])
    look.speed.value = "1"
    look.play(0.5)
    assert look.time.value == pytest.approx(0.5)
    look.play(end)
    assert look.time.value == 0.0
    assert look.time.max == end


# ---- requests and motions


def test_a_legged_robot_has_a_margin_and_a_wall_no_mass(arm: Solution) -> None:
    assert [n.name for n in slider_parameters(arm.problem)] == ["mass", "stiffness"]
    biped = biped_problem()
    assert [n.name for n in slider_parameters(biped)] == ["mass", "stiffness", "margin"]
    # `moved(margin=...)` is that of each sole; the page's ZMP margins are of their hull
    assert slider_parameters(biped)[-1].label == "margin of the soles' CoP [m]"
    wall = dataclasses.replace(biped, target=RigidWall())
    assert [n.name for n in slider_parameters(wall)] == ["stiffness", "margin"]
    for number in slider_parameters(biped):
        assert number.least < number.value < number.most
    assert request_of(biped).changes(biped) == {}
    for stiffness, shown, unit in ((900.0, 900.0, "N/m"), (5e4, 50.0, "kN/m"), (3e8, 300.0, "MN/m")):
        law = SpringDamper(stiffness=stiffness, damping=1.0)
        stiff = dataclasses.replace(biped, law=law)
        slider = next(n for n in slider_parameters(stiff) if n.name == "stiffness")
        assert (slider.value, slider.label) == (shown, f"contact's stiffness [{unit}]")
        request = PlanRequest(point=request_of(stiff).point, parameters=(("stiffness", slider.most),))
        assert request.changes(stiff) == {"stiffness": pytest.approx(4 * stiffness)}
    other = PlanRequest(point=(0.0, 0.0, 1.0), parameters=(("mass", 3.0), ("margin", 0.01)))
    assert list(other.changes(biped)) == ["point", "margin"]


def test_an_acceptable_plan_says_what_it_lacks(arm: Solution) -> None:
    """Its constraints at the nodes are met, but not all that the problem asks for."""
    why = "Bodies keep less than half of their clearance: wrist and ground 6.7 mm instead of 50."
    result = dataclasses.replace(arm.result, status=Status.ACCEPTABLE, message=why)
    plan = dataclasses.replace(arm, result=result)
    text = plan_message(Answer(solution=plan), arm)
    assert why in text and "All constraints are met." not in text
    assert "All constraints are met." in plan_message(Answer(solution=arm), arm)


@pytest.mark.slow
def test_the_largest_force_on_a_page_is_that_of_full_dynamics() -> None:
    """The points of this nail's contact miss its peak by 6 %."""
    nail = solve(load_problem("arm7"))
    mass = 1.1 * nail.problem.target.parameters["mass"]
    for plan in (nail, moved_solution(nail, mass=mass)):
        peak = plan.validate().peak_force
        found = re.search(r"(\d+) N at most", plan_message(Answer(solution=plan), nail))
        assert found is not None and float(found[1]) == pytest.approx(peak, rel=5e-3)
        assert plan.summary()["peak_force_N"] == pytest.approx(peak, rel=5e-3)
        assert plan.plan.collision.peak_force < 0.97 * peak


def test_between_instants_joints_are_where_the_robot_would_be(arm: Solution) -> None:
    track, model = planned_track(arm), arm.problem.robot.model
    for k, time in enumerate(arm.trajectory.time):
        if arm.trajectory.phase[k] == 0 and k % 37 == 5:
            moment, data = moment_of(track, float(time)), model.createData()
            pin.forwardKinematics(model, data, arm.trajectory.q[k])
            for joint in range(1, model.njoints):
                assert moment.place[joint] == pytest.approx(data.oMi[joint].translation, abs=3e-3)
                w, x, y, z = moment.turn[joint]
                turned = pin.Quaternion(w, x, y, z).matrix()
                assert turned == pytest.approx(data.oMi[joint].rotation, abs=1e-2)


def test_a_solutions_track_is_its_records(arm: Solution) -> None:
    kept = tracks_of(record_of(arm), arm.problem)[0]
    for field in dataclasses.fields(kept):
        own, found = getattr(planned_track(arm), field.name), getattr(kept, field.name)
        if isinstance(own, np.ndarray):  # a record's histories are rounded
            np.testing.assert_allclose(found, own, rtol=0, atol=1e-8, equal_nan=True)
        else:
            np.testing.assert_equal(found, own)


def test_a_record_of_an_older_version_shows_no_coasting_robot(arm: Solution) -> None:
    """It has no motion in contact: the reference coasts centimetres into the target, and jumps back."""
    record, reference = record_of(arm), arm.trajectory
    own = tracks_of(record, arm.problem)[0]
    arrays = {name: array for name, array in record.arrays.items() if name != "collision_q"}
    older = tracks_of(dataclasses.replace(record, arrays=arrays), arm.problem)[0]
    at_end = reference.q[reference.phase == 1][-1]
    coasted = striking_point(arm.problem.robot, arm.problem.striker, at_end)
    end = np.flatnonzero(own.time == own.contact_end)[0]
    assert np.linalg.norm(coasted - own.hand[end]) > 0.01
    np.testing.assert_allclose(older.hand, own.hand, rtol=0, atol=0.003)


# ---- from a saved result


@pytest.mark.slow
def test_a_saved_result_is_a_start_again(arm: Solution, saved: Path) -> None:
    record = load_record(saved)
    again = resumed(record, problem_of(record, saved))
    for field in dataclasses.fields(SolverResult):
        if field.name != "history":
            np.testing.assert_equal(getattr(again.result, field.name), getattr(arm.result, field.name))
    assert again.objectives == arm.objectives
    assert again.trajectory.q == pytest.approx(arm.trajectory.q, abs=1e-12)
    mass = 1.1 * arm.problem.target.mass
    assert moved_solution(again, mass=mass).impulse == pytest.approx(arm.moved(mass=mass).impulse, rel=1e-9)


def test_a_result_under_another_problem_is_solved_for_that(
    arm: Solution, saved: Path, tmp_path: Path
) -> None:
    """The saved motion meets looser limits, too, but is no optimum within them."""
    own, other = tmp_path / "own.toml", tmp_path / "other.toml"
    own.write_text(FILE.read_text(encoding="utf-8"), encoding="utf-8")
    looser = "[terms.velocity_limit]\nfraction = 1.0\n"
    other.write_text(f"{FILE.read_text(encoding='utf-8')}\n{looser}", encoding="utf-8")
    worth = arm.objectives["target energy"]
    assert load_solution(saved, problem_file=own).objectives["target energy"] == worth
    again = load_solution(saved, problem_file=other)
    assert again.status.usable
    assert again.objectives["target energy"] > 1.001 * worth


@pytest.mark.slow
def test_a_refined_result_is_solved_for_another_problem(arm: Solution, tmp_path: Path) -> None:
    """Its variables are more than those of the problem's first mesh, and the nail's bodies are others."""
    problem = dataclasses.replace(
        arm.problem,
        target=FreeMass(mass=2.0),
        law=SpringDamper(stiffness=1e5, damping=100.0),
        collision_stages=2,
        collision_elements=((1.0,), (1.0,)),
    )
    finer, other = solve(problem), dataclasses.replace(problem, target=FreeMass(mass=3.0))
    assert finer.elements
    (tmp_path / "other.toml").write_text(write_problem(other), encoding="utf-8")
    result = finer.save(tmp_path / "result")
    again = load_solution(result, problem_file=tmp_path / "other.toml")
    assert again.status.usable
    assert again.impulse == pytest.approx(solve(other).impulse, rel=1e-4)
    nailing = load_solution(result, problem_file=FILE)
    assert nailing.status.usable and nailing.impulse == pytest.approx(arm.impulse, rel=1e-3)


def test_a_plan_without_chosen_gains_has_none_for_open_ones(saved: Path, tmp_path: Path) -> None:
    text = FILE.read_text(encoding="utf-8").replace('robot = "planar_arm"', "")
    gains = '[robot]\npreset = "planar_arm"\n[[robot.gains]]\njoints = ["*"]\nfactor = [0.7, 1.3]\n'
    (tmp_path / "open.toml").write_text(f"{text}\n{gains}", encoding="utf-8")
    assert len(load_planned(saved, problem_file=tmp_path / "open.toml").problem.gains) == 1


@pytest.mark.parametrize("without", ["program_statement", "solver_x"])
def test_a_result_that_does_not_say_its_program_is_solved_again(
    arm: Solution, saved: Path, without: str
) -> None:
    record = load_record(saved)
    arrays = dict(record.arrays)
    arrays[without] = arrays["solver_x"][:-1] if without == "solver_x" else arrays.pop(without)[..., None]
    if without == "program_statement":
        del arrays[without]
    again = resumed(dataclasses.replace(record, arrays=arrays), arm.problem)
    assert again.status is Status.SOLVED
    assert again.impulse == pytest.approx(arm.impulse, rel=1e-3)


# ---- the page


def test_a_port_that_is_taken_is_refused(look: PlanPage, arm: Solution) -> None:
    port = urlsplit(look.address).port
    with pytest.raises(InputError, match=rf"cannot serve a page at 127\.0\.0\.1:{port}.*another --port"):
        PlanPage(arm, port=port)


def _opened(address: str, origin: str | None) -> int:
    """Status of a websocket's handshake, 101 if it is opened, as the page asks for it."""
    headers = {"Origin": origin} if origin else {}
    protocol = [Subprotocol(f"viser-v{viser.__version__}")]
    try:
        with connect(address, additional_headers=headers, subprotocols=protocol) as socket:
            assert socket.recv(timeout=LONG)
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_pages_of_other_origins_and_those_without_the_address_drive_nothing(look: PlanPage) -> None:
    there, token = look.address.rsplit("/", 1)
    own, host = there.replace("http", "ws"), urlsplit(look.address).netloc
    assert len(token) == 32
    assert _opened(f"{own}/{token}", there) == 101
    assert _opened(f"{own}/{token}", None) == 101  # no browser: it knows the token
    for origin in ("http://example.com", "null", f"http://example.com@{host}", f"http://{host}.example.com"):
        assert _opened(f"{own}/{token}", origin) == 403, origin
    for path in ("", "/", f"/{token[:-1]}", f"/x/{token}", f"/?{token}", "/é"):
        assert _opened(f"{own}{quote(path)}", there) == 403, path
    for path in ("/", "/index.html", f"/{token[::-1]}/"):
        with pytest.raises(HTTPError, match="403"):
            urllib.request.urlopen(there + path, timeout=LONG)
    with urllib.request.urlopen(look.address, timeout=LONG) as page:
        assert b"<html" in page.read().lower()


def test_a_viser_that_lets_no_request_be_checked_is_refused(
    arm: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = websockets.asyncio.server.serve
    monkeypatch.setattr(
        "viser.infra._infra.websockets",
        types.SimpleNamespace(
            asyncio=types.SimpleNamespace(server=types.SimpleNamespace(serve=served)),
            datastructures=websockets.datastructures,
            exceptions=websockets.exceptions,
        ),
    )
    with pytest.raises(InputError, match="lets no request be checked"):
        PlanPage(arm)


def test_viser_that_is_missing_is_named(arm: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"a live look needs the package viser.*\[live\]"):
        look_module.PlanPage(arm)


def test_a_plan_that_is_none_is_refused(arm: Solution) -> None:
    failed = dataclasses.replace(arm, result=dataclasses.replace(arm.result, status=Status.FAILED))
    with pytest.raises(InputError, match="not a solution"):
        PlanPage(failed)


# the mass's is the second one, after the time's
SLIDE = """(() => {
  const thumb = document.querySelectorAll("[role=slider]")[1];
  thumb.focus();
  thumb.dispatchEvent(new KeyboardEvent("keydown", { key: "End", code: "End", bubbles: true }));
  return thumb.getAttribute("aria-valuemax");
})()"""


@pytest.mark.slow
def test_the_page_opens_in_a_browser_and_its_slider_plans(look: PlanPage, arm: Solution) -> None:
    first = f"{arm.result.iterations} iterations"
    there = f"(document.body?.innerText ?? '').includes({first!r})"
    ready = f"{there} && document.querySelector('canvas') !== null"
    job = Job(page=look.address, ready=ready, scripts=("document.body.innerText", SLIDE), done=f"!{there}")
    (seen,) = visit(job)
    assert first in seen.values[0]
    assert "target's mass [kg]" in seen.values[0]
    assert [line for line in seen.console if line.startswith("Error")] == []
    own = (look.address, look.address.replace("http", "ws"), "data:", "blob:")
    assert [url for url in seen.requests if not url.startswith(own)] == []
    assert look.answer.solution is not None
    assert look.answer.solution.problem.target.mass == pytest.approx(float(seen.values[1]))


@pytest.mark.slow
def test_the_command_serves_until_ctrl_c(saved: Path) -> None:
    command = [sys.executable, "-m", "impactopt", "show", str(saved), "--live"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # a shell's job in the background ignores Ctrl-C, and so would what the tests start there
    pipes["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(command, **pipes) as process:  # type: ignore[call-overload]
        try:
            line = process.stdout.readline()
            assert line.startswith("http://127.0.0.1:"), process.stderr.read()
            with urllib.request.urlopen(line.split()[0], timeout=LONG) as page:
                assert b"<html" in page.read().lower()
            os.kill(process.pid, signal.SIGINT)
            out, err = process.communicate(timeout=LONG)
        finally:
            process.kill()
    assert process.returncode == 130
    assert (out, err) == ("", "the live page has ended\n")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["standin", "--live"], "--live is for a result, or for a problem file"),
        (["results/none", "--live"], "there is no"),
        (["standin", "--port", "8000"], "--live alone"),
        (["results/none", "--live", "--out", "page.html"], "a live page is not written"),
    ],
)
def test_what_a_live_page_cannot_be_of_is_refused(given: list[str], told: str) -> None:
    done = CliRunner().invoke(app, ["show", *given])
    assert done.exit_code == 2
    assert told in " ".join(done.stderr.replace("│", "").split())
