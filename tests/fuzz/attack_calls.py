"""The public API with odd numbers: NaN in gives NaN or an error out, and no other than an `InputError`."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from fuzz.attack_cases import Found, Generator, attempt, numbers_in, odd_number, pick

Arguments = dict[str, Any]
Call = tuple[Callable[..., Any], Arguments]

NORMAL = np.array([0.0, 0.0, -1.0])


@functools.cache
def _arm() -> Any:
    from impactopt import load_robot

    return load_robot("planar_arm")


@functools.cache
def _model() -> Any:
    from impactopt import SDC, FreeMass, KelvinVoigt

    law = KelvinVoigt(stiffness=1e5, damping=10.0)
    return SDC(robot=_arm(), striker="hammer", normal=NORMAL, law=law, target=FreeMass(mass=1.0))


@functools.cache
def _state() -> tuple[Any, Any, Any]:
    from impactopt import holding_torque, striking_velocity

    q = _arm().posture("ready")
    v = striking_velocity(_arm(), q, "hammer", NORMAL, 1.0)
    return q, v, holding_torque(_arm(), q, v)


def _of(public: str, /, **given: Any) -> Callable[[], Call]:
    """A public name, called with these."""

    def made() -> Call:
        import impactopt

        return getattr(impactopt, public), given

    return made


def _collide(method: str) -> Callable[[], Call]:
    def made() -> Call:
        q, v, torque = _state()
        given: Arguments = {"q": q, "v": v, "torque": torque, "contact_stiffness": 1e5}
        given |= {"contact_damping": 10.0, "target_mass": 1.0, "kp": _arm().kp, "kd": _arm().kd}
        given |= {"torque_limit": _arm().torque_limit, "normal": NORMAL}
        if method == "batch":
            given |= {"q": np.tile(q, (3, 1)), "v": np.tile(v, (3, 1)), "torque": np.tile(torque, (3, 1))}
        return getattr(_model(), method), given

    return made


def _array(value: Any) -> Any:
    """Numbers for a compiled function, which takes nothing else by itself; of what are none, no entries."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        return np.asarray(value, dtype=float)
    return np.zeros(0)


def _compiled() -> Call:
    q, v, torque = _state()
    function = _model().function(
        ("impulse", "duration"), parameters=("contact_stiffness", "kd", "target_mass")
    )

    def call(**given: Any) -> Any:
        known = [_array(given[name]) for name in function.name_in()]
        sizes = [function.size_in(i) for i in range(function.n_in())]
        if any(x.size != a * b for x, (a, b) in zip(known, sizes, strict=True)):
            return np.nan  # CasADi spreads what is too short, and refuses the rest, by itself
        return [np.array(x) for x in function.call([x.ravel() for x in known])]

    inputs = {"q": q, "v": v, "feedforward": torque}
    return call, {**inputs, "contact_stiffness": 1e5, "kd": _arm().kd, "target_mass": 1.0}


def _robot_call(method: str, /, **given: Any) -> Callable[[], Call]:
    return lambda: (getattr(_arm(), method), {k: x() if callable(x) else x for k, x in given.items()})


def _planar_arm() -> Call:
    from impactopt import planar_arm

    given = {"kd": np.array(_arm().kd), "kp": np.array(_arm().kp), "armature": 0.2, "torque_limit": 100.0}
    return planar_arm, {**given, "velocity_limit": 5.0, "position_limit": np.tile([-2.0, 2.0], (3, 1))}


def _problem() -> Call:
    from impactopt import FixedBase, FreeMass, ImpactProblem, KelvinVoigt, Phase

    given: Arguments = {"point": np.array([0.7, 0.0, 0.75]), "normal": NORMAL, "start": "ready"}
    given |= {"contact_duration": (5e-4, 0.015), "smoothness": 1e-3, "wrench_price": 0.0, "return_price": 0.0}
    given |= {
        "collision_elements": ((1.0,), (1.0,)),
        "collision_stages": 2,
        "coefficient_of_restitution": 0.0,
    }
    law, target = KelvinVoigt(stiffness=1e5, damping=10.0), FreeMass(mass=1.0)
    fixed = {"robot": _arm(), "striker": "hammer", "law": law, "target": target, "stance": FixedBase()}
    return functools.partial(
        ImpactProblem, **fixed, swing=Phase(duration=0.5), follow=Phase(duration=0.5)
    ), given


