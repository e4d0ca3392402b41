"""A collision's function in the hands of others: the order of its inputs, contacts without end, processes."""

import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from support import small_robots

from impactopt import SDC, FreeMass, InputError, SpringDamper

MASS, SPEED = 2.0, 1.3
ELASTIC = SpringDamper(stiffness=1e4, damping=0.0)


def model(**options):
    given = {"horizon": 0.05, "step": 5e-3, "law": ELASTIC, "target": FreeMass(mass=1.0), **options}
    return SDC(robot=small_robots.slider(MASS), striker="tip", normal=[1.0, 0.0, 0.0], **given)


def elastic(target):
    """Impulse, and its derivatives by speed and target's mass."""
    whole = MASS + target
    return 2 * MASS * target * SPEED / whole, 2 * MASS * target / whole, 2 * MASS**2 * SPEED / whole**2


@pytest.mark.parametrize(
    "names", [("target_mass", "contact_stiffness"), ("contact_stiffness", "target_mass")]
)
def test_parameters_are_inputs_in_the_order_that_they_are_named_in(names):
    numbers = {"target_mass": 0.5, "contact_stiffness": 3e4}
    made = model()
    functions = [
        made.function(parameters=names),
        made.gradient_function(parameters=names),
        made.jacobian_function(("impulse",), parameters=names),
    ]
    for function in functions:
        assert tuple(function.name_in()[3:]) == names
        found = function([0.0], [SPEED], [0.0], *[numbers[name] for name in names])
        assert float(found if isinstance(found, ca.DM) else found[0]) == pytest.approx(
            elastic(0.5)[0], rel=1e-6
        )


@pytest.mark.parametrize("compiler", [True, False])
def test_a_contact_that_has_not_ended_gives_no_number_unless_it_is_said(compiler, monkeypatch):
    if not compiler:
        monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    half = float(np.pi / np.sqrt(1e4 * 1.5) / 2)  # of the contact, when half of the impulse is given
    short = model(horizon=half, step=half)
    state = ([0.0], [SPEED], [0.0])
    for value in short.function(("impulse", "force"))(*state):
        assert np.isnan(np.array(value)).all()
    impulse, separated = short.function(("impulse", "separated"))(*state)
    assert float(separated) == 0.0 and float(impulse) == pytest.approx(elastic(1.0)[0] / 2, rel=1e-6)
    assert float(model().function()(*state)) == pytest.approx(elastic(1.0)[0], rel=1e-6)


OTHER = """
import sys
import casadi as ca
f = ca.external("blow", sys.argv[1])
assert "impactopt" not in sys.modules
x = [[0.0], [1.3], [0.0], 0.5]
value, by_speed, by_mass = f(*x)[0], *(f.jacobian()(*x, 0, 0)[k] for k in (1, 3))
print(float(value), float(by_speed), float(by_mass))
"""


@pytest.mark.slow
def test_an_exported_function_is_loaded_and_differentiated_by_another_process(tmp_path):
    library = model().export(tmp_path, ("impulse", "duration"), parameters=("target_mass",))
    command = [sys.executable, "-I", "-c", OTHER, str(library)]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout
    np.testing.assert_allclose([float(x) for x in told.split()], elastic(0.5), rtol=1e-5)
    assert {path.suffix for path in tmp_path.iterdir()} == {".c", ".h", ".so"}
    with pytest.raises(InputError, match="name 'collision'"):
        model().export(tmp_path, name="collision")


def test_a_function_says_at_once_that_it_cannot_be_saved(tmp_path):
    function = model().function()
    for do in (
        lambda: function.save(str(tmp_path / "f.casadi")),
        lambda: function.serialize(),
        lambda: function.generate("f.c"),
        lambda: pickle.dumps(function),
    ):
        with pytest.raises(InputError, match="`export`"):
            do()
    assert not list(tmp_path.iterdir())
