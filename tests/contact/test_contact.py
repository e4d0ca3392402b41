"""Contact laws, targets and stances: their formulas, and what they refuse."""

import copy
import dataclasses
import doctest
import functools
import math
import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import gamma
from support.frozen_cases import X, slider

from impactopt import (
    SDC,
    BothSoles,
    ContactLaw,
    CustomLaw,
    FixedBase,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    InputError,
    KelvinVoigt,
    OneSole,
    SpringDamper,
    g1,
    talos,
)

pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")


@pytest.fixture(autouse=True)
def _virtual_machine(monkeypatch):
    """The graphs are tested as they are; compiling them is another test file's subject."""
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")


def test_spring_damper_damps_in_compression_only_and_never_pulls():
    law = SpringDamper(stiffness=1e4, damping=300.0)
    assert law.force(0.002, 0.1) == pytest.approx(50.0)
    assert law.force(0.002, -0.1) == pytest.approx(20.0)
    assert law.force(0.0, 0.4) == pytest.approx(120.0)
    assert law.force(-0.001, 1.0) == 0.0
    assert law.force(-0.001, -1.0) == 0.0


def test_spring_damper_gives_the_same_in_numbers_arrays_and_symbols():
    law = SpringDamper(stiffness=2e3, damping=50.0)
    x = np.array([-0.01, 0.0, 0.01, 0.02, 0.03])
    rate = np.array([1.0, 2.0, 0.5, 0.0, -3.0])
    one_by_one = [float(law.force(a, b)) for a, b in zip(x, rate, strict=True)]
    np.testing.assert_allclose(np.array(law.force(x, rate)).ravel(), one_by_one)
    for symbol in (ca.SX, ca.MX):
        a, b = symbol.sym("a", 5), symbol.sym("b", 5)
        f = ca.Function("f", [a, b], [law.force(a, b)])
        np.testing.assert_allclose(np.array(f(x, rate)).ravel(), one_by_one)


def test_branches_agree_at_the_end_of_compression():
    law = SpringDamper(stiffness=1e4, damping=300.0)
    assert law.branch(0.003, 0.0, True) == law.branch(0.003, 0.0, False)


def test_parameters_can_be_replaced():
    law = SpringDamper(stiffness=1e4, damping=300.0)
    assert law.force(0.001, 1.0, {"stiffness": 1e3, "damping": 10.0}) == pytest.approx(11.0)
    assert FreeMass(mass=5.0).derivative([0.0], 10.0, {"mass": 2.0}) == [5.0]


def test_free_mass_gains_the_work_done_on_it():
    target = FreeMass(mass=3.0)
    force, dt, state, work = 12.0, 1e-4, [0.0], 0.0
    for _ in range(1000):
        before = target.velocity(state)
        state = [state[0] + dt * target.derivative(state, force)[0]]
        work += force * dt * (before + target.velocity(state)) / 2
    assert target.energy(state) == pytest.approx(work)


# ------------------------------------------------------------ what holds for every law
def cubic(x, rate, stiffness, hardening, damping):
    """For CustomLaw; a function of a module, so that it can be pickled."""
    return stiffness * x + hardening * x**3 + damping * x * rate


def rounded_body(x, rate, stiffness, exponent, damping):
    """The same, as a user would write a power: no number below zero, and no curvature at it."""
    return stiffness * x**exponent * (1 + damping * rate)


LAWS = {
    "spring-damper": SpringDamper(stiffness=1e4, damping=300.0),
    "kelvin-voigt": KelvinVoigt(stiffness=1e4, damping=300.0),
    "hunt-crossley": HuntCrossley(stiffness=1e6, dissipation=0.4, exponent=1.3),
    "hertz": HertzDamped(stiffness=1e6, damping=300.0),
    "custom": CustomLaw(compression=cubic, analytic=True, stiffness=1e4, hardening=4e8, damping=2e4),
    "power": CustomLaw(compression=rounded_body, stiffness=1e6, exponent=1.5, damping=0.1),
}