def _with_state(public: str, /, **given: Any) -> Callable[[], Call]:
    def made() -> Call:
        import impactopt

        q, v, _ = _state()
        states = {"q": q, "v": v}
        return functools.partial(getattr(impactopt, public), _arm()), {
            k: states.get(x, x) if isinstance(x, str) else x for k, x in given.items()
        }

    return made


def _effective_mass() -> Call:
    from impactopt import effective_mass

    def call(q: Any, normal: Any) -> Any:
        function = effective_mass(_arm(), striker="hammer", normal=normal)
        x = _array(q)
        return np.array(function(x)) if x.shape == (3,) else np.nan

    return call, {"q": _state()[0], "normal": NORMAL}


def _collide_many() -> Call:
    from impactopt import collide_many

    def call(**columns: Any) -> Any:
        at_contact = {"speed_m_s": 1.0, "posture": "ready"}
        given = {key.replace("__", "."): x for key, x in columns.items()}
        found = collide_many("arm_planar", given, at_contact=at_contact)
        return {name: x for name, x in found.items() if name != "reason"}

    return call, {"contact__stiffness": np.array([1e5, 1e6]), "target__mass": np.array([0.1, 0.2])}


_TOOL = {"center": np.zeros(3), "inertia": np.full(3, 1e-3), "head": np.array([0.0, 0.0, 0.1])}
_SQUARE = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
CALLS: dict[str, Callable[[], Call]] = {
    "SpringDamper": _of("SpringDamper", stiffness=1e4, damping=10.0),
    "KelvinVoigt": _of("KelvinVoigt", stiffness=1e4, damping=10.0),
    "HuntCrossley": _of("HuntCrossley", stiffness=1e6, dissipation=0.3, exponent=1.5),
    "HertzDamped": _of("HertzDamped", stiffness=1e6, damping=0.3),
    "FreeMass": _of("FreeMass", mass=1.0),
    "Nail": _of("Nail", mass=0.1, resistance=500.0, hardening=1e4, depth=0.01),
    "Board": _of("Board", mass=0.5, stiffness=1e5, breaking_force=400.0, damping=20.0),
    "Tool": _of("Tool", name="t", frame="wrist", mass=1.0, **_TOOL),
    "Striker": _of("Striker", name="s", frame="wrist", point=np.zeros(3)),
    "Sole": _of("Sole", name="s", frame="wrist", polygon=_SQUARE),
    "Perturbation": _of(
        "Perturbation", mass=1.0, distance=0.01, payload=0.5, friction=0.9, kp=1.0, delay=1e-3
    ),
    "draw_perturbations": _of("draw_perturbations", n=5, seed=1),
    "PerturbationRanges": _of(
        "PerturbationRanges", mass=(0.5, 2.0), distance=(-0.02, 0.02), payload=(0.0, 1.0), period=1e-3
    ),
    "Phase": _of("Phase", duration=(0.4, 0.8), intervals=12, grading=3.0),
    "Scenario": _of("Scenario", name="s", mass=2.0, stiffness=1.0, torque=1.0, capture_margin=0.01),
    "Obstacle": _of(
        "Obstacle", name="o", size=(0.1, 0.1, 0.1), position=(1.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)
    ),
    "TargetBody": _of("TargetBody", shape="box", size=(0.1, 0.1, 0.1)),
    "JointFriction": _of("JointFriction", viscous=1.0, coulomb=np.ones(3), transition=0.01),
    "OneSole": _of("OneSole", name="left", base_mass=1e5, base_inertia=1e5),
    "TorqueLimit": _of("TorqueLimit", fraction=0.8, collision=0.8),
    "VelocityLimit": _of("VelocityLimit", fraction=0.8),
    "PositionLimit": _of("PositionLimit", margin=0.02),
    "ContactWrenchCone": _of("ContactWrenchCone", friction=0.6, margin=0.02, minimum_force=50.0),
    "Balance": _of("Balance", capture_margin=0.02, vertical_speed=0.2, angular_momentum=10.0),
    "Incidence": _of("Incidence", speed=0.05),
    "LegExtension": _of("LegExtension", minimum=0.35),
    "KeepOut": _of("KeepOut", margin=0.01),
    "SelfCollision": _of("SelfCollision", margin=0.01),
    "TorqueRate": _of("TorqueRate", limit=100.0),
    "HandOrientation": _of("HandOrientation", axis=(1.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0), angle=0.2),
    "Gaze": _of("Gaze", frame="wrist", axis=(1.0, 0.0, 0.0), angle=0.2, since=0.5),
    "HitRegion": _of("HitRegion", size=(0.1, 0.1)),
    "Slide": _of("Slide", most=0.1),
    "ReferenceRange": _of("ReferenceRange", margin=0.1),
    "Grip": _of("Grip", force=150.0, moment=10.0),
    "SecondStriker": _of("SecondStriker", striker="hand", point=(0.5, 0.0, 1.0)),
    "TargetSpeed": _of("TargetSpeed", least=0.5, most=3.0),
    "HitCone": _of("HitCone", angle=0.1),
    "Impulse": _of("Impulse", weight=1.0),
    "PeakForce": _of("PeakForce", weight=1.0),
    "Penetration": _of("Penetration", weight=1.0),
    "Effort": _of("Effort", weight=1.0),
    "SDC.collide": _collide("collide"),
    "SDC.batch": _collide("batch"),
    "SDC.function": _compiled,
    "Robot.check_velocity": _robot_call("check_velocity", v=np.zeros(3)),
    "Robot.check_limits": _robot_call("check_limits", q=np.zeros(3)),
    "Robot.joint_positions": _robot_call("joint_positions", q=np.zeros(3)),
    "planar_arm": _planar_arm,
    "ImpactProblem": _problem,
    "striking_velocity": _with_state("striking_velocity", q="q", striker="hammer", normal=NORMAL, speed=1.0),
    "holding_torque": _with_state("holding_torque", q="q", v="v"),
    "effective_mass": _effective_mass,
    "collide_many": _collide_many,
}


