"""Targets against closed forms, an independent integration, balances and differences.

The reference shares no code with the package: the equations are written out again, and SciPy locates the
events. The robot is one mass on a rail, with no servo to speak of.
"""

import dataclasses
import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.frozen_cases import X, slider

from impactopt import (
    SDC,
    Board,
    FreeMass,
    HuntCrossley,
    InputError,
    KelvinVoigt,
    Nail,
    RigidWall,
    SpringDamper,
    Target,
)

pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")

TARGETS = {
    "mass": FreeMass(mass=2.0),
    "wall": RigidWall(),
    "nail": Nail(mass=0.2, resistance=300.0, hardening=2e4, depth=0.01),
    "board": Board(mass=0.5, stiffness=2e4, breaking_force=400.0, damping=5.0),
}


@pytest.fixture(autouse=True)
def _virtual_machine(monkeypatch):
    """The graphs are tested as they are; compiling them is another test file's subject."""
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")


def made(law, target, *, hammer=1.0, **options):
    return SDC(
        robot=slider(hammer), striker="tip", normal=X, law=law, target=target, **{"horizon": 0.1, **options}
    )


def outcome(sdc, speed):
    """(impulse, duration, energy, result) of a blow."""
    function = sdc.function(("impulse", "duration", "energy", "target_result"))
    return [float(x) for x in function([0.0], [speed], [0.0])]


# ------------------------------------------------------------ what holds for every target
def states(target):
    """States and forces on both sides of all switches."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        yield rng.uniform([-0.01, 0.0], [2.0, 0.04])[: target.n_states], rng.uniform(0.0, 1500.0)
    yield np.zeros(target.n_states), 0.0
    yield np.zeros(target.n_states), 1e3


def everything(target, state, force, parameters=None):
    return [
        *target.derivative(state, force, parameters),
        target.velocity(state, parameters),
        target.energy(state, parameters),
        *target.switches(state, force, parameters),
        *target.result(state, parameters),
    ]


@pytest.mark.parametrize("name", TARGETS)
def test_targets_give_the_same_in_numbers_arrays_and_symbols(name):
    target = TARGETS[name]
    z, f = ca.SX.sym("z", target.n_states), ca.SX.sym("f")
    numbers = {key: ca.SX.sym(key) for key in target.parameters}
    whole = everything(target, [z[i] for i in range(target.n_states)], f, numbers)
    function = ca.Function("all", [z, f, *numbers.values()], [ca.vertcat(*whole)])
    instants = list(states(target))
    rows = np.array([state for state, _ in instants]).reshape(len(instants), -1).T
    columns = everything(target, list(rows), np.array([force for _, force in instants]))
    for i, (state, force) in enumerate(instants):
        by_numbers = np.array(everything(target, [float(x) for x in state], force), dtype=float)
        by_symbols = np.array(function(state, force, *target.parameters.values())).ravel()
        by_arrays = [np.broadcast_to(column, len(instants))[i] for column in columns]
        np.testing.assert_allclose(by_symbols, by_numbers, rtol=1e-12)
        np.testing.assert_allclose(by_arrays, by_numbers, rtol=1e-12)
        assert len(target.derivative(state, force)) == target.n_states
        assert len(target.result(state)) == len(target.results)


@pytest.mark.parametrize("name", TARGETS)
def test_energy_grows_by_the_power_of_the_force(name):
    """But for what the board's own damping takes."""
    target = TARGETS[name]
    if name == "board":
        target = dataclasses.replace(target, damping=0.0)
    z = ca.SX.sym("z", target.n_states)
    slope = ca.Function(
        "slope", [z], [ca.gradient(ca.SX(target.energy([z[i] for i in range(z.numel())])), z)]
    )
    for state, force in states(target):
        rate = np.array(target.derivative(list(state), force), dtype=float)
        power = float(np.array(slope(state)).ravel() @ rate)
        expected = force * float(target.velocity(list(state)))
        if name == "nail" and state[0] < 0:
            expected = 0.0  # it stands
        assert power == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", TARGETS)
