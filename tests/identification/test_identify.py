"""Contact laws from logs: numbers and intervals are right on blows that SciPy has integrated."""

from __future__ import annotations

import dataclasses
import json
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.measured_blows import TRUE, TrueBlow, log_of
from typer.testing import CliRunner

from impactopt import (
    ContactLaw,
    CustomLaw,
    FreeMass,
    HuntCrossley,
    ImpactLog,
    InputError,
    KelvinVoigt,
    SpringDamper,
    VirtualMass,
    effective_mass,
    identify,
    load_problem,
    planar_arm,
    read_log,
)
from impactopt.cli.app import app
from impactopt.contact.fields import about
from impactopt.contact.laws import LAWS
from impactopt.files.named_problems import problem_file
from impactopt.files.problem_file import ProblemFile, problem_data, read_toml
from impactopt.identification.fitting import TwoMassModel
from impactopt.identification.free_parameters import sample_law
from impactopt.identification.log import find_impacts

MASS = 3.0


def test_laws_of_the_package_are_all_looked_for() -> None:
    assert {law.word for law in LAWS} == set(TRUE)


def test_two_free_masses_collide_as_their_reduced_mass() -> None:
    """What is fitted is our own collision of a robot with a free target, with its effective mass in it."""
    arm, normal = planar_arm(), [0.0, 0.0, -1.0]
    q, law = arm.posture("ready"), SpringDamper(stiffness=2e4, damping=60.0)
    m = float(effective_mass(arm, striker="hammer", normal=normal)(q))
    model = VirtualMass(
        robot=arm, striker="hammer", normal=normal, law=law, target=FreeMass(mass=2.0), horizon=0.2, step=1e-3
    )
    data = arm.model.createData()
    pin.computeJointJacobians(arm.model, data, q)
    frame = arm.model.getFrameId("striker:hammer")
    row = np.array(normal) @ pin.getFrameJacobian(arm.model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
    whole = model.collide(q, row / (row @ row))  # at 1 m/s
    numbers = {name: np.array([x]) for name, x in law.parameters.items()}
    (history,) = TwoMassModel(law, 0.2).histories(numbers, np.array([1 / (1 / m + 1 / 2.0)]), np.ones(1))
    np.testing.assert_allclose(history.impulse[-1], whole.impulse, rtol=1e-6)
    np.testing.assert_allclose(history.time[-1], whole.duration, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("law", TRUE)
def test_numbers_come_out_of_a_log_with_noise(law: str) -> None:
    found = identify(log_of(TrueBlow(law, mass=MASS), seed=3))
    assert found.best.name == law
    true = {**TRUE[law][1], "effective_mass": MASS}
    for name, value in true.items():
        assert found.best.estimates[name].value == pytest.approx(value, rel=0.05), name
    assert found.best.undetermined == ()
    assert found.best.force_left_pct == pytest.approx(2.0, rel=0.2)  # the noise, and no more
    assert abs(found.best.correlation) < 0.3 < found.fits[-1].correlation
    assert law in repr(found) and len(repr(found)) < 300  # no arrays


@pytest.mark.parametrize("law", TRUE)
def test_without_noise_numbers_are_exact(law: str) -> None:
    found = identify(log_of(TrueBlow(law, mass=MASS), noise=0.0), laws=[law]).best
    for name, value in {**TRUE[law][1], "effective_mass": MASS}.items():
        assert found.estimates[name].value == pytest.approx(value, rel=2e-3), name
    assert found.speeds[0].value == pytest.approx(1.0, rel=1e-4)


@pytest.mark.slow
def test_intervals_of_95_percent_are_such() -> None:
    """Errors over standard errors have a deviation of one, within three of their own for so many draws."""
    blow, draws = TrueBlow("spring damper", mass=MASS), 36
    true = {**TRUE["spring damper"][1], "effective_mass": MASS}
    fits = [identify(log_of(blow, seed=seed, rate=5e3), laws=[SpringDamper]).best for seed in range(draws)]
    for name, value in true.items():
        each = [fit.estimates[name] for fit in fits]
        off = [3.92 * (one.value - value) / (one.high - one.low) for one in each]
        assert 0.66 < np.sqrt(np.mean(np.square(off))) < 1.34, name
        # less than one chance in a thousand, where 95 % cover
        assert sum(one.low <= value <= one.high for one in each) >= 29, name


def test_contact_may_fill_most_of_a_log() -> None:
    log = log_of(TrueBlow("Kelvin-Voigt", mass=MASS), noise=0.005, seed=1)
    assert log.speed is not None
    in_contact = log.force > 0.05 * log.force.max()
    middle, half = float(log.time[in_contact].mean()), 0.58 * float(np.ptp(log.time[in_contact]))
    kept = np.abs(log.time - middle) < half
    assert np.mean(in_contact[kept]) > 0.8
    near = ImpactLog(time=log.time[kept], force=log.force[kept], speed=log.speed[kept])
    found = identify(near, laws=["Kelvin-Voigt"]).best
    for name, value in {**TRUE["Kelvin-Voigt"][1], "effective_mass": MASS}.items():
        assert found.estimates[name].value == pytest.approx(value, rel=0.05), name


@pytest.mark.slow
def test_several_blows_share_law_and_mass_and_leave_a_free_target() -> None:
    blows = [TrueBlow("Hunt-Crossley", mass=MASS, speed=v, target_mass=2.0) for v in (0.5, 1.0, 1.5)]
    found = identify(log_of(*blows, seed=1), laws=[HuntCrossley], target_mass=2.0).best
    assert [speed.value for speed in found.speeds] == pytest.approx([0.5, 1.0, 1.5], rel=0.02)
    for name, value in {**TRUE["Hunt-Crossley"][1], "effective_mass": MASS}.items():
        assert found.estimates[name].value == pytest.approx(value, rel=0.05), name
    one = identify(log_of(blows[1], seed=1), laws=[HuntCrossley], target_mass=2.0).best
    wide, narrow = (fit.estimates["dissipation"] for fit in (one, found))
    assert narrow.high - narrow.low < 0.8 * (wide.high - wide.low)


def test_samples_that_noise_alone_lifts_are_no_contacts() -> None:
    log = log_of(TrueBlow("Kelvin-Voigt", mass=MASS), noise=0.05, seed=1)
    force = log.force.copy()
    force[40] = 0.25 * force.max()  # five deviations of the noise, above a fifth of the peak
    found = identify(dataclasses.replace(log, force=force), laws=["Kelvin-Voigt"]).best
    assert len(found.speeds) == 1
    force[40] = force.max()  # no noise
    with pytest.raises(InputError, match=r"1 sample in contact.*take them out if they are outliers"):
        identify(dataclasses.replace(log, force=force))


@pytest.mark.parametrize("seed", range(6))
def test_the_end_of_a_contact_in_much_noise_is_no_other_contact(seed: int) -> None:
    log = log_of(TrueBlow("Kelvin-Voigt", mass=MASS), noise=0.1, rate=1e5, seed=seed)
    (impact,), _ = find_impacts(log)
    assert impact.duration == pytest.approx(0.016, rel=0.15)


def test_contacts_between_which_the_force_stays_are_refused() -> None:
    t = np.arange(0.0, 0.1, 1e-4)
    two = sum(np.where((t >= a) & (t < a + 0.01), np.sin(np.pi * (t - a) / 0.01), 0.0) for a in (0.02, 0.033))
    force = 400 * np.maximum(two, np.where((t > 0.025) & (t < 0.04), 0.04, 0.0))
    speed = 1.0 - np.cumsum(force) * 1e-4 / MASS
    with pytest.raises(InputError, match="force has not returned to zero since the contact before"):
        identify(ImpactLog(time=t, force=force, speed=speed))


@pytest.mark.parametrize("column", ["force", "speed"])
@pytest.mark.parametrize("times", [2, 10])
def test_values_of_a_slower_sensor_that_are_repeated_are_refused(column: str, times: int) -> None:
    """Held force was taken for a cut-off one, and its stiffness was up to 9 % off."""
    log = log_of(TrueBlow("Kelvin-Voigt"), seed=1)
    rows = np.arange(len(log.time)) // times * times
    held = dataclasses.replace(log, **{column: getattr(log, column)[rows]})
    with pytest.raises(InputError, match=rf"{column}\w* is repeated some {times} times.*keep one row"):
        identify(held)


@pytest.mark.parametrize("step", [0.01, 0.1])
def test_a_coarse_speed_is_not_taken_for_a_repeated_one(step: float) -> None:
    log = log_of(TrueBlow("Kelvin-Voigt"), noise=0.0, rate=3e4)
    assert log.speed is not None
    find_impacts(dataclasses.replace(log, speed=np.round(log.speed / step) * step))


def test_an_offset_of_the_force_is_told() -> None:
    """1 % of the peak makes the mass too large by more than its interval, and residuals hardly show it."""
    log = log_of(TrueBlow("Kelvin-Voigt", mass=MASS), seed=3)
    offset = 0.015 * float(log.force.max())
    shifted = identify(dataclasses.replace(log, force=log.force + offset), laws=["Kelvin-Voigt"])
    assert shifted.best.effective_mass.low > MASS
    assert shifted.force_offset == pytest.approx(offset, rel=0.5)
    assert any("subtract this offset" in caution for caution in shifted.cautions)
    assert shifted.describe()["force_offset_N"] == shifted.force_offset
    right = identify(log, laws=["Kelvin-Voigt"])
    assert right.force_offset == 0.0
    assert not any("offset" in caution for caution in right.cautions)


def test_what_a_log_does_not_determine_is_said() -> None:
    none = TrueBlow("spring damper", mass=MASS, numbers={"stiffness": 1e5, "damping": 0.0})
    found = identify(log_of(none, seed=2), laws=[SpringDamper])
    assert found.best.undetermined == ("damping",)
    assert found.best.estimates["stiffness"].value == pytest.approx(1e5, rel=0.05)
    assert any("does not determine damping" in caution for caution in found.cautions)
    assert "not determined" in found.best.toml()


def test_a_force_in_kilonewtons_is_told() -> None:
    log = log_of(TrueBlow("spring damper"))
    found = identify(dataclasses.replace(log, force=log.force / 1e3), laws=[SpringDamper])
    assert any("is force_N in kN?" in caution for caution in found.cautions)
    assert not any("kN" in caution for caution in identify(log, laws=[SpringDamper]).cautions)


def test_a_law_that_does_not_fit_is_told() -> None:
    found = identify(log_of(TrueBlow("Hunt-Crossley")), laws=[SpringDamper])
    assert any("not white noise" in caution for caution in found.cautions)


def test_a_motion_that_does_not_fit_is_told() -> None:
    """A free target taken for a fixed one: the more noise a speed has, the more of that is left in it."""
    log = log_of(TrueBlow("Kelvin-Voigt", target_mass=6.0), noise=0.01, seed=3)
    assert log.speed is not None
    noise = 0.05 * np.random.default_rng(0).normal(size=len(log.time))
    log = dataclasses.replace(log, speed=log.speed + noise)
    wrong, right = (identify(log, laws=["Kelvin-Voigt"], target_mass=mass) for mass in (np.inf, 6.0))
    assert wrong.best.motion_correlation > 0.3 > abs(right.best.motion_correlation)
    assert any("residual motion of Kelvin-Voigt" in caution for caution in wrong.cautions)
    assert not any("white noise" in caution for caution in right.cautions)


def test_a_law_of_ones_own() -> None:
    law = CustomLaw(
        compression=lambda x, rate, k, d: k * x + d * rate,
        analytic=True,
        k=5e4,
        d=100.0,
    )
    found = identify(log_of(TrueBlow("Kelvin-Voigt", mass=MASS), seed=3), laws=[law]).best
    assert found.law.parameters["k"] == pytest.approx(1e5, rel=0.05)
    assert found.law.parameters["d"] == pytest.approx(150.0, rel=0.05)
    with pytest.raises(InputError, match="a file cannot have it"):
        found.toml()


def test_a_negative_parameter_has_the_interval_of_its_opposite() -> None:
    log = log_of(TrueBlow("Kelvin-Voigt", mass=MASS), seed=3)

    def interval(sign: float) -> tuple[float, float]:
        law = CustomLaw(
            compression=lambda x, rate, k, d: sign * k * x + d * rate, analytic=True, k=sign * 5e4, d=100.0
        )
        k = identify(log, laws=[law]).best.estimates["k"]
        return k.low, k.high

    low, high = interval(1.0)
    assert interval(-1.0) == pytest.approx((-high, -low), rel=1e-3)
    assert low < high


@dataclasses.dataclass(frozen=True, kw_only=True)
class Saturating(ContactLaw):
    """A spring and a damper; the spring's force approaches a limit."""

    stiffness: float = dataclasses.field(metadata=about("k", unit="N/m", above=0))
    limit: float = dataclasses.field(metadata=about("of the spring's force", unit="N", above=0))
    damping: float = dataclasses.field(metadata=about("d", unit="N s/m", least=0))

    def branch(self, penetration: Any, rate: Any, compressing: bool, parameters: Any = None) -> Any:
        p = self.parameters if parameters is None else parameters
        spring = p["stiffness"] * penetration
        return spring / (1 + spring / p["limit"]) + p["damping"] * rate


def test_a_parameter_that_may_not_be_zero_is_fixed() -> None:
    law = Saturating(stiffness=1.0, limit=1e6, damping=0.0)
    found = identify(log_of(TrueBlow("Kelvin-Voigt", mass=MASS), seed=3), laws=[law]).best
    assert found.law.parameters == pytest.approx({"stiffness": 1e5, "limit": 1e6, "damping": 150.0}, rel=0.05)
    assert found.held == {"limit": 1e6}
    with pytest.raises(InputError, match=r"no default of limit.*give the law with parameters"):
        sample_law(Saturating)


# ---------------------------------------------------------------- joint positions
def test_joint_positions_are_as_good_as_a_speed(tmp_path: Path) -> None:
    """An arm's joints go along a line through its posture so that its hand moves as the blow has it."""
    problem = load_problem("arm_planar")
    arm, n, q = problem.robot, np.asarray(problem.normal), problem.robot.posture("ready")
    data, frame = arm.model.createData(), arm.model.getFrameId(arm.striker(problem.striker).model_frame)

    def height(s: float) -> float:
        pin.framesForwardKinematics(arm.model, data, q + s * np.array([0.3, 0.5, 0.4]))
        return float(n @ data.oMf[frame].translation)

    s = np.linspace(-0.2, 0.2, 801)
    along = np.array([height(x) for x in s])
    assert (np.diff(along) > 0).all()
    t = np.arange(-0.02, 0.04, 1e-4)
    force, _, travel = TrueBlow("spring damper", mass=MASS).at(t - 3.7e-5)
    drawn = np.random.default_rng(4)
    force = force + 0.02 * force.max() * drawn.normal(size=len(t))
    angles = q + np.interp(travel + height(0.0), along, s)[:, None] * np.array([0.3, 0.5, 0.4])
    angles = angles + 2e-5 * drawn.normal(size=angles.shape)  # an encoder of 17 bits
    joints = {f"{name}_rad": angles[:, k] for k, name in enumerate(arm.joint_names)}
    path = tmp_path / "joints.npz"
    np.savez(path, time_s=t, force_N=force, **joints)
    log = read_log(path, robot=arm, striker=problem.striker, normal=n)
    assert log.model_mass is not None and log.travel is not None
    touch = int(np.searchsorted(t, 0.0))
    expected = float(effective_mass(arm, striker=problem.striker, normal=n)(angles[touch]))
    assert log.model_mass[touch] == pytest.approx(expected, rel=1e-9)
    found = identify(log, laws=[SpringDamper])
    for name, value in {**TRUE["spring damper"][1], "effective_mass": MASS}.items():
        assert found.best.estimates[name].value == pytest.approx(value, rel=0.05), name
    assert any("robot's model has an effective mass" in caution for caution in found.cautions)
    np.savez(path, time_s=t, force_N=force, hand_speed_m_s=0 * t, **joints)
    again = read_log(path, robot=arm, striker=problem.striker, normal=n)
    assert again.speed is None and np.array_equal(again.travel, log.travel)
    np.savez(path, time_s=t, force_N=force, hand_speed_m_s=0 * t)
    with pytest.raises(InputError, match=r"no joint positions: leave robot \(--problem\) out"):
        read_log(path, robot=arm, striker=problem.striker, normal=n)
    np.savez(path, time_s=t, force_N=force, **{name: np.rad2deg(x) for name, x in joints.items()})
    with pytest.raises(InputError, match="degrees"):
        read_log(path, robot=arm, striker=problem.striker, normal=n)
    last = arm.joint_names[-1]
    np.savez(path, time_s=t, force_N=force, **{**joints, f"{last}_rad": angles[:-1, -1]})
    with pytest.raises(InputError, match=rf"joints\.npz: {last}: "):
        read_log(path, robot=arm, striker=problem.striker, normal=n)


# ---------------------------------------------------------------- bad logs
def changed(**changes: Any) -> ImpactLog:
    log = log_of(TrueBlow("spring damper"))
    assert log.speed is not None
    return ImpactLog(**{"time": log.time, "force": log.force, "speed": log.speed, **changes})


def test_logs_that_cannot_be_used_are_refused() -> None:
    log = changed()
    t, f, v = log.time, log.force, log.speed
    assert v is not None
    still = np.where(t < -0.01, np.nan, f)
    cases: list[tuple[dict[str, Any], str]] = [
        ({"force": still}, "force_N: nan at index 0"),
        ({"time": t[::-1]}, "does not increase"),
        ({"time": np.repeat(t[::2], 2)}, "does not increase"),
        ({"force": f[1:]}, "expected shape"),
        ({"force": 0.0 * f}, "no contact"),
        ({"force": np.random.default_rng(0).normal(size=len(f))}, "no contact"),
        ({"force": f.max() * np.sin(300 * t)}, "no contact"),
        ({"force": f + 0.1 * f.max()}, "take an offset off"),
        ({"force": -f}, "turn its sign"),
        ({"speed": -v}, "turn its sign"),
        ({"speed": 1e3 * v}, "mm/s"),
        ({"time": 1e3 * t}, "milliseconds"),
        ({"force": 1e-6 * f}, "as of a mass of"),
        ({"time": np.zeros(0), "force": np.zeros(0), "speed": np.zeros(0)}, "is empty"),
        ({"time": t[210:], "force": f[210:], "speed": v[210:]}, "begins in contact"),
        ({"force": f + 200.0}, "take an offset off"),
        ({"time": t[:300], "force": f[:300], "speed": v[:300]}, "ends in contact"),
        ({"time": t[::40], "force": f[::40], "speed": v[::40]}, "samples in contact"),
        ({"speed": None}, "one of them"),
    ]
    for changes, message in cases:
        with pytest.raises(InputError, match=message):
            identify(changed(**changes))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"laws": ["Hunt-Crosley"]}, "did you mean 'Hunt-Crossley'"),
        ({"laws": []}, "at least one"),
        ({"laws": "Hertzian"}, "no law 'Hertzian'"),
        ({"laws": None}, "at least one"),
        ({"level": 1.0}, "between 0 and 1"),
        ({"target_mass": 0.0}, "a number > 0"),
    ],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        identify(changed(), **options)


