"""Batches and descriptions of collisions, and the benches of speed: what they give, not how fast."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import small_robots
from test_native import FRICTION, LAW, TARGET, sdc, situation

from impactopt._compiler import find_compiler
from impactopt.collision import SDC, Terms, VirtualMass
from impactopt.collision.describe import independent_joints
from impactopt.errors import InputError
from impactopt.presets import standin

compiled = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
unwarned = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")

X = np.array([1.0, 0.0, 0.0])


# ---------------------------------------------------------------- batches
def cases(name: str, model: Any, count: int) -> tuple[Any, Any, Any]:
    found = [situation(name, model, seed=k, speed=0.5 + 0.3 * k)[:3] for k in range(count)]
    q, v, torque = (np.array(x) for x in zip(*found, strict=True))
    return q, v, torque


def assert_one_by_one(model: Any, found: dict[str, Any], one: Any, outputs: tuple[str, ...]) -> None:
    for i in range(len(found["separated"])):
        alone = one(i)
        for name in outputs:
            true = np.asarray(getattr(alone, name))
            value = found[name][i]
            if name in ("time", "force", "torque", "sole_wrench", "zmp"):
                # the last instant is repeated
                assert np.abs(value[true.shape[0] :] - value[-1]).max(initial=0.0) == 0.0
                value = value[: true.shape[0]]
            scale = max(1e-9, float(np.abs(true).max()))
            assert np.abs(value - true).max() <= 1e-11 * scale, name


@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_is_its_collisions_one_by_one(threads: int) -> None:
    model = sdc("arm", terms=Terms(friction=True), friction=FRICTION)
    q, v, torque = cases("arm", model, 9)
    outputs = ("impulse", "velocity", "time", "force", "torque")
    found = model.batch(q, v, torque, outputs=outputs, threads=threads)
    assert found["separated"].all() and found["separated"].dtype == bool
    assert_one_by_one(model, found, lambda i: model.collide(q[i], v[i], torque[i]), outputs)


def test_wrenches_of_a_biped_s_batch_keep_their_shape() -> None:
    model = sdc("biped")
    q, v, torque = cases("biped", model, 3)
    outputs = ("sole_wrench", "zmp", "peak_force", "time")
    found = model.batch(q, v, torque, outputs=outputs)
    assert_one_by_one(model, found, lambda i: model.collide(q[i], v[i], torque[i]), outputs)


def test_settings_are_one_for_all_or_one_each() -> None:
    gains = 0.5 * np.ones((4, 4)) + np.diag([20.0, 30.0, 20.0, 10.0])
    gains[0, 1] += 0.3  # not symmetric, so that a transposed one is seen
    model = sdc("arm", kp=10 * gains, kd=gains)
    q, v, torque = cases("arm", model, 4)
    masses = np.array([0.5, 1.0, 2.0, 3.0])
    kd = np.array([gains * k for k in (1.0, 0.5, 0.8, 0.2)])
    found = model.batch(q, v, torque[0], target_mass=masses, kd=kd, contact_damping=100.0)
    for i in range(4):
        alone = model.collide(q[i], v[i], torque[0], target_mass=masses[i], kd=kd[i], contact_damping=100.0)
        assert found["impulse"][i] == pytest.approx(alone.impulse, rel=1e-11)


def test_a_contact_that_does_not_end_is_flagged() -> None:
    model = sdc("arm", horizon=0.004)
    q, v, torque = cases("arm", model, 2)
    v[1] *= -1.0  # hands that part
    found = model.batch(q, v, torque)
    assert found["separated"].tolist() == [False, True]


def test_what_is_wrong_in_a_batch_is_said() -> None:
    model = sdc("arm")
    q, v, torque = cases("arm", model, 3)
    broken = v.copy()
    broken[1, 2] = np.nan
    for given, words in (
        ((q[0], v, torque), "q: expected shape"),
        ((q[:0], v[:0], torque[:0]), "no collision"),
        ((q, v[:2], torque), "v: expected shape"),
        ((q, broken, torque), "v: nan at index"),
        ((q, v, None), "feed-forward"),
        ((q, v, torque[:2]), "torque"),
    ):
        with pytest.raises(InputError, match=words):
            model.batch(*given)
    for settings, words in (
        ({"target_mass": [1.0, 2.0]}, "target_mass"),
        ({"target_mass": [1.0, -2.0, 1.0]}, "mass"),
        ({"target_mas": 1.0}, "did you mean"),
        ({"normal": [X, X, 2 * X]}, "unit vector"),
        ({"kd": 1e9}, "unstable"),
    ):
        with pytest.raises(InputError, match=words):
            model.batch(q, v, torque, **settings)
    with pytest.raises(InputError, match="threads"):
        model.batch(q, v, torque, threads=0)
    biped = sdc("biped")
    q, v, torque = cases("biped", biped, 2)
    q[1, 3:7] *= 2
    with pytest.raises(InputError, match="quaternion"):
        biped.batch(q, v, torque)


@unwarned
def test_without_a_compiler_a_batch_takes_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    model = SDC(
        robot=small_robots.slider(3.0), striker="tip", normal=X, law=LAW, target=TARGET, terms=Terms.none()
    )
    q, v = np.zeros((2, 1)), np.array([[1.0], [2.0]])
    found = model.batch(q, v, outputs=("impulse", "force"))
    assert found["impulse"][0] == pytest.approx(model.collide(q[0], v[0]).impulse, rel=1e-12)
    assert found["impulse"][1] > found["impulse"][0]


# ---------------------------------------------------------------- descriptions
def test_a_description_says_what_is_in_and_what_is_not() -> None:
    model = sdc("biped", terms=Terms(saturation=False, bias=False))
    told = model.describe(("impulse", "zmp"), parameters=("kd",))
    numbers = told.as_dict()
    assert numbers["terms"] == ["damping", "stiffness", "feedforward", "jdot"]
    assert len(numbers["held"]) == 2 and numbers["inputs"] == ["q", "v", "feedforward", "kd"]
    assert {"saturation", "bias", "friction", "peak force", "derivatives"} <= {*numbers["left_out"]}
    assert not {"stiffness", "histories", "wrenches and ZMP"} & {*numbers["left_out"]}
    assert "terms.saturation is off" in str(told) and "zmp" in str(told)
    json.dumps(numbers)


def test_what_is_left_out_is_not_computed() -> None:
    lean = sdc("biped", terms=Terms.none()).describe(("impulse",)).as_dict()["instructions"]
    full = sdc("biped", terms=Terms(friction=True), friction=FRICTION)
    rich = full.describe(full.available).as_dict()["instructions"]
    assert lean["freeze"] < 0.9 * rich["freeze"] and lean["step"] < 0.6 * rich["step"]


def test_a_point_mass_has_no_servo() -> None:
    numbers = sdc("arm", VirtualMass).describe().as_dict()
    assert numbers["terms"] == [] and "servo" in numbers["left_out"]
    with pytest.raises(InputError, match="point mass"):
        sdc("arm", VirtualMass).describe(("torque",))


def test_joints_that_share_none_with_the_blow_s_limb_change_nothing() -> None:
    robot = standin(floating=False)
    options: dict[str, Any] = {"striker": "right_hand", "normal": X, "law": LAW, "target": TARGET}
    whole = SDC(robot=robot, **options)
    alone = independent_joints(whole)
    assert "left_knee" in alone and "left_elbow" not in alone  # the arms share the chest
    q = robot.posture("half_sitting")
    v = np.where([name == "right_elbow" for name in robot.joint_names], -3.0, 0.1)
    kept = [robot.joint_index(name) for name in robot.joint_names if name not in alone]
    angles = {name: float(q[robot.joint_index(name)]) for name in alone}
    small = SDC(robot=standin(floating=False, locked=angles), **options)
    torque = np.linspace(-5.0, 5.0, robot.n)
    a, b = whole.collide(q, v, torque), small.collide(q[kept], v[kept], torque[kept])
    assert a.impulse == pytest.approx(b.impulse, rel=1e-12) and a.impulse > 0.1
    assert np.abs(np.asarray(a.torque)[:, kept] - np.asarray(b.torque)).max() < 1e-9
    assert independent_joints(small) == [] and independent_joints(sdc("biped")) == []
    assert "nothing yet" in whole.describe().left_out