def test_targets_are_at_rest_at_first_and_have_brought_nothing(name):
    target = TARGETS[name]
    rest = [0.0] * target.n_states
    assert target.velocity(rest) == 0.0 and target.energy(rest) == 0.0
    assert [float(x) for x in target.result(rest)] == [0.0] * len(target.results)
    assert target.derivative(rest, 0.0) == rest


def test_formulas_tell_targets_apart_but_not_their_numbers():
    formulas = {target.formula() for target in TARGETS.values()}
    assert len(formulas) == len(TARGETS)
    assert Nail(mass=1.0, resistance=2.0).formula() == TARGETS["nail"].formula()

    class Watched(FreeMass):
        def result(self, state, parameters=None):
            return [state[0] * (1 + 1e-12)]

    class Renamed(FreeMass):
        results = ("swiftness",)

    class Sledge(FreeMass):
        def tangential_mass(self, parameters=None):
            return 2.0 * super().tangential_mass(parameters)

    class Swung(FreeMass):
        def speed_before(self, parameters=None):
            return 0.5 * super().speed_before(parameters)

    formulas |= {kind(mass=1.0).formula() for kind in (Watched, Renamed, Sledge, Swung)}
    assert len(formulas) == len(TARGETS) + 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sprung(Target):
    """A mass on a spring, whose methods the cases below replace."""

    mass: float
    stiffness: float

    n_states = 2
    results = ("speed",)

    def velocity(self, state, parameters=None):
        return state[0]

    def derivative(self, state, force, parameters=None):
        p = parameters or self.parameters
        return [(force - p["stiffness"] * state[1]) / p["mass"], state[0]]

    def energy(self, state, parameters=None):
        p = parameters or self.parameters
        return 0.5 * (p["mass"] * state[0] ** 2 + p["stiffness"] * state[1] ** 2)

    def result(self, state, parameters=None):
        return [state[0]]


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"derivative": lambda t, z, f, p=None: [f / p["mass"]]}, "derivative.* gives 1 .*give a list of 2"),
        (
            {"derivative": lambda t, z, f, p=None: f / p["mass"]},
            "derivative.* gives no list; give a list of 2",
        ),
        ({"result": Target.result}, "result.* gives 0 expressions; give a list of 1: speed"),
        ({"result": lambda t, z, p=None: z[0]}, "result.* gives no list; give a list of 1: speed"),
        ({"velocity": lambda t, z, p=None: z}, "velocity.* gives a list; give one expression"),
        ({"velocity": lambda t, z, p=None: ca.vertcat(*z)}, "velocity.* gives 2 expressions; give one"),
        ({"energy": lambda t, z, p=None: None}, "energy.* gives nothing; give one expression"),
        ({"energy": lambda t, z, p=None: max(z[0], 0.0)}, "as energy.*casadi.fmax"),
        ({"energy": lambda t, z, p=None: t.mass * z[0] ** 2}, "do not have mass from .*`parameters`"),
        ({"typical": (1.0,)}, "typical has 1 numbers"),
        ({"typical": (1.0, float("nan"))}, "typical: nan at index 1"),
        ({"typical": (1.0, 0.0)}, r"typical is \(1.0, 0.0\); give numbers > 0"),
        ({"n_states": 2.0}, "n_states is 2.0; give the size of the state, a whole number"),
        (
            {"results": ("speed", "speed"), "result": lambda t, z, p=None: [z[0], z[1]]},
            "results has a name twice: speed, speed",
        ),
        ({"result": lambda t, z, p=None: [math.hypot(z[0], z[1])]}, "has NaN in its expression"),
        ({"switches": lambda t, z, f, p=None: f}, "switches.* cannot be called"),
        ({"tangential_mass": lambda t, p=None: max(p["mass"], 1.0)}, "tangential_mass.*casadi.fmax"),
    ],
)
def test_a_target_whose_methods_give_what_they_should_not_is_refused_when_it_is_made(changes, message):
    assert Sprung(mass=1.0, stiffness=2.0).derivative([0.5, 1.0], 3.0) == [1.0, 0.5]
    with pytest.raises(InputError, match=f"Own.*{message}"):
        type("Own", (Sprung,), changes)(mass=1.0, stiffness=2.0)


