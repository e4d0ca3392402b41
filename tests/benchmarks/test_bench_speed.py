"""Batches and descriptions of collisions, and the benches of speed: what they give, not how fast."""

from __future__ import annotations

import json
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from support import small_robots
from support.native_cases import FRICTION, LAW, TARGET, sdc, situation
from support.picture_checks import frowns

from benchmarks import clock, collision, scaling, skip
from benchmarks.cases import Case
from benchmarks.pictures.pareto import front, pareto_picture
from benchmarks.pictures.scaling import scaling_picture
from benchmarks.pictures.skip import skip_picture
from benchmarks.registry import run_bench
from benchmarks.setup import Setup
from impactopt import SDC, Effects, InputError, VirtualMass, standin
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.graph import independent_joints
from impactopt.report.pictures.style import STYLE

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
    model = sdc("arm", effects=Effects(friction=True), friction=FRICTION)
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
        robot=small_robots.slider(3.0),
        striker="tip",
        normal=X,
        law=LAW,
        target=TARGET,
        effects=Effects.none(),
    )
    q, v = np.zeros((2, 1)), np.array([[1.0], [2.0]])
    found = model.batch(q, v, outputs=("impulse", "force"))
    # the error that a step of SciPy's integrator may have: `collide` also samples the contact, in other steps
    assert found["impulse"][0] == pytest.approx(model.collide(q[0], v[0]).impulse, rel=1e-10)
    assert found["impulse"][1] > found["impulse"][0]


# ---------------------------------------------------------------- descriptions
def test_a_description_says_what_is_in_and_what_is_not() -> None:
    model = sdc("biped", effects=Effects(saturation=False, bias=False))
    told = model.describe(("impulse", "zmp"), parameters=("kd",))
    numbers = told.as_dict()
    assert numbers["effects"] == ["damping", "stiffness", "feedforward", "jdot"]
    assert len(numbers["held"]) == 2 and numbers["inputs"] == ["q", "v", "feedforward", "kd"]
    assert {"saturation", "bias", "friction", "peak force", "derivatives"} <= {*numbers["left_out"]}
    assert not {"stiffness", "histories", "wrenches and ZMP"} & {*numbers["left_out"]}
    assert "effects.saturation is off" in str(told) and "zmp" in str(told)
    json.dumps(numbers)


def test_what_is_left_out_is_not_computed() -> None:
    lean = sdc("biped", effects=Effects.none()).describe(("impulse",)).as_dict()["instructions"]
    full = sdc("biped", effects=Effects(friction=True), friction=FRICTION)
    rich = full.describe(full.available).as_dict()["instructions"]
    # of a Runge-Kutta step the four products with A stay
    assert lean["freeze"] < 0.9 * rich["freeze"] and lean["step"] < 0.7 * rich["step"]


def test_a_point_mass_has_no_servo() -> None:
    numbers = sdc("arm", VirtualMass).describe().as_dict()
    assert numbers["effects"] == [] and "servo" in numbers["left_out"]
    with pytest.raises(InputError, match="point mass"):
        sdc("arm", VirtualMass).describe(("torque",))


@pytest.mark.slow
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


# ---------------------------------------------------------------- benches
def quiet(_text: str) -> None:
    pass


@pytest.fixture(scope="module")
def setup() -> Setup:
    """A small arm's blow: the benches take any."""
    model = sdc("arm")
    q, v, torque = situation("arm", model, seed=3)[:3]
    case = Case(
        robot=model.robot,
        name="blow",
        striker="hand",
        normal=X,
        q=q,
        v=v,
        torque=0.2 * torque,
        effective_mass=np.nan,
        speed=1.5,
    )
    return Setup(name="arm", case=case, law=LAW, target=TARGET, horizon=0.05)


def test_what_is_timed_in_turns_keeps_its_ratio() -> None:
    found = clock.medians({"one": lambda: sum(range(2000)), "ten": lambda: sum(range(20000))}, repeats=5)
    assert 4 < found["ten"] / found["one"] < 25


def test_what_takes_long_is_timed_less() -> None:
    calls: list[int] = []
    clock.medians({"slow": lambda: calls.append(sum(range(200_000)))}, repeats=50, longest=0.0)
    assert len(calls) == 2 + 3


