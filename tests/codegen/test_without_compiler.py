"""With a compiler, with one that fails and without: the same numbers, or a refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support import small_robots

from impactopt import (
    SDC,
    Board,
    ContactLaw,
    Effects,
    FreeMass,
    HuntCrossley,
    InputError,
    JointFriction,
    KelvinVoigt,
    Nail,
    RigidWall,
    SpringDamper,
    Target,
    VirtualMass,
    collide_many,
)
from impactopt.codegen.compiler import find_compiler

pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")

X = np.array([1.0, 0.0, 0.0])
FRICTION = JointFriction(viscous=2.0, coulomb=3.0, transition=0.05)
CONTACTS: dict[str, tuple[ContactLaw, Target]] = {
    "mass": (SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=5.0)),
    "steel": (SpringDamper(stiffness=1e9, damping=1e4), FreeMass(mass=0.5)),
    "wall": (KelvinVoigt(stiffness=2e5, damping=50.0), RigidWall()),
    "rounded": (HuntCrossley(stiffness=1e6, dissipation=0.2), FreeMass(mass=1.0)),
    "nail": (SpringDamper(stiffness=1e6, damping=100.0), Nail(mass=0.02, resistance=300.0)),
    "board": (
        SpringDamper(stiffness=2e5, damping=50.0),
        Board(mass=0.5, stiffness=1e5, damping=20.0, breaking_force=300.0),
    ),
}


def fails(tmp_path: Path, *, on: str) -> str:
    """A compiler that says its version, and fails on some files (a pattern of the shell's)."""
    script = tmp_path / "cc"
    script.write_text(
        "#!/bin/sh\n"
        f'case "$*" in {on}) echo "error: No space left on device" >&2; exit 1;; esac\n'
        'exec cc "$@"\n'
    )
    script.chmod(0o755)
    return str(script)


def arm(contact: str, **options: Any) -> SDC:
    law, target = CONTACTS[contact]
    given = {"robot": small_robots.arm(), "striker": "hand", "normal": X, "horizon": 0.2, **options}
    return SDC(law=law, target=target, **given)


def situation(seed: int) -> tuple[Any, Any, Any]:
    """Of the arm, its hand moving along the normal."""
    robot, rng = small_robots.arm(), np.random.default_rng(seed)
    model = SDC(robot=robot, striker="hand", normal=X, law=CONTACTS["mass"][0], target=FreeMass(mass=1.0))
    q, v = robot.posture("start"), rng.normal(size=robot.nv)
    model_speed = float(model.function(("hand_speed",))(q, v, np.zeros(robot.n))[0])
    return q, 2.0 * v / model_speed, rng.normal(size=robot.n) * 0.3 * robot.torque_limit


# ---------------------------------------------------------------- SciPy's steps end where those in C do
@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="nothing to compare with")
@pytest.mark.parametrize("contact", CONTACTS)
def test_collisions_by_scipy_are_those_in_c(contact: str, monkeypatch: pytest.MonkeyPatch) -> None:
    variants: list[dict[str, Any]] = [
        {},
        {"freezes": 2},
        {"effects": Effects.paper(friction=True), "friction": FRICTION},
    ]
    models = [arm(contact, tolerance=1e-9, **options) for options in variants]
    given = [situation(seed) for seed in range(len(models))]
    compiled = [model.collide(*x, require_separation=False) for model, x in zip(models, given, strict=True)]
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    for options, x, expected in zip(variants, given, compiled, strict=True):
        found = arm(contact, tolerance=1e-9, **options).collide(*x, require_separation=False)
        assert expected.impulse > 0 and found.separated == expected.separated
        assert found.target_result == pytest.approx(expected.target_result, rel=1e-6)
        for name in ("impulse", "peak_force", "duration", "energy", "velocity", "configuration", "time"):
            np.testing.assert_allclose(
                getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-12, err_msg=name
            )
        assert expected.torque is not None
        np.testing.assert_allclose(found.force, expected.force, atol=1e-6 * expected.peak_force)
        np.testing.assert_allclose(found.torque, expected.torque, atol=1e-6 * np.abs(expected.torque).max())


def test_a_point_mass_against_its_closed_form_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    law = SpringDamper(stiffness=3e8, damping=0.0)
    model = VirtualMass(
        robot=small_robots.slider(2.0), striker="tip", normal=X, law=law, target=FreeMass(mass=5.0)
    )
    reduced = 10.0 / 7.0
    found = model.collide([0.0], [1.0])
    assert found.impulse == pytest.approx(2.0 * reduced, rel=1e-6)
    assert found.peak_force == pytest.approx(np.sqrt(3e8 * reduced), rel=1e-6)
    assert found.duration == pytest.approx(np.pi * np.sqrt(reduced / 3e8), rel=1e-6)
    # no number in, none out
    assert np.isnan(np.array(model.function()([0.0], [np.nan]))).all()