@pytest.mark.parametrize("mass", ["1.0", float("nan"), [1.0, 2.0]])
def test_numbers_without_metadata_are_checked(mass):
    """Text was taken as a number until it was compiled."""
    with pytest.raises(InputError, match="Sprung: mass: "):
        Sprung(mass=mass, stiffness=2.0)


def test_a_targets_methods_are_checked_once_for_each_class():
    calls = []

    class Counted(FreeMass):
        def energy(self, state, parameters=None):
            calls.append(self)
            return super().energy(state, parameters)

    Counted(mass=1.0)
    checked = len(calls)
    assert checked
    Counted(mass=2.0)
    assert len(calls) == checked


def test_a_target_without_switches_and_results_has_none():
    assert Target.switches(TARGETS["mass"], [0.0], 1.0) == []
    assert Target.result(TARGETS["wall"], []) == []
    assert TARGETS["mass"].result([3.0]) == [3.0]


# ------------------------------------------------------------ wall
@pytest.mark.parametrize("method", ["implicit", "rk4"])
def test_a_wall_gives_all_of_the_hammers_momentum_back_in_closed_form(method):
    """Half a period of a mass on a spring; and Kelvin-Voigt's restitution."""
    hammer, stiffness, speed = 2.0, 1e4, 0.8
    step = {"step": 1e-5 if method == "rk4" else 2.5e-4}
    spring = made(
        SpringDamper(stiffness=stiffness, damping=0.0), RigidWall(), hammer=hammer, method=method, **step
    )
    outputs = ("impulse", "duration", "energy", "peak_force")
    impulse, duration, energy, peak = (float(x) for x in spring.function(outputs)([0.0], [speed], [0.0]))
    assert impulse == pytest.approx(2 * hammer * speed, rel=1e-7)
    late = step["step"] * (1.0 if method == "rk4" else 1e-5)  # a fixed step ends after separation
    assert duration == pytest.approx(np.pi * np.sqrt(hammer / stiffness), abs=late + 1e-9)
    assert energy == 0.0
    assert peak == pytest.approx(speed * np.sqrt(stiffness * hammer), rel=1e-3)
    zeta = 0.2
    law = KelvinVoigt(stiffness=stiffness, damping=2 * zeta * np.sqrt(stiffness * hammer))
    e = np.exp(-2 * zeta * np.arccos(zeta) / np.sqrt(1 - zeta**2))
    damped = made(law, RigidWall(), hammer=hammer, method=method, **step)
    found = float(damped.function(("impulse",))([0.0], [speed], [0.0]))
    assert found == pytest.approx((1 + e) * hammer * speed, rel=1e-6)


def test_a_heavy_free_mass_is_nearly_a_wall():
    law = SpringDamper(stiffness=1e4, damping=100.0)
    wall = made(law, RigidWall()).function(("impulse",))([0.0], [1.0], [0.0])
    mass = made(law, FreeMass(mass=1e7)).function(("impulse",))([0.0], [1.0], [0.0])
    assert float(mass) == pytest.approx(float(wall), rel=1e-6)