@pytest.mark.slow
@compiled
def test_the_bench_of_collisions_has_each_method_and_the_default_s_ratios(setup: Setup) -> None:
    numbers = collision.run(quiet, setups=[setup], quick=True, repeats=3).numbers
    rows = {(r["method"], r["setting"]): r for r in numbers["rows"]}
    keys = {"robot", "method", "setting", "time_us", "note", *collision.KEYS}
    assert all({*r} == keys for r in rows.values())
    error = {method: rows[method, setting]["impulse_error_pct"] for method, setting in rows}
    # the same frozen collision, integrated by others
    for method in ("exact", "sdc, CasADi's C", "CVODES by CasADi"):
        assert error[method] == pytest.approx(error["sdc"], abs=1e-3)
    assert abs(error["sdc, 2 freezes"]) < abs(error["sdc"]) < abs(error["virtual mass"])
    assert abs(error["Pinocchio, loop in Python"]) < 1e-3 and abs(error["MuJoCo, loop in Python"]) < 2.0
    assert error["MuJoCo, steps alone"] is None and rows["MuJoCo, steps alone", "0.0001 s"]["note"]
    default = numbers["default"]
    assert default["integration_error"] < 1e-6
    assert default["time_us"] == rows[collision.DEFAULT]["time_us"]
    assert default["speedup_vs_mujoco_1e-4"] > default["speedup_vs_mujoco_1e-4_steps_alone"] > 1
    assert {"speedup_vs_paper_rk4_1e-4", "gradient_cost_ratio", "impacts_per_second_2_cores"} <= {*default}
    assert json.dumps(numbers)


def test_a_front_is_of_what_nothing_beats() -> None:
    pairs = [(1.0, -5.0), (2.0, 6.0), (3.0, 1.0), (4.0, -1.0), (5.0, 0.1)]
    rows = [
        {"robot": "r", "method": "sdc", "time_us": t, "impulse_error_pct": e, "setting": ""} for t, e in pairs
    ]
    assert [r["time_us"] for r in front(rows)] == [1.0, 3.0, 5.0]
    (axes,) = pareto_picture([*rows, {**rows[0], "time_us": 9.0, "impulse_error_pct": 1e-7}]).axes
    assert min(axes.lines[0].get_ydata()) == 0.1, "no line goes down to what is exact"


@compiled
def test_a_step_that_is_unstable_has_a_row_that_says_so(setup: Setup) -> None:
    from benchmarks import methods

    found, refused = [], []
    maker = methods._ours(setup, quiet, found, refused)
    maker("sdc", "0.01 s", lambda: setup.model(SDC, method="rk4", step=0.01, kd=1e3))
    assert not found and "unstable" in refused[0]["note"]


@pytest.mark.slow
@compiled
def test_the_bench_of_skipping_says_what_each_saves(setup: Setup) -> None:
    numbers = skip.run(quiet, setup=setup, repeats=3).numbers
    rows = {r["skipped"]: r for r in numbers["rows"]}
    whole = rows["everything"]
    assert whole["speedup"] == 1.0
    for name in ("friction", "saturation", "bias and Jdot", "all but the impulse", "constant parameters"):
        assert rows[name]["instructions"] < whole["instructions"], name
    assert rows["histories"]["speedup"] > 1
    assert len(skip_picture(list(rows.values())).axes) == 2


def test_joints_that_are_locked_keep_their_places() -> None:
    robot = standin()
    q, v = robot.posture("half_sitting"), np.arange(float(robot.nv))
    case = Case(
        robot=robot,
        name="x",
        striker="right_hand",
        normal=X,
        q=q,
        v=v,
        torque=np.arange(float(robot.n)),
        effective_mass=1.0,
        speed=1.0,
    )
    less, small = skip.locked(case, ["left_knee", "head_yaw"], floating=True)
    assert small.n == robot.n - 2
    for name in small.joint_names:
        k = robot.joint_index(name)
        assert less.torque[small.joint_index(name)] == k and less.v[6 + small.joint_index(name)] == 6 + k
        assert small.joint_positions(less.q)[small.joint_index(name)] == robot.joint_positions(q)[k]


@pytest.mark.slow
@compiled
def test_the_bench_of_scaling_goes_over_joints_steps_and_batches(
    setup: Setup, monkeypatch: pytest.MonkeyPatch
) -> None:
    def timed(runs: dict[str, Any], **options: Any) -> dict[str, float]:
        """A collision takes twice the time of freezing: a busy machine may make a difference negative."""
        found = clock.shortest(runs, **options)
        return found | {name: 2 * found[f"{name} frozen"] for name in runs if f"{name} frozen" in runs}

    monkeypatch.setattr(scaling, "shortest", timed)
    numbers = scaling.run(
        quiet,
        chains=(2, 4),
        trees=(8,),
        humanoids=(),
        setup=setup,
        steps=(2.5e-4,),
        tolerances=(1e-3, 1e-7),
        batches=(1, 20),
        workers=1,
        repeats=3,
    ).numbers
    rows = numbers["rows"]
    assert {r["over"] for r in rows} == {"dof", "step", "batch"}
    dof = [r for r in rows if r["over"] == "dof"]
    assert [(r["robot"], r["n"]) for r in dof] == [("chain", 2), ("chain", 4), ("tree", 8)]
    for r in dof:
        assert r["freeze_us"] > 0 and r["time_us"] > 0  # which is longer, a busy machine may turn round
    assert dof[0]["stage_us"] is None and dof[2]["stage_us"] > 0 and dof[2]["loop_us"] > 0
    assert dof[1]["paper_once"] > dof[0]["paper_once"]
    errors = {(r["method"], r["tolerance"]): r["integration_error"] for r in rows if r["over"] == "step"}
    assert errors["rk4", None] < 1e-3
    assert errors["implicit", 1e-7] < 1e-4 and [r["default"] for r in rows if "default" in r].count(True) == 1