def test_a_single_law_is_no_list_and_a_table_no_log() -> None:
    log = changed()
    (fit,) = identify(log, laws="Kelvin-Voigt").fits
    (same,) = identify(log, laws=KelvinVoigt).fits
    assert fit.name == "Kelvin-Voigt" and fit.law == same.law
    wrong: Any = {"time_s": log.time, "force_N": log.force, "hand_speed_m_s": log.speed}
    with pytest.raises(InputError, match=r"of type dict; give a file, or ImpactLog"):
        identify(wrong)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("time_s,force_N,hand_speed_m_s\n", "no rows"),
        ("time_s,force,hand_speed_m_s\n0,1,2\n", "did you mean 'force'"),
        ("time_s,force_N\n0,1\n", "no column hand_speed_m_s"),
        ("time_s,force_N,hand_speed_m_s\n0,1\n", "line 2: 2 cells under 3"),
        ("time_s,force_N,hand_speed_m_s\n\n0,1,2\n1,many,1\n", "force_N: 'many' in line 4; give a number"),
        ("time_s,force_N,hand_speed_m_s\n0,1,\n", "hand_speed_m_s: '' in line 2"),
        ("time_s;force_N;hand_speed_m_s\n0,5;1,5;2,5\n", "separated by ';'; separate them by commas"),
        ("time_s\tforce_N\n0\t1\n", r"separated by '\\t'"),
        ("time_s,time_s,force_N\n0,0,1\n", "two columns"),
    ],
)
def test_files_that_are_no_logs_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_log(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_log(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="no npz file"):
        read_log(tmp_path / "bad.npz")
    with open(tmp_path / "one.npz", "wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(InputError, match="no npz file"):
        read_log(tmp_path / "one.npz")


def test_an_archive_that_unpacks_to_more_than_a_log_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("impactopt.identification.log.MAX_BYTES", 1 << 26)  # a smaller one is made sooner
    path = tmp_path / "small.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("time_s.npy", "w", force_zip64=True) as entry,
    ):
        for _ in range(5):  # 80 MiB of zeros
            entry.write(bytes(1 << 24))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"small\.npz: no npz file of numbers \(larger than 64 MiB"):
            read_log(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 24
    finally:
        tracemalloc.stop()


def test_a_force_that_is_cut_off_is_left_out_and_told() -> None:
    whole = log_of(TrueBlow("Kelvin-Voigt"), TrueBlow("Kelvin-Voigt", speed=0.5), seed=5)
    level = 0.6 * float(whole.force.max())
    log = dataclasses.replace(whole, force=np.minimum(whole.force, level))
    found = identify(log, laws=["Kelvin-Voigt"])
    lost = int(np.sum(whole.force >= level))
    left_out, other = found.clipped
    assert lost <= left_out < 1.2 * lost and other == 0
    assert f"cut off at {level:.4g} N: {left_out} samples of 1 of 2 impacts" in found.cautions[0]
    for name, true in (("stiffness", 1e5), ("damping", 150.0), ("effective_mass", MASS)):
        estimate = found.best.estimates[name]
        assert estimate.low <= true <= estimate.high, name


def test_a_cut_through_the_noise_of_the_top_is_found_and_does_not_lower_the_estimates() -> None:
    """Noise breaks the flat top up. If just the samples at the cut were left out, those that noise has
    lowered would stay: stiffness and mass would be too small, by three of their standard errors."""
    level, draws = 420.0, 6  # [N]; the true peak is 467 N
    off = []
    for seed in range(draws):
        whole = log_of(TrueBlow("Kelvin-Voigt", mass=MASS), noise=0.05, seed=seed)
        log = dataclasses.replace(whole, force=np.minimum(whole.force, level))
        found = identify(log, laws=["Kelvin-Voigt"])
        assert found.clipped > (0,)
        mass = found.best.effective_mass
        off.append(3.92 * (mass.value - MASS) / (mass.high - mass.low))
    assert abs(np.mean(off)) < 4 / np.sqrt(draws)


@pytest.mark.parametrize("step", [0.0, 0.5, 5.0, 20.0])
def test_neither_a_round_top_nor_a_coarse_converter_is_taken_for_a_cut(step: float) -> None:
    """step : [N] of the converter; the peak is some 500 N."""
    log = log_of(TrueBlow("Kelvin-Voigt"), noise=0.0, rate=3e4)
    force = np.round(log.force / step) * step if step else log.force
    assert identify(dataclasses.replace(log, force=force), laws=["Kelvin-Voigt"]).clipped == (0,)


@pytest.mark.slow
def test_the_round_top_of_a_dense_log_is_not_taken_for_a_cut() -> None:
    """500 samples a millisecond, without noise: near its top the half sine hardly changes."""
    k, begin, period = 1e4, 0.02, np.pi * np.sqrt(MASS / 1e4)
    t = np.arange(0.0, 0.1, 2e-6)
    angle = np.pi * np.clip((t - begin) / period, 0.0, 1.0)
    log = ImpactLog(time=t, force=np.sqrt(k * MASS) * np.sin(angle), speed=np.cos(angle))
    assert identify(log, laws=["Kelvin-Voigt"]).clipped == (0,)


def test_contacts_that_are_too_weak_to_be_fitted_are_told() -> None:
    log = log_of(TrueBlow("Kelvin-Voigt"), TrueBlow("Kelvin-Voigt", speed=0.15), noise=0.002)
    found = identify(log, laws=["Kelvin-Voigt"])
    assert len(found.best.speeds) == 1
    assert found.weak == pytest.approx([0.08], abs=3e-4)
    assert any("1 contact with less than 20 %" in caution and "0.08" in caution for caution in found.cautions)
    assert found.describe()["weak_s"] == list(found.weak)


# ---------------------------------------------------------------- command
def test_the_command_prints_numbers_and_writes_a_section(tmp_path: Path) -> None:
    log, path, out = log_of(TrueBlow("Hunt-Crossley"), seed=3), tmp_path / "blow.csv", tmp_path / "law.toml"
    columns = np.column_stack([log.time, log.force, log.speed])
    np.savetxt(path, columns, delimiter=",", header="time_s,force_N,hand_speed_m_s", comments="")
    words = ["identify", str(path), "--law", "Hunt-Crossley", "--law", "spring damper", "--out", str(out)]
    result = CliRunner().invoke(app, [*words, "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert [law["law"] for law in told["laws"]] == ["Hunt-Crossley", "spring damper"]
    assert told["best"] == "Hunt-Crossley" and told["blows"] == 1
    section = read_toml(out.read_text(encoding="utf-8"))["contact"]
    best = told["laws"][0]["estimates"]
    assert section["law"] == "Hunt-Crossley"
    assert section["dissipation_s_m"] == pytest.approx(best["dissipation"]["value"], rel=1e-4)
    data = {**problem_data(load_problem("arm_planar")), "contact": section}
    law = ProblemFile.from_data(data, tmp_path / "problem.toml").build().law
    assert isinstance(law, HuntCrossley)
    assert law.stiffness == pytest.approx(best["stiffness"]["value"], rel=1e-4)
    shown = CliRunner().invoke(app, words[:4])  # without the other law
    assert shown.exit_code == 0 and "dissipation [s/m]" in shown.stdout and "AIC +0" in shown.stdout


def test_the_command_refuses_in_words(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["identify", str(tmp_path / "none.csv")])
    assert result.exit_code == 2 and "none.csv: cannot be read" in result.stderr
    rough = tmp_path / "rough.toml"
    rough.write_text(
        problem_file("arm_planar").read_text(encoding="utf-8") + "\n[friction]\ncoefficient = 0.6\n",
        encoding="utf-8",
    )
    result = CliRunner().invoke(app, ["identify", str(tmp_path / "none.csv"), "--problem", str(rough)])
    assert result.exit_code == 2 and "[friction]: laws are fitted to impacts without it" in result.stderr
