"""The C of collisions under the compiler's sanitizers, in every branch for vectors of another width.

Each function is a program of its own: in Python's process sanitizers do not get on with CasADi's plugins. Its
arrays have exactly the sizes that it asks for, so that a step beyond them is seen; its room is full of no
numbers, so that what is read before it is set is seen.
"""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.native_cases import ROBOTS, robot_named, situation

from impactopt import SDC, Board, ContactFriction, Effects, FreeMass, HuntCrossley, Nail, SpringDamper
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.native import (
    native_collision,
    native_differences,
    native_gradient,
    native_jacobian,
)

SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-g1")
BRANCHES = {"widest": (), "AVX2": ("-mno-avx512f",), "SSE2": ("-mno-avx",)}
MAIN = """
#include <stdio.h>
#include <stdlib.h>
static const double GIVEN[] = {%s};
int main(void) {
  const double **arg = malloc(N_IN * sizeof *arg), *from = GIVEN;
  double **res = malloc(N_OUT * sizeof *res);
  Int sizes[4];
  OF_NAME(work)(sizes, sizes + 1, sizes + 2, sizes + 3);
  double *w = malloc(sizes[3] * sizeof *w);
  memset(w, 0xff, sizes[3] * sizeof *w);
  FOR(k, N_IN) {
    Int size = SHAPES_IN[k][0] * SHAPES_IN[k][1];
    double *x = malloc(size * sizeof *x);
    FOR(i, size) x[i] = *from++;
    arg[k] = x;
  }
  FOR(k, N_OUT) res[k] = malloc(SHAPES_OUT[k][0] * SHAPES_OUT[k][1] * sizeof(double));
  NAME(arg, res, 0, w, 0);
  printf("%%.17g\\n", res[0][0]);
  FOR(k, N_IN) free((void *)arg[k]);
  FOR(k, N_OUT) free(res[k]);
  free(arg);
  free(res);
  free(w);
  return 0;
}
"""


def model(**options: Any) -> SDC:
    given: dict[str, Any] = {
        "robot": robot_named("arm"),
        "striker": ROBOTS["arm"][1],
        "normal": [1.0, 0.0, 0.0],
        "law": SpringDamper(stiffness=1e4, damping=300.0),
        "target": FreeMass(mass=1.0),
        "horizon": 0.05,
    }
    return SDC(**{**given, **options})


GAINS = 0.5 * np.ones((4, 4)) + np.diag([20.0, 30.0, 20.0, 10.0])
HUNT = HuntCrossley(stiffness=1e6, dissipation=0.3)
BOARD = Board(mass=0.5, stiffness=2e4, breaking_force=60.0)
PROGRAMS: dict[str, tuple[dict[str, Any], Callable[[SDC], Any]]] = {
    "implicit steps": (
        {"target": Nail(mass=0.2, resistance=80.0)},
        lambda one: native_collision(one, ("impulse", "force", "torque", "configuration", "separated")),
    ),
    "bent law, freezes": (
        {"law": HUNT, "freezes": 2, "target": BOARD},
        lambda one: native_collision(one, ("impulse", "velocity", "peak_force")),
    ),
    "Runge-Kutta": (
        {"law": HUNT, "method": "rk4"},
        lambda one: native_collision(one, ("impulse", "force", "step_error")),
    ),
    "friction at the hit, freezes": (
        {"contact_friction": ContactFriction(coefficient=0.6), "freezes": 2},
        lambda one: native_collision(one, ("impulse", "force", "velocity")),
    ),
    "friction that moves the target, freezes": (
        {"contact_friction": ContactFriction(coefficient=0.6, moves_target=True), "freezes": 2},
        lambda one: native_collision(one, ("impulse", "energy", "tangential_velocity")),
    ),
    "friction at the hit, no drifts": (
        {"contact_friction": ContactFriction(coefficient=0.6), "effects": Effects.none()},
        lambda one: native_collision(one, ("impulse", "force", "velocity")),
    ),
    "gradient": ({}, lambda one: native_gradient(one, "impulse")),
    "gradient, bent law": ({"law": HUNT, "kd": GAINS}, lambda one: native_gradient(one, "impulse")),
    "differences, freezes": (
        {"freezes": 1},
        lambda one: native_differences(one, ("impulse",), ("q", "v")),
    ),
    "Jacobian": ({}, lambda one: native_jacobian(one, ("impulse", "torque"))),
    "Jacobian, bent law": (
        {"law": HUNT, "kd": GAINS},
        lambda one: native_jacobian(one, ("impulse", "torque")),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "branch"),
    # of narrower vectors one program of each kind: all others go through the same headers
    [*((name, "widest") for name in PROGRAMS), *product(("implicit steps", "Jacobian"), ("AVX2", "SSE2"))],
)
def test_nothing_beyond_its_bounds_and_nothing_undefined(tmp_path: Path, name: str, branch: str) -> None:
    if branch != "widest" and platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("another machine's vectors")
    compiler = find_compiler()
    if compiler is None or not _has_sanitizers(tmp_path, compiler.command):
        pytest.skip("no compiler with sanitizers")
    options, made_of = PROGRAMS[name]
    one = model(**options)
    code = made_of(one)
    numbers = np.concatenate([np.ravel(x, order="F") for x in situation("arm", one)]).tolist()
    source, program = tmp_path / "program.c", tmp_path / "program"
    source.write_text(f"{code.whole}\n{MAIN % ', '.join(map(repr, numbers))}", encoding="utf-8")
    flags = [*SANITIZERS, "-O0", "-w", "-march=native", *BRANCHES[branch]]
    command = [*compiler.command, *flags, str(source), "-o", str(program), "-lm"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr[:3000]
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    assert 0.01 < float(done.stdout) < 100.0


def _has_sanitizers(folder: Path, command: tuple[str, ...]) -> bool:
    source, program = folder / "trial.c", folder / "trial"
    source.write_text("int main(void) { return 0; }\n", encoding="ascii")
    built = subprocess.run(
        [*command, *SANITIZERS, str(source), "-o", str(program)], capture_output=True, check=False
    )
    return built.returncode == 0 and subprocess.run([str(program)], check=False).returncode == 0