@functools.cache
def in_symbols(name):
    """ca.Function (x, rate, numbers) -> force, and its derivatives by all of them."""
    law = LAWS[name]
    symbols = ca.SX.sym("z", 2 + len(law.parameters))
    numbers = {key: symbols[2 + i] for i, key in enumerate(law.parameters)}
    force = law.force(symbols[0], symbols[1], numbers)
    return ca.Function("force", [symbols], [force, ca.jacobian(force, symbols), ca.gradient(force, symbols)])


@pytest.mark.parametrize("name", LAWS)
@given(x=st.floats(-0.02, 0.02), rate=st.floats(-5.0, 5.0))
@example(x=0.0, rate=0.0)
@example(x=0.0, rate=1.0)
@example(x=1e-6, rate=1.0)
@example(x=5e-324, rate=1.0)
@example(x=-5e-324, rate=-1.0)
@settings(deadline=None, max_examples=60)
def test_laws_never_pull_and_are_zero_apart_and_finite_with_their_derivatives(name, x, rate):
    law = LAWS[name]
    force = float(law.force(x, rate))
    assert np.isfinite(force) and force >= 0.0
    if x < 0:
        assert force == 0.0
    value, forward, reverse = in_symbols(name)([x, rate, *law.parameters.values()])
    assert float(value) == pytest.approx(force, rel=1e-12, abs=1e-200)
    assert np.isfinite(np.array(forward)).all() and np.isfinite(np.array(reverse)).all()
    assert float(law.force(np.array([x, x]), np.array([rate, rate]))[1]) == pytest.approx(force, rel=1e-12)
    for compressing in (True, False):
        assert np.isfinite(float(law.branch(x, rate, compressing)))


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_of_laws_against_central_differences(name):
    law, rng, h = LAWS[name], np.random.default_rng(0), 1e-6
    for _ in range(20):
        z = np.array([rng.uniform(1e-4, 0.01), rng.uniform(-0.2, 1.0), *law.parameters.values()])
        slope = np.array(in_symbols(name)(z)[1]).ravel()
        for i in range(len(z)):
            step = h * z[i] * np.eye(len(z))[i]
            up, down = (float(in_symbols(name)(z + s * step)[0]) for s in (1, -1))
            scale = max(up, 1e-3) / abs(z[i])
            assert slope[i] == pytest.approx((up - down) / (2 * h * z[i]), rel=1e-6, abs=1e-6 * scale)


