"""What freezing costs is estimated, told, and not computed where nobody asks."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from benchmarks import freezes as bench
from benchmarks.stability_robots import make_robot

from impactopt import (
    SDC,
    FreeMass,
    FullDynamics,
    InputError,
    SpringDamper,
    VirtualMass,
    collide_many,
    holding_torque,
    striking_velocity,
)
from impactopt.collision.checks import freeze_error, more_often
from impactopt.report.console import collision_table

X = np.array([1.0, 0.0, 0.0])
Q, SPEED = np.array([0.4, 0.9, 0.5]), 1.0


def options(stiffness: float) -> dict[str, Any]:
    law = SpringDamper(stiffness=stiffness, damping=0.1 * np.sqrt(stiffness))
    return {
        "robot": make_robot("arm"),
        "striker": "tip",
        "normal": X,
        "law": law,
        "target": FreeMass(mass=0.4),
    }


def blow(model: Any) -> Any:
    v = striking_velocity(model.robot, Q, "tip", X, SPEED)
    return model.collide(Q, v, holding_torque(model.robot, Q, v), require_separation=False)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [2e2, 1e4, 1e6])
@pytest.mark.parametrize("freezes", [0, 1, 2, 4])
def test_the_error_is_not_more_than_is_said(stiffness: float, freezes: int) -> None:
    found = blow(SDC(**options(stiffness), freezes=freezes, horizon=0.5))
    truth = blow(FullDynamics(**options(stiffness), step=2e-5, horizon=0.5))
    assert found.separated and truth.separated
    error = abs(found.impulse / truth.impulse - 1)
    assert error < found.freeze_error
    # nor is it all that is ever said
    assert found.freeze_error < 5 * error + 2e-3
    assert truth.freeze_error == 0.0 and truth.caution == ""


def test_what_is_above_the_accuracy_is_told_with_the_fix() -> None:
    loose = blow(SDC(**options(2e2), horizon=0.5))
    assert loose.freeze_error > 1e-2
    assert "freezes=4" in loose.caution
    patient = blow(SDC(**options(2e2), horizon=0.5, accuracy=2 * loose.freeze_error))
    assert patient.caution == "" and patient.freeze_error == loose.freeze_error
    fixed = blow(SDC(**options(2e2), horizon=0.5, freezes=4))
    assert fixed.freeze_error < loose.freeze_error / 5


def test_without_an_accuracy_nothing_is_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("a second collision was computed")

    monkeypatch.setattr(SDC, "batch", never)
    found = blow(SDC(**options(1e4), accuracy=None))
    assert np.isnan(found.freeze_error) and found.caution == ""
    point = blow(VirtualMass(**options(1e4)))
    assert np.isnan(point.freeze_error)
    with pytest.raises(InputError, match="accuracy"):
        SDC(**options(1e4), accuracy=-0.1)


def test_a_batch_says_what_single_collisions_say_and_only_if_asked() -> None:
    model = SDC(**options(2e2), horizon=0.5)
    v = striking_velocity(model.robot, Q, "tip", X, SPEED)
    torque = holding_torque(model.robot, Q, v)
    stiffness = np.array([2e2, 1e4, 1e6])
    given: dict[str, Any] = {"contact_stiffness": stiffness}
    q, vs = np.tile(Q, (3, 1)), np.tile(v, (3, 1))
    assert "freeze_error" not in model.batch(q, vs, torque, **given)
    found = model.batch(q, vs, torque, outputs=("freeze_error",), **given)["freeze_error"]
    alone = [model.collide(Q, v, torque, contact_stiffness=k).freeze_error for k in stiffness]
    np.testing.assert_allclose(found, alone, rtol=1e-9)
    assert (np.diff(found) < 0).all()  # the shorter the contact, the less


def test_a_contact_that_does_not_end_when_frozen_more_often_leaves_all_open() -> None:
    one = np.ones(4)
    better = np.array([1.0, 1.01, 1.0, np.nan])
    error = freeze_error(one, better, np.array([True, True, False, True]))
    assert error[0] < error[1] < 0.03
    assert np.isinf(error[2:]).all()
    assert freeze_error(np.zeros(1), np.zeros(1), np.array([True]))[0] < 1e-2
    assert all(more_often(n) >= 2 * n for n in range(40))


def test_many_collisions_have_the_column_unless_others_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = {"contact.stiffness": [1e5, 1e6]}
    state = {"speed_m_s": 1.0}
    found = collide_many("arm_planar", rows, at_contact=state)
    assert found["freeze_error_pct"][0] > found["freeze_error_pct"][1] > 0
    monkeypatch.setattr("impactopt.collision.symbolic.freeze_error", None)
    named = collide_many("arm_planar", rows, at_contact=state, outputs=["impulse_Ns"])
    np.testing.assert_array_equal(named["impulse_Ns"], found["impulse_Ns"])
    many = collide_many("arm_planar", rows, at_contact={**state, "model": "virtual-mass"})
    assert (many["reason"] == "").all() and np.isnan(many["freeze_error_pct"]).all()


def test_the_table_says_it() -> None:
    found = {"problem": "p", "model": "sdc", "impulse_Ns": 1.0, "freeze_error_pct": 7.0}
    assert collision_table(found).caption is None
    table = collision_table({**found, "caution": "give freezes=4"})
    assert "give freezes=4" in str(table.caption)


def test_more_freezes_converge_where_the_first_does_not_know_how_long_contact_lasts() -> None:
    """A light hand that is pushed on: contact is a fifth longer than the freeze at contact predicts."""
    model = SDC(**options(2e2), horizon=0.5, accuracy=None)
    truth = blow(FullDynamics(**options(2e2), step=2e-5, horizon=0.5))
    errors = [
        abs(blow(dataclasses.replace(model, freezes=n)).impulse / truth.impulse - 1) for n in (4, 8, 16)
    ]
    assert errors[2] < errors[0] / 8
    assert errors[2] < 1e-3


def test_the_bench_counts_what_is_off_by_more_than_was_said() -> None:
    def row(duration: float, true: float, said: float | None) -> dict[str, Any]:
        each = {"true_pct": true, "said_pct": said}
        return {"duration_s": duration, "freezes": {str(n): each for n in bench.FREEZES}}

    rows = [row(1e-3, 0.05, 0.1), row(10e-3, 2.0, 1.5), row(10e-3, 0.2, 3.0), row(0.2, 9.0, None)]
    found = bench.summary(rows)
    assert found["judged"] == 4 and found["off"] == len(bench.FREEZES)
    whole = [r for r in found["rows"] if r["from_s"] == 0 and r["to_s"] == bench.HORIZON]
    assert [r["not_ended"] for r in whole] == [1] * len(bench.FREEZES)
    assert whole[0]["max"] == 9.0 and whole[0]["flagged"] == 2 and whole[0]["missed"] == 0


def test_what_the_bench_draws_is_a_state_of_the_robot() -> None:
    robot = bench._robot("standin")
    for seed in range(3):
        case = bench.draw(robot, "spring, mass", np.random.default_rng(seed))
        assert case is not None
        joints = robot.joint_positions(case.q)
        assert (joints >= robot.lower).all() and (joints <= robot.upper).all()
        assert case.settings["target_mass"] > 0
