"""Collisions at the edges of what numbers can hold: right, or refused with a reason."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmarks import stability
from benchmarks.__main__ import app
from benchmarks.stability import judge_rig
from benchmarks.stability_cases import RIGS, Rig
from benchmarks.stability_others import freezes_of, refusals
from benchmarks.stability_robots import make_robot
from support import small_robots
from typer.testing import CliRunner

from impactopt import SDC, FreeMass, InputError, RigidWall, SpringDamper, striking_velocity

X = np.array([1.0, 0.0, 0.0])
LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=5.0)


def slider(**options: Any) -> SDC:
    settings: dict[str, Any] = {"law": LAW, "target": TARGET, **options}
    return SDC(robot=small_robots.slider(2.0), striker="tip", normal=X, **settings)


@pytest.mark.slow
def test_random_cases_on_a_slider_and_an_arm_are_right_or_refused() -> None:
    outcomes = [o for rig in (Rig(robot="slider"), Rig(robot="arm", seed=1)) for o in judge_rig(rig, 48)]
    # nothing is proved by refusing everything
    assert [o for o in outcomes if o.verdict in ("nan", "wrong")] == []
    assert [o.verdict for o in outcomes].count("agree") >= 90
    fixed = [o.verdict for o in judge_rig(Rig(robot="slider", method="rk4"), 48)]
    assert {*fixed} == {"agree", "refused"} and min(map(fixed.count, {*fixed})) > 5


def test_wrong_numbers_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    collide = SDC.collide

    def off(self: SDC, *given: Any, **options: Any) -> Any:
        found = collide(self, *given, **options)
        return replace(found, impulse=1.001 * found.impulse)

    monkeypatch.setattr(SDC, "collide", off)
    assert "wrong" in [o.verdict for o in judge_rig(Rig(robot="slider"), 12)]


def test_bad_input_is_refused_before_work_is_done() -> None:
    assert [found for found in refusals() if found[0] != "refused"] == []


def test_more_freezes_are_nearer_to_full_dynamics() -> None:
    assert [found[0] for found in freezes_of((1, 2))] == ["agree", "agree"]


def test_a_contact_without_end_ends_at_the_horizon() -> None:
    # half a period of a mass on a spring against a wall is 0.044 s; at 0.0101 s, in no whole number of steps,
    # it has got 2 m v_c - (what is left of it): m v_c (1 - cos w t)
    law = SpringDamper(stiffness=1e4, damping=0.0)
    for method in ("implicit", "rk4"):
        sdc = slider(law=law, target=RigidWall(), horizon=0.0101, method=method)
        result = sdc.collide([0.0], [1.0], [0.0], require_separation=False)
        assert not result.separated and result.duration == pytest.approx(0.0101, rel=1e-12)
        assert result.impulse == pytest.approx(2.0 * (1 - np.cos(np.sqrt(5e3) * 0.0101)), rel=1e-7)


def test_a_contact_too_fast_for_the_step_is_refused_with_one_that_will_do() -> None:
    stiff = {"contact_stiffness": 3e7, "contact_damping": 0.0}
    with pytest.raises(InputError, match="too long to follow this contact") as refusal:
        slider(method="rk4").collide([0.0], [1.0], [0.0], **stiff)
    step = float(str(refusal.value).partition("a step below ")[2].partition(",")[0])
    # two free masses part elastically
    fixed = slider(method="rk4", step=0.95 * step, horizon=0.01)
    for model, accuracy in ((fixed, 1e-2), (slider(), 1e-5)):
        result = model.collide([0.0], [1.0], [0.0], **stiff)
        assert result.impulse == pytest.approx(2.0 / (1 / 2.0 + 1 / 5.0), rel=accuracy)


def test_a_contact_that_ends_within_one_explicit_step_is_refused() -> None:
    """The joint draws a hand of 1e-6 m/s away after some 1e-8 s."""
    sticky = {"contact_damping": 1e5, "contact_stiffness": 1e4}
    model = slider(method="rk4", step=1e-5, horizon=0.01)
    with pytest.raises(InputError, match="too soon for steps of 1e-05"):
        model.collide([0.0], [1e-6], [-50.0], **sticky)
    found = model.batch([[0.0]], [[1e-6]], [[-50.0]], outputs=("impulse",), **sticky)
    assert np.isnan(found["impulse"]).all()


def test_too_many_steps_are_refused_with_their_number() -> None:
    with pytest.raises(InputError, match=r"takes 200\d{5} steps"):
        slider(step=1e-8, horizon=0.2)


def test_soles_that_hold_each_other_are_refused() -> None:
    robot = make_robot("planar walker")
    sdc = SDC(robot=robot, striker="tip", normal=X, law=LAW, target=TARGET)
    q = np.zeros(robot.nq)
    q[6] = 1.0
    with pytest.raises(InputError, match="held frames depend on each other"):
        sdc.collide(q, np.zeros(robot.nv), np.zeros(robot.n))


def test_pivots_are_one_where_directions_are_held_once() -> None:
    # a point of one sole of a free body: the Delassus matrix of six independent rows has none near zero
    from impactopt.collision.graph import frozen_dynamics

    robot = small_robots.biped()
    sdc = SDC(robot=robot, striker="fist", normal=X, law=LAW, target=TARGET)
    function = frozen_dynamics(sdc).function("frozen", ("pivots", "freedom"))
    pivots, freedom = function(robot.posture("half_sitting"), np.zeros(robot.nv), X, 0.0)
    pivots = np.array(pivots)
    assert pivots.size == 12 and (pivots > 1e-6).all() and (pivots <= 1 + 1e-12).all()
    assert 0 < float(freedom) < 1


def test_the_command_counts_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stability, "RIGS", (RIGS[3],))
    monkeypatch.setattr(stability, "MASSES", ())
    monkeypatch.setattr(stability, "FREEZES", ())
    monkeypatch.setattr(stability, "CASES", 80)
    result = CliRunner().invoke(app, ["stability", "--quick", "--workers", "1", "--json", "-q"])
    assert result.exit_code == 0, result.output
    numbers = json.loads(result.stdout)
    assert numbers.keys() >= {"cases", "agree", "refused", "nan", "wrong", "seconds", "reasons"}
    assert numbers["cases"] == numbers["agree"] + numbers["refused"]
    assert sum(numbers["reasons"].values()) == numbers["cases"]


@pytest.mark.parametrize("place", [0, 1, 2])
def test_every_row_of_a_batch_is_stable_or_has_no_numbers(place: int) -> None:
    # a wrist whose servo is too fast for the step moves the hand by nothing: the impulse would not tell
    sdc = SDC(
        robot=small_robots.arm(),
        striker="hand",
        normal=X,
        law=LAW,
        target=TARGET,
        method="rk4",
        accuracy=None,
    )
    n = sdc.robot.n
    q, kd = np.tile(sdc.robot.posture("start"), (3, 1)), np.tile(sdc.robot.kd, (3, 1))
    kd[place, -1] *= 1e5
    assert sdc.stable_step(q[0], kd=kd[place]) < sdc.step_length < sdc.stable_step(q[0])
    v = np.tile(striking_velocity(sdc.robot, q[0], "hand", X, 0.5), (3, 1))
    found = sdc.batch(q, v, np.zeros(n), outputs=("impulse", "torque"), kd=kd)
    kept = [k for k in range(3) if k != place]
    assert np.isnan(found["impulse"][place]) and not found["separated"][place]
    assert np.isnan(found["torque"][place]).all()
    assert np.isfinite(found["impulse"][kept]).all() and found["separated"][kept].all()
    with pytest.raises(InputError, match="unstable in every collision"):
        sdc.batch(q, v, np.zeros(n), kd=kd[place])


def test_a_bound_of_the_rates_only_spares_eigenvalues() -> None:
    sdc = slider(method="rk4")
    stiffness = 10 ** np.linspace(7.0, 11.0, 40)
    given = {name: x.reshape(1, -1) for name, x in sdc.settings.items()}
    given |= {"q": np.zeros((40, 1)), "contact_stiffness": stiffness[:, None]}
    alone = [sdc.stable_step([0.0], contact_stiffness=k) <= sdc.step_length for k in stiffness]
    assert sdc._stability.unstable(given).tolist() == alone
    assert {*alone} == {True, False}


@pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")
@pytest.mark.parametrize("compiler", [True, False])
def test_rows_that_rounding_spoils_have_no_numbers(compiler: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # soles that hold each other: what rounding leaves of some directions passes for a number now and then
    if not compiler:
        monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    robot = make_robot("planar walker")
    sdc = SDC(robot=robot, striker="tip", normal=X, law=LAW, target=TARGET, accuracy=None)
    rng = np.random.default_rng(0)
    q = np.hstack([np.zeros((120, 3)), rng.normal(size=(120, 4)), rng.uniform(-1.0, 1.0, (120, robot.n))])
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1)[:, None]
    v = rng.normal(size=(120, robot.nv))
    found = sdc.batch(q, v, np.zeros(robot.n), outputs=("impulse", "duration", "time"))
    assert all(np.isnan(found[name]).all() for name in ("impulse", "duration", "time"))
    assert not found["separated"].any()
    alone = sdc.function(("impulse", "separated", "time"))
    assert all(
        np.isnan(x).all() for k in range(120) for x in map(np.array, alone(q[k], v[k], np.zeros(robot.n)))
    )