def test_the_damper_of_hertz_is_rounded_off_without_a_kink():
    numbers = list(LAWS["hertz"].parameters.values())
    below, above = (
        [np.array(x) for x in in_symbols("hertz")([x, 1.0, *numbers])] for x in (1e-6 - 1e-13, 1e-6 + 1e-13)
    )
    for a, b in zip(below, above, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    x = np.geomspace(1e-9, 1e-5, 200)
    assert (np.diff(LAWS["hertz"].branch(x, 1.0, True)) > 0).all()


@pytest.mark.parametrize("name", LAWS)
def test_laws_agree_where_compression_ends_and_can_be_made_anew(name):
    law = LAWS[name]
    assert law.branch(0.003, 0.0, True) == law.branch(0.003, 0.0, False)
    again = type(law)(**{**law.parameters, "stiffness": 2.0})
    assert again.parameters == {**law.parameters, "stiffness": 2.0}
    assert again.formula() == law.formula()
    for twin in (copy.deepcopy(law), pickle.loads(pickle.dumps(law))):
        assert twin.parameters == law.parameters and twin.force(0.01, -0.1) == law.force(0.01, -0.1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        law.stiffness = 3.0


def test_formulas_tell_laws_apart_to_the_last_digit():
    assert len({law.formula() for law in LAWS.values()}) == len(LAWS)
    near, far = (
        CustomLaw(compression=lambda x, rate, c=c: c * x, analytic=True) for c in (1e4, 1e4 * (1 + 1e-12))
    )
    assert near.formula() != far.formula()
    assert ca.SX.get_precision() == 6  # left as it was


# ------------------------------------------------------------ closed forms of two masses that collide
def rebound(law, reduced, speed):
    """(restitution, duration, largest force, deepest penetration) of a reduced mass, by SciPy."""

    def left(t, y):
        return 1.0 if y[1] > 0 else min(y[0], law.branch(y[0], y[1], False))

    def turning(t, y):
        return y[1]

    left.terminal = True
    left.direction = turning.direction = -1
    run = solve_ivp(
        lambda t, y: [y[1], -law.force(y[0], y[1]) / reduced],
        (0.0, 1.0),
        [0.0, speed],
        method="DOP853",
        rtol=1e-10,
        atol=1e-13,
        max_step=1e-3,
        events=[left, turning],
    )
    peak = max(law.force(*y) for y in run.y.T)
    return -run.y[1, -1] / speed, run.t[-1], peak, run.y_events[1][0][0]


def through_sdc(law, *, mass=2.0, target=3.0, speed=1.0, **options):
    """(impulse, duration) of a slider on a free mass."""
    options = {"horizon": 0.1, **options}
    sdc = SDC(robot=slider(mass), striker="tip", normal=X, law=law, target=FreeMass(mass=target), **options)
    found = sdc.function(("impulse", "duration"))([0.0], [speed], [0.0])
    return [float(x) for x in found]


REDUCED = 2.0 * 3.0 / 5.0


def cut_restitution(zeta):
    return np.exp(-2 * zeta * np.arccos(zeta) / np.sqrt(1 - zeta**2))


@pytest.mark.parametrize("zeta", [0.0, 0.05, 0.3, 0.7, 0.95])
def test_kelvin_voigt_in_closed_form(zeta):
    """A damped half-sine, cut where its acceleration is zero: at the phase 2 acos(zeta)."""
    stiffness, speed = 1e4, 1.2
    omega = np.sqrt(stiffness / REDUCED)
    law = KelvinVoigt(stiffness=stiffness, damping=2 * zeta * omega * REDUCED)
    e, duration = cut_restitution(zeta), 2 * np.arccos(zeta) / (omega * np.sqrt(1 - zeta**2))
    assert rebound(law, REDUCED, speed)[:2] == pytest.approx((e, duration), rel=1e-7)
    found = through_sdc(law, speed=speed, tolerance=1e-8)
    assert found[0] == pytest.approx(REDUCED * (1 + e) * speed, rel=1e-8)
    assert found[1] == pytest.approx(duration, rel=1e-6)


def test_kelvin_voigt_gives_nothing_of_the_papers_table_iii():
    """As the spring-damper gives all of it (`test_sdc.py`), the paper's damper acts in compression only."""
    printed = {4.0: (1.2, 2.1, 3.0), 6.0: (1.5, 2.7, 3.8), 8.0: (1.7, 3.0, 4.3)}
    hits = 0
    for mass, impulses in printed.items():
        sdc = SDC.paper(slider(mass), striker="tip", normal=X, law=KelvinVoigt(stiffness=1e4, damping=300.0))
        for speed, impulse in zip((0.4, 0.7, 1.0), impulses, strict=True):
            hits += round(float(sdc.function(("impulse",))([0.0], [speed])), 1) == impulse
    assert hits == 0


@pytest.mark.parametrize("exponent, alpha, speed", [(1.5, 0.0, 1.0), (1.0, 0.4, 2.0), (2.2, 0.1, 0.5)])
def test_hunt_crossley_restitution_depends_on_speed_alone(exponent, alpha, speed):
    law = HuntCrossley(stiffness=2e5, dissipation=alpha, exponent=exponent)

    def spent(v):  # integral of v dv / (1 + l v), which x^p takes on both ways alike
        lam = 1.5 * alpha
        return v**2 / 2 if lam == 0 else v / lam - np.log1p(lam * v) / lam**2

    most = 1.0 if alpha == 0 else min(1.0, (1 - 1e-9) / (1.5 * alpha * speed))
    e = brentq(lambda e: spent(speed) - spent(-e * speed), 0.1, most)
    assert rebound(law, REDUCED, speed)[0] == pytest.approx(e, rel=1e-5)
    assert through_sdc(law, speed=speed)[0] == pytest.approx(REDUCED * (1 + e) * speed, rel=1e-6)


def test_hunt_crossley_restitution_is_one_less_alpha_v_for_small_alpha_v():
    errors = []
    for alpha in (0.01, 0.02):
        e = rebound(HuntCrossley(stiffness=2e5, dissipation=alpha), REDUCED, 1.0)[0]
        errors.append(abs(e - (1 - alpha)))
    assert errors[0] < 1e-4  # of second order
    assert errors[1] / errors[0] == pytest.approx(4.0, rel=0.1)


def test_hertz_without_damping_in_closed_form():
    """Contact lasts 2.94 x_max / v, with x_max from the energy, and peaks at k x_max^1.5."""
    stiffness, speed = 1e7, 1.5
    law = HertzDamped(stiffness=stiffness, damping=0.0)
    deepest = (5 * REDUCED * speed**2 / (4 * stiffness)) ** 0.4
    constant = 2 * np.sqrt(np.pi) * gamma(0.4) / (2.5 * gamma(0.9))
    assert constant == pytest.approx(2.94, abs=0.005)
    e, duration, peak, x = rebound(law, REDUCED, speed)
    assert e == pytest.approx(1.0, rel=1e-5) and x == pytest.approx(deepest, rel=1e-8)
    assert duration == pytest.approx(constant * deepest / speed, rel=1e-4)
    assert peak == pytest.approx(stiffness * deepest**1.5, rel=1e-2)
    found = through_sdc(law, speed=speed, step=1e-5)
    assert found[0] == pytest.approx(2 * REDUCED * speed, rel=1e-6)
    assert found[1] == pytest.approx(constant * deepest / speed, abs=2e-5)


@pytest.mark.parametrize("depth", [1e-8, 3e-7, 2e-6, 1e-4])
def test_damped_hertz_separates_where_its_force_is_zero(depth):
    """Below a micrometre too, where the damper's quarter power is rounded."""
    law = HertzDamped(stiffness=5e6, damping=6e3)
    rate = brentq(lambda r: law.branch(depth, r, False), -1.0, 0.0, xtol=1e-18)
    assert law.separation(depth, rate) == pytest.approx(0.0, abs=1e-9 * law.stiffness * depth)
    assert law.separation(depth, 0.9 * rate) > 0 > law.separation(depth, 1.1 * rate)


@pytest.mark.parametrize("a, speed", [(0.1, 3.0), (0.5, 0.3), (0.5, 3.0), (1.5, 0.3)])
def test_damped_hertz_restitution_depends_on_neither_speed_nor_stiffness(a, speed):
    stiffness = 1e6
    law = HertzDamped(stiffness=stiffness, damping=a * np.sqrt(stiffness * REDUCED))
    e = cut_restitution(a / np.sqrt(5))
    # the damper's rounded start costs this much
    assert rebound(law, REDUCED, speed)[0] == pytest.approx(e, rel=2e-4)
    assert through_sdc(law, speed=speed)[0] == pytest.approx(REDUCED * (1 + e) * speed, rel=1e-4)


def test_hertz_from_two_spheres():
    law = HertzDamped.of_spheres(radii=(0.02, np.inf), young=(2.1e11, 1e10), poisson=(0.3, 0.4), damping=5.0)
    modulus = 1 / ((1 - 0.09) / 2.1e11 + (1 - 0.16) / 1e10)
    assert law.stiffness == pytest.approx(4 / 3 * modulus * np.sqrt(0.02)) and law.damping == 5.0
    # Hertz's contact time of a ball on a plane, as textbooks have it: 2.87 (m^2 / (R E^2 v))^(1/5)
    ball = HertzDamped.of_spheres(radii=(0.02, np.inf), young=(2.1e11, np.inf), poisson=(0.3, 0.0))
    modulus = 2.1e11 / (1 - 0.09)
    expected = 2.87 * (0.26**2 / (0.02 * modulus**2 * 0.5)) ** 0.2
    assert rebound(ball, 0.26, 0.5)[1] == pytest.approx(expected, rel=2e-3)
    for wrong, message in (
        ({"radii": (np.inf, np.inf)}, "both infinite"),
        ({"radii": (0.0, 1.0)}, "radii"),
        ({"young": (1e9, -1.0)}, "young"),
        ({"poisson": (0.3, 0.6)}, "poisson"),
        ({"radii": (1.0,)}, "expected shape"),
    ):
        good = {"radii": (0.02, np.inf), "young": (2e11, 2e11), "poisson": (0.3, 0.3)}
        with pytest.raises(InputError, match=message):
            HertzDamped.of_spheres(**{**good, **wrong})


# ------------------------------------------------------------ a law of one's own
def test_the_example_of_the_custom_law():
    (example_,) = doctest.DocTestFinder(recurse=False).find(
        CustomLaw, "CustomLaw", globs={"CustomLaw": CustomLaw}
    )
    runner = doctest.DocTestRunner()
    runner.run(example_)
    assert runner.summarize().attempted >= 3 and runner.summarize().failed == 0


def test_a_custom_law_is_its_class_written_out_and_its_numbers_are_inputs():
    spring = SpringDamper(stiffness=1e4, damping=100.0)
    custom = CustomLaw(
        compression=lambda x, rate, k, d: k * x + d * rate,
        restitution=lambda x, rate, k, d: k * x,
        analytic=True,
        k=1e4,
        d=100.0,
    )
    assert through_sdc(custom) == through_sdc(spring)
    sdc = SDC(robot=slider(2.0), striker="tip", normal=X, law=custom, target=FreeMass(mass=3.0))
    impulse = sdc.function(("impulse",), parameters=("contact_k", "contact_d"))
    stiffer = SpringDamper(stiffness=5e4, damping=10.0)
    assert float(impulse([0.0], [1.0], [0.0], 5e4, 10.0)) == through_sdc(stiffer, horizon=0.2)[0]
    with pytest.raises(InputError, match="contact_d: nan"):
        sdc.settings.override({"contact_d": np.nan})


@pytest.mark.parametrize(
    "options, message",
    [
        ({}, "compression: None; give a function"),
        ({"compression": 3.0}, "compression: 3.0; give a function"),
        ({"compression": cubic, "restitution": "no"}, "restitution: 'no'; give a function"),
        ({"compression": cubic, "stiffness": 1.0}, "cannot be called"),
        ({"compression": lambda x, rate: x, "stiffness": 1.0}, r"function\(penetration, rate, stiffness\)"),
        ({"compression": lambda x, rate: max(x, 0.0)}, "cannot be called with CasADi expressions"),
        ({"compression": lambda x, rate: ca.vertcat(x, rate)}, "gives 2 expressions"),
        (
            {"compression": lambda x, rate: 2 * x, "restitution": lambda x, rate: x},
            "0.1 mm deep",
        ),
        (
            {"compression": lambda x, rate, k, gap: k * (x - gap), "k": 1e5, "gap": -2e-3},
            "CustomLaw: the force is 200 N where contact begins",
        ),
        ({"compression": lambda x, rate: x**1.5, "analytic": True}, "CustomLaw: analytic: .*analytic=False"),
        ({"compression": lambda x, rate, k: k * x, "k": np.inf}, "CustomLaw: k: inf"),
        ({"compression": lambda x, rate, k: k * x, "k": "soft"}, "CustomLaw: k: expected numbers"),
        ({"compression": lambda x, rate: np.array([x])}, "gives an array; give one expression"),
        ({"compression": lambda x, rate: x * math.sqrt(x)}, "has NaN in its expression: .*casadi.sqrt"),
        ({"compression": lambda x, rate, k: k * ca.log(-x), "k": 1e4}, "0.1 mm deep, is nan N"),
        ({"compression": lambda x, rate, k: k * x, "k": -1e4}, "is -100 N in .*a force that pushes"),
    ],
)
def test_custom_laws_that_cannot_work_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        CustomLaw(**options)


@pytest.mark.parametrize(
    "formula",
    [
        lambda x, rate: -500.0 * ca.log(1 - x / 5e-3),  # a foam of 5 mm
        lambda x, rate: 1e3 * (ca.exp(x / 1e-5) - 1),
        lambda x, rate: 1e5 * (x - 0.02),  # behind a gap
    ],
    ids=["foam", "exponential", "gap"],
)
def test_laws_may_have_no_force_at_depths_that_are_not_reached(formula):
    assert CustomLaw(compression=formula).parameters == {}


@pytest.mark.parametrize(
    "formula",
    [
        lambda x, rate: 1e6 * x**1.5,
        lambda x, rate: 1e6 * x**1.1 * (1 + 0.2 * rate),
        lambda x, rate: 1e5 * x**1.25 + 300.0 * rate,
        lambda x, rate: 1e6 * ca.fmax(x, 0) ** 1.5,
        lambda x, rate: 1e6 * x**1.5 + 200.0 * x**0.25 * rate,
        lambda x, rate: 1e3 * ca.sqrt(x),
    ],
)
def test_a_law_that_is_not_smooth_at_zero_goes_on_along_its_tangent(formula):
    """It is the formula above 1e-6 m, and below it a line without a kink."""
    law, rate, edge = CustomLaw(compression=formula), 0.3, 1e-6
    for x in (2e-6, 1e-4, 0.01):
        assert law.branch(x, rate, True) == pytest.approx(float(formula(x, rate)), rel=1e-14)
    x, r = ca.SX.sym("x"), ca.SX.sym("r")
    branch = law.branch(x, r, True)
    curvature, slope = ca.hessian(branch, x)
    numbers = ca.Function("numbers", [x, r], [branch, slope, curvature])
    plain = ca.Function("plain", [x, r], [ca.gradient(formula(x, r), x)])
    value, tilt, bend = (float(found) for found in numbers(-2e-3, rate))
    assert tilt == pytest.approx(float(plain(edge, rate)), rel=1e-4) and bend == 0.0
    assert value == pytest.approx(float(formula(edge, rate)) + tilt * (-2e-3 - edge), rel=1e-9)
    assert law.branch(-2e-3, rate, True) == pytest.approx(value, rel=1e-12)
    below, above = (float(numbers(edge + side, rate)[0]) for side in (-1e-12, 1e-12))
    assert (above - below) / 2e-12 == pytest.approx(tilt, rel=1e-3)
    assert law.force(-0.01, rate) == 0.0, "a float, not a complex number"


def test_a_smooth_law_is_its_formula_everywhere():
    """As a line below zero, by which implicit and exact steps know a law that is linear."""
    for law in (
        CustomLaw(compression=lambda x, rate, k, d: k * x + d * rate, k=1e4, d=10.0),
        CustomLaw(compression=lambda x, rate, k, d: k * x**3 + d * rate, k=1e4, d=10.0),
    ):
        compression = law._branches[0]
        for x in (-0.01, -1e-7, 0.0, 1e-7, 0.01):
            assert law.branch(x, 0.2, True) == compression(x, 0.2, **law.parameters)


def test_a_force_below_zero_is_cut_from_a_linear_law():
    """A spring that begins after a gap, in closed form, with either method."""
    law = CustomLaw(compression=lambda x, rate, k, gap: k * (x - gap), analytic=True, k=1e5, gap=5e-3)
    expected = [2 * REDUCED * 1.0, 5e-3 / 1.0 + np.pi * np.sqrt(REDUCED / 1e5)]
    for options in ({}, {"method": "rk4", "step": 1e-5}):
        assert through_sdc(law, **options) == pytest.approx(expected, rel=1e-3)


def test_a_force_below_zero_is_cut_where_it_falls_with_the_rate():
    """A damper that drives while a spring compresses, in closed form, with either method: no force up to
    x = d v / k, then an oscillation that grows, and the spring alone back.
    """
    k, d, speed = 1e5, 100.0, 1.0
    law = CustomLaw(
        compression=lambda x, rate, k, d: k * x - d * rate,
        restitution=lambda x, rate, k, d: k * x + 0 * d,
        analytic=True,
        k=k,
        d=d,
    )
    start, growth, omega = d * speed / k, d / (2 * REDUCED), np.sqrt(k / REDUCED)
    w = np.sqrt(omega**2 - growth**2)
    # x = exp(growth t) (start cos(w t) + b sin(w t)), up to where it turns
    b = (speed - growth * start) / w
    turn = np.arctan2(growth * start + w * b, w * start - growth * b) / w
    deepest = np.exp(growth * turn) * (start * np.cos(w * turn) + b * np.sin(w * turn))
    expected = [REDUCED * (speed + omega * deepest), start / speed + turn + np.pi / 2 / omega]
    for options in ({}, {"method": "rk4", "step": 1e-5}):
        assert through_sdc(law, **options) == pytest.approx(expected, rel=1e-3)


def test_a_law_written_as_a_class_needs_a_branch():
    with pytest.raises(TypeError, match="branch"):
        ContactLaw()


# ------------------------------------------------------------ numbers out of range
@pytest.mark.parametrize("kind", [KelvinVoigt, HertzDamped])
@pytest.mark.parametrize(
    "stiffness, damping", [(0.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (np.nan, 1.0), (1.0, np.inf)]
)
def test_damped_laws_refuse_numbers_out_of_range(kind, stiffness, damping):
    with pytest.raises(InputError, match=rf"{kind.__name__}: (stiffness|damping)"):
        kind(stiffness=stiffness, damping=damping)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"stiffness": 0.0}, "stiffness"),
        ({"dissipation": -0.1}, "dissipation"),
        ({"dissipation": np.nan}, "dissipation"),
        ({"exponent": 0.5}, r"exponent: 0.5; give a number >= 1"),
        ({"exponent": -1.0}, "exponent"),
    ],
)
def test_hunt_crossley_refuses_numbers_out_of_range(changes, message):
    with pytest.raises(InputError, match=f"HuntCrossley: {message}"):
        HuntCrossley(**{"stiffness": 1e6, "dissipation": 0.1, **changes})