# ------------------------------------------------------------ nail
def nailing(hammer, speed, law, nail):
    """By SciPy, phase by phase: impulse, duration, v and z at separation, number of phases."""
    k, d = law.stiffness, law.damping

    def wood(z):
        return nail.resistance + nail.hardening * (nail.depth + z)

    def force(y, compressing):
        return k * y[1] + (d * (y[0] - y[2]) if compressing else 0.0)

    y, t, phases = np.array([speed, 0.0, 0.0, 0.0, 0.0]), 0.0, 0
    compressing, moving = True, d * speed > wood(0.0)
    while True:
        phases += 1

        def flow(t, y, c=compressing, m=moving):
            f = force(y, c)
            a = (f - wood(y[3])) / nail.mass if m else 0.0
            return [-f / hammer, y[0] - y[2], a, y[2], f]

        def turning(t, y, c=compressing):
            return y[0] - y[2] if c else y[2] - y[0]

        def leaving(t, y, c=compressing):
            return 1.0 if c else y[1]

        def sticking(t, y, c=compressing, m=moving):
            return y[2] if m else wood(y[3]) - force(y, c)

        events = [turning, leaving, sticking]
        for event in events:
            event.terminal, event.direction = True, -1.0
        run = solve_ivp(flow, (t, t + 1), y, method="DOP853", rtol=1e-11, atol=1e-13, events=events)
        t, y = run.t[-1], run.y[:, -1].copy()
        first = next(i for i, hits in enumerate(run.t_events) if len(hits))
        if first == 1:
            return y[4], t, y[2], y[3], phases
        if first == 0:
            compressing = not compressing
        else:
            moving = not moving
            y[2] = y[2] if moving else 0.0


def coasting(nail, v, z):
    """Depth at which the nail has stopped, by SciPy."""

    def stopped(t, y):
        return y[0]

    stopped.terminal, stopped.direction = True, -1.0
    if v <= 0:
        return z

    def flow(t, y):
        return [-(nail.resistance + nail.hardening * (nail.depth + y[1])) / nail.mass, y[0]]

    return solve_ivp(flow, (0, 10), [v, z], rtol=1e-11, atol=1e-13, events=stopped).y[1, -1]


BLOWS = {
    "light nail": (1.0, 2.0, SpringDamper(stiffness=1e5, damping=50.0), {"mass": 0.02, "resistance": 300.0}),
    "hardening": (
        1.0,
        2.0,
        SpringDamper(stiffness=1e5, damping=50.0),
        {"mass": 0.02, "resistance": 300.0, "hardening": 2e4, "depth": 0.01},
    ),
    "at once": (1.0, 2.0, SpringDamper(stiffness=1e5, damping=300.0), {"mass": 0.2, "resistance": 300.0}),
    "stops and starts": (
        0.5,
        1.0,
        SpringDamper(stiffness=1e6, damping=100.0),
        {"mass": 0.01, "resistance": 500.0, "hardening": 1e4},
    ),
    "flies ahead": (2.0, 1.0, SpringDamper(stiffness=1e5, damping=0.0), {"mass": 0.5, "resistance": 50.0}),
    "stuck": (1.0, 0.5, SpringDamper(stiffness=1e4, damping=30.0), {"mass": 0.05, "resistance": 2000.0}),
}


@pytest.mark.parametrize("blow", BLOWS)
def test_nails_against_an_independent_integration(blow):
    hammer, speed, law, numbers = BLOWS[blow]
    nail = Nail(**numbers)
    impulse, duration, v, z, phases = nailing(hammer, speed, law, nail)
    assert phases > 5 or blow != "stops and starts"
    assert (z == 0.0) == (blow == "stuck")
    assert (v > 0) == (blow == "flies ahead")
    found = outcome(made(law, nail, hammer=hammer, step=5e-5), speed)
    assert found[0] == pytest.approx(impulse, rel=1e-7)
    assert found[1] == pytest.approx(duration, rel=1e-6)
    assert found[3] == pytest.approx(coasting(nail, v, z), rel=1e-6, abs=1e-12)
    plain = outcome(made(law, nail, hammer=hammer, method="rk4", step=1e-5, horizon=0.04), speed)
    assert plain[0] == pytest.approx(impulse, rel=1e-5)
    assert plain[3] == pytest.approx(coasting(nail, v, z), rel=2e-4, abs=1e-12)