# ---------------------------------------------------------------- against an ODE of its own
def by_ode(law: ContactLaw, mass: float, own: float, speed: float) -> tuple[float, float]:
    """Impulse and peak force of two point masses, by SciPy's stiff integrator."""

    def force(y: Any) -> float:
        return float(law.branch(y[0], y[1], y[1] > 0))

    def flow(_t: float, y: Any) -> Any:
        f = max(force(y), 0.0)
        return [y[1], -f * (1 / own + 1 / mass), f]

    def parted(_t: float, y: Any) -> float:
        return 1.0 if y[1] > 0 else force(y) - 1e-9

    parted.terminal = True  # type: ignore[attr-defined]
    reduced = 1 / (1 / own + 1 / mass)
    deepest = speed * np.sqrt(reduced / law.parameters["stiffness"])
    if isinstance(law, HuntCrossley):
        deepest = (1.25 * reduced * speed**2 / law.stiffness) ** 0.4
    span = 20 * deepest / speed + 10 * law.parameters.get("damping", 0.0) / law.parameters["stiffness"]
    found = solve_ivp(
        flow,
        (0.0, span),
        [0.0, speed, 0.0],
        method="Radau",
        events=parted,
        rtol=1e-9,
        atol=1e-9 * np.array([deepest, speed, reduced * speed]),
        max_step=0.02 * deepest / speed,
    )
    return float(found.y[2, -1]), max(force(y) for y in found.y.T)


@pytest.mark.parametrize("how", ["compiler", "broken compiler", "full disk", "no compiler"])
def test_stiff_and_light_collisions_are_right_with_any_compiler(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path / "cache"))
    if how == "broken compiler":
        monkeypatch.setenv("CC", fails(tmp_path, on="*.c*"))
    elif how == "full disk":
        monkeypatch.setenv("CC", fails(tmp_path, on="*collision*"))
    elif how == "no compiler":
        monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    model = SDC(
        robot=small_robots.slider(2.0),
        striker="tip",
        normal=X,
        law=SpringDamper(stiffness=1e9, damping=1e4),
        target=FreeMass(mass=0.5),
        horizon=0.05,
    )
    cases = [(1e9, 1e4, 0.5, 3.0), (1e8, 30.0, 1e-3, 2.0), (3e4, 100.0, 50.0, 1.0)]
    stiffness, damping, mass, speed = np.array(cases).T
    found = model.batch(
        np.zeros((3, 1)),
        speed[:, None],
        np.zeros(1),
        contact_stiffness=stiffness,
        contact_damping=damping,
        target_mass=mass,
    )
    truth = [by_ode(SpringDamper(stiffness=k, damping=d), m, 2.0, v)[0] for k, d, m, v in cases]
    np.testing.assert_allclose(found["impulse"], truth, rtol=1e-6)
    assert found["separated"].all()


@pytest.mark.slow
def test_many_collisions_of_a_stiff_contact_are_those_of_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    def found() -> Any:
        changes = {"contact.stiffness": [1e5, 5e6]}
        return collide_many("arm_planar", changes, at_contact={"speed_m_s": 3.0})["impulse_Ns"]

    compiled = found()
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    assert np.isfinite(compiled).all()
    np.testing.assert_allclose(found(), compiled, rtol=1e-6)


# ---------------------------------------------------------------- each row by its own estimate
@pytest.mark.slow
@pytest.mark.parametrize("method", ["rk4", "implicit"])
def test_every_row_is_right_or_refused(method: str) -> None:
    law, names = HuntCrossley(stiffness=1e6, dissipation=0.1), ("stiffness", "dissipation")
    accuracy = 1e-2 if method == "rk4" else 1e-6
    model = SDC(
        robot=small_robots.slider(2.0),
        striker="tip",
        normal=X,
        law=law,
        target=FreeMass(mass=5.0),
        horizon=0.1,
        method=method,
    )
    rng, count = np.random.default_rng(5), 40
    # the first row is a soft one: it says nothing of the others
    stiffness = np.append(law.parameters["stiffness"], 10 ** rng.uniform(3.5, 10.0, count - 1))
    other = np.append(0.1, rng.uniform(0.0, 0.2, count - 1))
    mass, speed = 10 ** rng.uniform(-2, 2, count), rng.uniform(0.5, 4.0, count)
    settings = {f"contact_{names[0]}": stiffness, f"contact_{names[1]}": other, "target_mass": mass}
    found = model.batch(
        np.zeros((count, 1)), speed[:, None], np.zeros(1), outputs=("impulse", "peak_force"), **settings
    )
    kept = np.isfinite(found["impulse"])
    assert 8 <= kept.sum() <= count - 8 if method == "rk4" else kept.all()
    assert not found["separated"][~kept].any()
    for i in np.flatnonzero(kept & found["separated"]):
        given = dict(zip(names, (stiffness[i], other[i]), strict=True))
        impulse, peak = by_ode(type(law)(**given), mass[i], 2.0, speed[i])
        assert found["impulse"][i] == pytest.approx(impulse, rel=accuracy)
        assert found["peak_force"][i] == pytest.approx(peak, rel=max(accuracy, 1e-3))
    if method == "implicit":
        return
    with pytest.raises(InputError, match=r"too long to follow this contact|unstable"):
        i = int(np.flatnonzero(~kept)[0])
        model.collide([0.0], [speed[i]], [0.0], **{name: x[i] for name, x in settings.items()})