@pytest.mark.parametrize(
    "stiffness, damping", [(0.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (np.nan, 1.0), (1.0, np.inf)]
)
def test_spring_damper_refuses_numbers_out_of_range(stiffness, damping):
    with pytest.raises(InputError, match=r"SpringDamper: (stiffness|damping)"):
        SpringDamper(stiffness=stiffness, damping=damping)


@pytest.mark.parametrize("mass", [0.0, -5.0, np.nan, "heavy", [1.0, 2.0]])
def test_free_mass_refuses_numbers_out_of_range(mass):
    with pytest.raises(InputError, match="FreeMass: mass"):
        FreeMass(mass=mass)


def test_stances_hold_the_soles_they_name():
    robot = g1()
    assert BothSoles().sole_names(robot) == ("left", "right")
    assert OneSole("right").sole_names(robot) == ("right",)
    assert OneSole("right").constraint_frames(robot) == (robot.sole("right").frame,)
    np.testing.assert_array_equal(BothSoles().compliance, np.zeros(6))
    yielding = OneSole("left", base_mass=1e5, base_inertia=1e4).compliance
    np.testing.assert_allclose(yielding, [1e-5] * 3 + [1e-4] * 3)


def test_stances_refuse_what_a_robot_cannot_do():
    floating, fixed = talos(), talos(floating=False)
    with pytest.raises(InputError, match="did you mean 'left'"):
        OneSole("lefft").soles(floating)
    with pytest.raises(InputError, match="free-flyer"):
        FixedBase().soles(floating)
    with pytest.raises(InputError, match="fixed base"):
        BothSoles().soles(fixed)
    assert FixedBase().soles(fixed) == ()
    with pytest.raises(InputError, match="give both"):
        BothSoles(base_mass=1e5)
    with pytest.raises(InputError, match="base_inertia"):
        BothSoles(base_mass=1e5, base_inertia=-1.0)


# ------------------------------------------------------------ laws of a user's own
@dataclasses.dataclass(frozen=True, kw_only=True)
class Baked(ContactLaw):
    """Its own number stays in compiled functions, whatever a collision is asked for."""

    stiffness: float

    def branch(self, penetration, rate, compressing, parameters=None):
        return self.stiffness * penetration


class HalfBaked(Baked):
    """A law that does take it, in one of its branches."""

    def branch(self, penetration, rate, compressing, parameters=None):
        p = self.parameters if parameters is None else parameters
        return (p["stiffness"] if compressing else self.stiffness) * penetration


class Parting(HuntCrossley):
    """A law with two expressions for the end of contact."""

    def separation(self, penetration, rate, parameters=None):
        return ca.vertcat(penetration, rate)


class Undecorated(ContactLaw):
    def branch(self, penetration, rate, compressing, parameters=None):
        return penetration


@pytest.mark.parametrize(
    "branch, message",
    [
        (lambda law, x, rate, back, p=None: max(x, 0.0), r"as branch\(penetration.*casadi\.fmax"),
        (lambda law, x, rate, back: x, r"compression: cannot be called .* parameters\)"),
        (lambda law, x, rate, back, p=None: x if back else 2 * x, "agree there"),
        (lambda law, x, rate, back, p=None: -x, "a force that pushes"),
    ],
)
def test_a_law_is_refused_when_it_is_made(branch, message):
    law = dataclasses.make_dataclass(
        "Own", [], bases=(ContactLaw,), namespace={"branch": branch}, frozen=True
    )
    with pytest.raises(InputError, match=f"Own: .*{message}"):
        law()


def test_a_law_that_does_not_take_its_numbers_as_inputs_is_refused():
    with pytest.raises(
        InputError, match=r"Baked: expressions of its methods do not have stiffness .* `parameters`"
    ):
        Baked(stiffness=1e4)
    with pytest.raises(
        InputError, match=r"HalfBaked: expressions of its methods do not have stiffness .* `parameters`"
    ):
        HalfBaked(stiffness=1e4)
    with pytest.raises(InputError, match=r"separation\(.*\) gives 2 expressions; give one expression"):
        Parting(stiffness=1e4, dissipation=0.0)
    with pytest.raises(InputError, match="Undecorated is no dataclass: write @dataclass"):
        _ = Undecorated().parameters


def test_a_law_has_the_branches_of_its_constants_today():
    @dataclasses.dataclass(frozen=True)
    class Lossy(ContactLaw):
        stiffness: float = 1e4
        damping: float = 10.0
        returned = 1.0  # fraction of the damping in restitution

        def branch(self, penetration, rate, compressing, parameters=None):
            numbers = parameters or self.parameters
            damping = numbers["damping"] * (1.0 if compressing else self.returned)
            return numbers["stiffness"] * penetration + damping * rate

    law = Lossy()
    assert not law.switches
    Lossy.returned = 0.5
    assert law.switches and law.force(1e-3, -0.1) == pytest.approx(9.5)