def test_a_nail_that_never_stops_in_contact_in_closed_form():
    """While both move: mu x'' = -k x + mu R / m, about a middle that the wood has moved."""
    M, m, k, R, speed = 2.0, 0.5, 1e5, 50.0, 1.0
    mu = M * m / (M + m)
    # the nail stands until k x = R
    w1 = np.sqrt(k / M)
    t1 = np.arcsin(R / k * w1 / speed) / w1
    rate = speed * np.cos(w1 * t1)
    # from there a sine about the middle, until x = 0
    w, middle = np.sqrt(k / mu), R * mu / (m * k)
    a, b = R / k - middle, rate / w
    size, phase = np.hypot(a, b), np.arctan2(a, b)  # x = middle + size sin(w t + phase)
    t2 = (np.pi + np.arcsin(middle / size) - phase) / w
    impulse_1 = M * (speed - rate)
    last = size * w * np.cos(w * t2 + phase)  # rate of penetration at separation
    # momentum of both, less what the wood takes: M h + m v = M rate - R t2, and h - v = last
    v = (M * (rate - last) - R * t2) / (M + m)
    impulse_2 = M * (rate - (v + last))
    driven = (0.5 * M * speed**2 - 0.5 * M * (v + last) ** 2) / R
    law, nail = SpringDamper(stiffness=k, damping=0.0), Nail(mass=m, resistance=R)
    found = outcome(made(law, nail, hammer=M, tolerance=1e-8), speed)
    assert v > 0
    assert found[0] == pytest.approx(impulse_1 + impulse_2, rel=1e-8)
    assert found[1] == pytest.approx(t1 + t2, rel=1e-6)
    assert found[3] == pytest.approx(driven, rel=1e-7)


@pytest.mark.parametrize("hardening", [0.0, 3e4])
def test_work_of_the_hammer_is_that_against_the_wood(hardening):
    """Without damper nothing else takes energy; all of it ends in the depth."""
    nail = Nail(mass=0.1, resistance=200.0, hardening=hardening, depth=0.005)
    sdc = made(SpringDamper(stiffness=2e5, damping=0.0), nail, step=5e-5)
    impulse, _, energy, depth = outcome(sdc, 1.5)
    lost = 0.5 * (1.5**2 - (1.5 - impulse) ** 2)
    assert energy == pytest.approx(lost, rel=1e-7)
    at_start = 200.0 + hardening * 0.005
    assert at_start * depth + 0.5 * hardening * depth**2 == pytest.approx(energy, rel=1e-7)


def test_work_of_the_hammer_less_that_of_the_damper_is_the_targets():
    """The damper's share is the integral of d rate^2 over compression, from the histories."""
    law = SpringDamper(stiffness=1e5, damping=60.0)
    for target in (TARGETS["nail"], Board(mass=0.5, stiffness=2e4, breaking_force=100.0)):
        sdc = made(law, target, step=2e-5)
        names = ("impulse", "energy", "time", "hand_speed", "target_speed")
        impulse, energy, *histories = (np.array(x).ravel() for x in sdc.function(names)([0.0], [2.0], [0.0]))
        time, hand, speed = histories
        rate = np.maximum(hand - speed, 0.0) ** 2
        spent = 60.0 * float(np.sum(np.diff(time) * (rate[1:] + rate[:-1]) / 2))
        assert 0.5 * (4.0 - (2.0 - impulse[0]) ** 2) == pytest.approx(energy[0] + spent, rel=1e-4)
        assert spent > 0.1


