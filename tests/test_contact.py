"""Contact laws, targets and stances: their formulas, and what they refuse."""

import casadi as ca
import numpy as np
import pytest

from impactopt.contact import FreeMass, SpringDamper
from impactopt.errors import InputError
from impactopt.presets import g1, talos
from impactopt.stance import BothSoles, FixedBase, OneSole


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