def test_the_humanoids_of_scaling_strike_with_their_hand() -> None:
    setups = scaling.humanoid_setups(scaling.HUMANOIDS, quiet)
    assert [setup.name for setup in setups] == list(scaling.HUMANOIDS)
    for setup in setups:
        assert len(setup.case.robot.soles) == 2 and setup.case.striker == "right_hand"
    assert scaling.humanoid_setups(("no such robot",), quiet) == []


def test_a_hand_that_goes_away_is_frozen_and_no_more() -> None:
    for one in (scaling.tip_setup("chain", 4), scaling.tip_setup("tree", 8)):
        model = one.model(SDC)
        case = scaling.parted(one.case)
        away = model.collide(case.q, case.v, case.torque)
        assert away.impulse == away.duration == 0.0
        hit = model.collide(one.case.q, one.case.v, one.case.torque)
        assert hit.impulse > 0.1 and hit.duration < 0.05


def made_up(kind: str, n: int, power: float) -> dict[str, Any]:
    time = 1e-3 * n**power
    counts = {"paper_once": 15.0 * n**3, "paper_stage": 2.0 * n**2}
    times = {
        "time_us": 3 * time,
        "freeze_us": time,
        "loop_us": 2 * time,
        "stage_us": time if n < 64 else None,
    }
    return {"over": "dof", "robot": kind, "n": n, **times, **counts}


def test_exponents_are_those_of_the_upper_half() -> None:
    # below 20 joints all costs the same
    rows = [made_up("chain", n, 2.5 if n > 20 else 0.0) for n in (2, 4, 8, 32, 64, 100)]
    found = {r["part"]: r for r in scaling.exponents(rows)}
    assert found["a stage"]["from"] == 8 and found["a stage"]["to"] == 32  # it is not measured beyond
    for part, paper in (("freeze", 3.0), ("time loop", 2.0)):
        assert found[part]["exponent"] == pytest.approx(2.5) and found[part]["paper"] == pytest.approx(paper)
        assert found[part]["from"] == 32 and found[part]["to"] == 100
    assert scaling.exponents(rows[:1]) == []


@pytest.mark.slow
def test_legends_of_scaling_leave_the_data_free() -> None:
    rows = [made_up("chain", n, 2.6) for n in (2, 8, 32, 100)] + [made_up("tree", n, 2.1) for n in (8, 100)]
    rows += [made_up(name, n, 2.3) for name, n in (("standin", 28), ("talos", 30), ("g1", 29))]
    powers = scaling.exponents(rows)
    for step in (1e-5, 1e-4, 5e-4):
        row = {"over": "step", "robot": "standin", "method": "rk4", "step_s": step, "tolerance": None}
        row |= {"time_us": 2.0 / step / 100, "integration_error": 10 * step**2, "default": False}
        rows.append(row | {"paper_operations": 1e3 / step})
    for tolerance in (1e-4, 1e-6, 1e-10):
        row = {"over": "step", "robot": "standin", "method": "implicit", "step_s": None, "time_us": 25.0}
        row |= {"tolerance": tolerance, "default": tolerance == 1e-6, "integration_error": tolerance / 100}
        rows.append(row)
    for size in (1, 10, 100, 1000):
        for threads in (1, 2):
            rate = 4e4 * threads * size / (size + 10)
            rows.append({"over": "batch", "batch": size, "threads": threads, "impacts_per_second": rate})
    with matplotlib.rc_context(STYLE):
        figure = scaling_picture(rows, powers)
        FigureCanvasAgg(figure).draw()
    assert len(figure.axes) == 6 and frowns(figure) == []
    for axes in figure.axes:
        box = axes.get_legend().get_window_extent()
        for line in axes.get_lines():
            points = line.get_transform().transform(np.column_stack(line.get_data()))
            assert not any(box.contains(x, y) for x, y in points), (axes.get_title("left"), line.get_label())


@pytest.mark.parametrize("name", ["collision", "scaling", "skip"])
def test_the_benches_are_among_all(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.report import Report

    module = {"collision": collision, "scaling": scaling, "skip": skip}[name]
    monkeypatch.setattr(module, "run", lambda _say, **_options: Report(name=name, numbers={"rows": []}))
    assert run_bench(name, quiet).name == name