def test_nails_never_come_back_and_stand_while_the_force_is_below_the_woods():
    hammer, speed, law, numbers = BLOWS["stops and starts"]
    names = ("target_speed", "force", "time")
    found = made(law, Nail(**numbers), hammer=hammer, step=2e-5).function(names)([0.0], [speed], [0.0])
    v, f, _ = (np.array(x).ravel() for x in found)
    assert (v >= 0).all() and v.max() > 0.1
    weak = f < 500.0
    at_rest = v == 0.0
    assert (at_rest[1:][at_rest[:-1] & weak[:-1] & weak[1:]]).all() and (at_rest & weak).any()
    standing = made(law, Nail(mass=0.01, resistance=2000.0), hammer=hammer, step=2e-5)
    impulse, _, energy, depth = outcome(standing, speed)
    wall = made(law, RigidWall(), hammer=hammer, step=2e-5).function(("impulse",))([0.0], [speed], [0.0])
    assert impulse == pytest.approx(float(wall), rel=1e-9) and energy == 0.0 and depth == 0.0


def test_a_series_of_blows_goes_on_where_the_first_has_ended():
    """The wood takes the work of all blows, as of one."""
    law = SpringDamper(stiffness=1e5, damping=0.0)
    nail, work = Nail(mass=0.05, resistance=200.0, hardening=1e5), 0.0
    depths = []
    for _ in range(3):
        _, _, energy, depth = outcome(made(law, nail), 1.5)
        depths.append(depth)
        work += energy
        nail = dataclasses.replace(nail, depth=nail.depth + depth)
    total = sum(depths)
    assert depths[0] > depths[1] > depths[2] > 0
    assert 200.0 * total + 0.5 * 1e5 * total**2 == pytest.approx(work, rel=1e-7)


def test_the_nails_switch_is_on_the_side_of_its_motion():
    """A nail that has stopped a little below zero passes v = 0 again when it starts: that is a switch too."""
    nail = Nail(mass=0.1, resistance=100.0)
    assert nail.switches([0.5, 0.0], 0.0) == [0.5]  # coasts, until v = 0
    assert nail.switches([0.0, 0.0], 60.0) == [-40.0]  # stands, until f = R
    assert nail.switches([-1e-9, 0.0], 150.0) == [-1e-9]  # starts, and moves from v = 0 on
    assert nail.velocity([-1e-9, 0.0]) == 0.0 and nail.derivative([-1e-9, 0.0], 150.0) == [500.0, 0.0]


def test_depth_is_where_coasting_ends():
    light = Nail(mass=0.05, resistance=100.0)
    for nail in (light, Nail(mass=2.0, resistance=50.0, hardening=1e4, depth=0.02)):
        for v, z in ((0.0, 0.01), (1.0, 0.0), (3.0, 0.02)):
            assert nail.result([v, z])[0] == pytest.approx(coasting(nail, v, z), rel=1e-8)
    assert Nail(mass=1.0, resistance=1.0).result([-1e-9, 0.03]) == [0.03]


# ------------------------------------------------------------ board
def breaking(hammer, speed, law, board):
    """By SciPy, phase by phase: impulse, duration, v, deflection, largest deflection, whether it broke."""
    at_break = board.breaking_force / board.stiffness

    def force(y, compressing):
        return law.stiffness * y[1] + (law.damping * (y[0] - y[2]) if compressing else 0.0)

    y, t, compressing, broken, largest = np.array([speed, 0.0, 0.0, 0.0, 0.0]), 0.0, True, False, 0.0
    while True:

        def flow(t, y, c=compressing, b=broken):
            f = force(y, c)
            held = 0.0 if b else board.stiffness * y[3] + board.damping * y[2]
            return [-f / hammer, y[0] - y[2], (f - held) / board.mass, y[2], f]

        def turning(t, y, c=compressing):
            return y[0] - y[2] if c else y[2] - y[0]

        def leaving(t, y, c=compressing):
            return 1.0 if c else y[1]

        def cracking(t, y, b=broken):
            return 1.0 if b else at_break - y[3]

        events = [turning, leaving, cracking]
        for event in events:
            event.terminal, event.direction = True, -1.0
        run = solve_ivp(
            flow, (t, t + 1), y, method="DOP853", rtol=1e-11, atol=1e-13, max_step=1e-4, events=events
        )
        t, y, largest = run.t[-1], run.y[:, -1].copy(), max(largest, run.y[3].max())
        first = next(i for i, hits in enumerate(run.t_events) if len(hits))
        if first == 1:
            return y[4], t, y[2], y[3], largest, broken
        compressing = (not compressing) if first == 0 else compressing
        broken = broken or first == 2