def attack_call(rng: Generator) -> Found:
    """One call with one or two odd arguments."""
    name = str(pick(rng, list(CALLS)))
    function, right = CALLS[name]()
    given = dict(right)
    for key in rng.permutation(list(given))[: rng.integers(1, 3)]:
        given[str(key)] = _odd(right[str(key)], rng)
    case = f"{name}({', '.join(f'{k}={x!r}' for k, x in given.items())})"

    def work() -> str:
        with np.errstate(all="ignore"):
            return _judged(function(**given), given, name)

    return attempt("call", case[:2000], work)


def _odd(value: Any, rng: Generator) -> Any:
    kind = rng.integers(8)
    if kind == 0:
        return pick(
            rng,
            ("x", None, [], {}, [None], b"1", "nan", object(), 1j, True, [[1.0], [1.0, 2.0]], np.array("x")),
        )
    array = np.array(value, dtype=float) if not isinstance(value, str) else np.array(1.0)
    if kind == 1:
        return array[..., None]
    if kind == 2:
        return array.reshape(-1)[:-1]
    if kind == 3:
        return np.full(tuple(rng.integers(0, 5, int(rng.integers(0, 4)))), odd_number(rng))
    if kind == 4:
        return array * odd_number(rng)
    if kind == 5:
        return int(rng.choice([-1, 0, 1, 2**31, 2**62])) * 10 ** int(rng.choice([0, 0, 30]))
    made = array.copy()
    if made.ndim == 0:
        return odd_number(rng, float(made))
    made.reshape(-1)[int(rng.integers(made.size))] = odd_number(rng)
    return made


def _judged(result: Any, given: Arguments, name: str) -> str:
    """NaN that went in and is not in what came out; a number without end that came out of numbers."""
    spoiled = any(np.isnan(x) for _, x in numbers_in(given))
    found = [x for _, x in numbers_in(_plain(result))]
    lost = bool(found) and not any(np.isnan(x) for x in found)
    if spoiled and lost and name not in ("Robot.joint_positions",):
        return "NaN in, numbers out"
    finite = all(np.isfinite(x) for _, x in numbers_in(given))
    if finite and name in _RESULTS and not all(np.isfinite(x) for x in found):
        return "numbers in, none out"
    return ""


_RESULTS = ("SDC.collide", "striking_velocity", "holding_torque")


def _plain(result: Any) -> Any:
    """Of a collision without the zero-moment point, and of robots and problems what is numbers."""
    from impactopt import Robot

    if isinstance(result, Robot):
        return [result.kp, result.kd, result.torque_limit, result.velocity_limit, result.lower, result.upper]
    return result