@pytest.mark.parametrize(
    "law",
    [SpringDamper(stiffness=1e5, damping=100.0), SpringDamper(stiffness=5e4, damping=0.0)],
    ids=["damped", "elastic"],
)
@pytest.mark.parametrize("force, damping", [(150.0, 0.0), (300.0, 20.0), (1e5, 0.0), (1e5, 30.0)])
def test_boards_against_an_independent_integration(law, force, damping):
    board = Board(mass=0.5, stiffness=5e4, breaking_force=force, damping=damping)
    impulse, duration, v, w, _, broken = breaking(2.0, 1.5, law, board)
    assert broken == (force < 1e5)
    found = outcome(made(law, board, hammer=2.0, step=2e-5, horizon=0.04), 1.5)
    assert found[0] == pytest.approx(impulse, rel=1e-7)
    assert found[1] == pytest.approx(duration, rel=1e-6)
    bent = force / 5e4 if broken else w
    assert found[2] == pytest.approx(0.25 * v**2 + 2.5e4 * bent**2, rel=1e-6)
    assert found[3] == float(broken)
    # a fixed step over the break may take the lost force for a whole step too long, or too short
    plain = outcome(made(law, board, hammer=2.0, method="rk4", step=1e-5, horizon=0.04), 1.5)
    assert plain[0] == pytest.approx(impulse, rel=1e-5, abs=force * 1e-5 if broken else 0.0)
    assert plain[3] == float(broken)


def test_a_board_breaks_exactly_when_it_should():
    law = SpringDamper(stiffness=1e5, damping=100.0)
    whole = Board(mass=0.5, stiffness=5e4, breaking_force=1e6, damping=10.0)
    largest = breaking(2.0, 1.5, law, whole)[4]
    for factor, broken in ((1 - 1e-4, 1.0), (1 + 1e-4, 0.0)):
        board = dataclasses.replace(whole, breaking_force=factor * 5e4 * largest)
        assert outcome(made(law, board, hammer=2.0, step=1e-4), 1.5)[3] == broken


def test_a_broken_board_is_a_free_mass_and_stays_broken():
    board, mass = TARGETS["board"], FreeMass(mass=0.5)
    w = 1.0001 * 400.0 / 2e4
    assert board.result([1.0, w]) == [1.0] and board.result([-1.0, 0.9999 * 0.02]) == [0.0]
    assert board.derivative([1.0, w], 30.0)[0] == mass.derivative([1.0], 30.0)[0]
    assert board.energy([1.0, w]) == pytest.approx(mass.energy([1.0]) + 0.5 * 400.0**2 / 2e4)
    # no state beyond the break that can be reached goes back
    assert all(rate >= 0 for rate in board.derivative([0.0, w], 0.0))


@pytest.mark.parametrize("damping", [0.0, 30.0, 199.0, 200.0, 201.0, 900.0])
def test_a_board_that_swings_on_is_broken_where_its_oscillation_turns_beyond_the_break(damping):
    rng = np.random.default_rng(0)
    for v, w in rng.uniform([0.1, 0.0], [12.0, 6e-3], size=(10, 2)):

        def turn(_, y):
            return y[0]

        turn.terminal, turn.direction = True, -1.0
        found = solve_ivp(
            lambda _, y: [-(1e5 * y[1] + damping * y[0]) / 0.1, y[0]],
            (0.0, 1.0),
            [v, w],
            method="LSODA",
            events=turn,
            rtol=1e-10,
            atol=1e-13,
        )
        largest = found.y[1].max()
        for factor, broken in ((1 - 1e-6, 1.0), (1 + 1e-6, 0.0)):
            if largest > w:
                board = Board(mass=0.1, stiffness=1e5, breaking_force=factor * 1e5 * largest, damping=damping)
                assert board.result([v, w]) == [broken]
                assert board.result([-v, w]) == board.result([1e-3, -w]) == [0.0]


# ------------------------------------------------------------ derivatives of the whole collision
@pytest.mark.parametrize(
    "law, target, options",
    [
        (SpringDamper(stiffness=1e5, damping=60.0), TARGETS["nail"], {}),
        (SpringDamper(stiffness=1e5, damping=0.0), Nail(mass=0.5, resistance=50.0, hardening=1e4), {}),
        (KelvinVoigt(stiffness=1e5, damping=60.0), TARGETS["board"], {}),
        (KelvinVoigt(stiffness=1e5, damping=60.0), RigidWall(), {}),
        (
            HuntCrossley(stiffness=5e6, dissipation=0.2),
            FreeMass(mass=0.7),
            {"method": "rk4", "step": 2e-5},
        ),
    ],
    ids=["nail", "nail that flies ahead", "board", "wall", "hunt-crossley"],
)
def test_derivatives_of_the_impulse_by_all_numbers_against_central_differences(law, target, options):
    sdc = made(law, target, **{"horizon": 0.03, "step": 1e-4, **options})
    graph = sdc.graph(("impulse",))
    names = [f"contact_{name}" for name in law.parameters] + [f"target_{name}" for name in target.parameters]
    start = {"q": [0.0], "v": [1.7], "feedforward": [0.0]}
    values = [ca.DM(start[name] if name in start else sdc.settings[name]) for name in graph.name_in()]
    slopes = graph.factory("slopes", graph.name_in(), [f"grad:impulse:{name}" for name in ["v", *names]])
    found = [float(x) for x in slopes.call(values)]
    impulse = float(graph.call(values)[0])
    for name, slope in zip(["v", *names], found, strict=True):
        i = graph.name_in().index(name)
        value = float(values[i])
        h = 1e-5 * max(value, 1e-3)
        around = []
        for change in (h, -h):
            moved = [*values]
            moved[i] = ca.DM(value + change)
            around.append(float(graph.call(moved)[0]))
        expected = (around[0] - around[1]) / (2 * h)
        assert slope == pytest.approx(expected, rel=2e-5, abs=1e-6 * impulse / max(value, 1e-3)), name


# ------------------------------------------------------------ numbers out of range
@pytest.mark.parametrize(
    "name, changes, message",
    [
        ("nail", {"mass": 0.0}, r"Nail: mass \[kg\]: 0; give a number > 0"),
        ("nail", {"resistance": 0.0}, r"Nail: resistance \[N\]"),
        ("nail", {"hardening": -1.0}, r"Nail: hardening \[N/m\]: -1; give a number >= 0"),
        ("nail", {"depth": np.nan}, r"Nail: depth \[m\]"),
        ("board", {"mass": -1.0}, r"Board: mass \[kg\]"),
        ("board", {"stiffness": 0.0}, r"Board: stiffness \[N/m\]"),
        ("board", {"breaking_force": np.inf}, r"Board: breaking_force \[N\]"),
        ("board", {"damping": -0.1}, r"Board: damping \[N s/m\]"),
        ("board", {"damping": "some"}, r"Board: damping \[N s/m\]: expected numbers"),
        ("board", {"damping": True}, r"Board: damping \[N s/m\]: expected numbers, got True"),
    ],
)
def test_targets_refuse_numbers_out_of_range(name, changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(TARGETS[name], **changes)
