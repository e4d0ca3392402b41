"""The same collisions with the compiler, with one that fails, and without: the same numbers, or refused.

A failing compiler is one that makes a small file and nothing of ours, as on a full disk. Where clang is
installed too it is another build; where it is not, that is said.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fuzz.attack_collisions import draw, model_of
from fuzz.attack_equation import Blow
from impactopt.errors import InputError

Array = NDArray[np.float64]

ROBOTS = ("planar_arm", "arm7", "standin")
SAME = 1e-6  # relative, of the impulse or of a plastic blow's
BUILDS = ("compiler", "failing compiler", "no compiler", "clang")
_FAILING = """#!/bin/sh
case "$*" in *trial*|*version*) exec {cc} "$@";; esac
echo "error: No space left on device" >&2
exit 1
"""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Collisions of one model: how many had the same numbers in every build, had not, or were refused in one;
    what was not the same, in words; the largest difference, relative."""

    collisions: int = 0
    off: int = 0
    refused: int = 0
    faults: tuple[str, ...] = field(default=())
    largest: float = 0.0


def builds() -> tuple[str, ...]:
    """Those that this machine has."""
    has = {"clang": "clang", "compiler": "cc", "failing compiler": "cc"}
    return tuple(build for build in BUILDS if build not in has or shutil.which(has[build]))


def compare(robot: str, law: str, target: str, count: int, seed: int) -> Compared:
    """So many random collisions, each alone and as a row, in every build."""
    rng = np.random.default_rng([seed, *map(ord, robot + law + target)])
    blows = [draw(model_of(robot, law, target), law, target, rng) for _ in range(count)]
    found = {}
    for build in builds():
        with _compiling(build):
            found[build] = _impulses(robot, law, target, blows)
    off, refused, faults, largest = 0, 0, [], 0.0
    for k, blow in enumerate(blows):
        numbers = {build: x for build, pair in found.items() for x in pair[:, k] if np.isfinite(x)}
        every = np.array([pair[:, k] for pair in found.values()])
        refused += bool(np.isnan(every).any())
        known = every[np.isfinite(every)]
        if not known.size:
            continue
        size = max(float(np.abs(known).max()), float(np.finfo(float).tiny))
        apart = float(np.ptp(known)) / size
        largest = max(largest, apart)
        if apart > SAME:
            off += 1
            faults.append(f"{robot}, {law}, {target}: {blow}: apart by {apart:.2g}: {numbers}")
    return Compared(collisions=count, off=off, refused=refused, faults=tuple(faults), largest=largest)


@contextlib.contextmanager
def _compiling(build: str) -> Iterator[None]:
    """The environment of a build; what a failing compiler leaves is gone afterwards."""
    kept = {name: os.environ.get(name) for name in ("CC", "IMPACTOPT_NO_COMPILER", "IMPACTOPT_CACHE")}
    with tempfile.TemporaryDirectory(prefix="impactopt-") as scratch:
        if build == "failing compiler":
            script = Path(scratch) / "cc"
            script.write_text(_FAILING.format(cc=shutil.which("cc")), encoding="utf-8")
            script.chmod(0o700)
            os.environ |= {"CC": str(script), "IMPACTOPT_CACHE": scratch}
        elif build == "no compiler":
            os.environ["IMPACTOPT_NO_COMPILER"] = "1"
        elif build == "clang":
            os.environ["CC"] = "clang"
        try:
            yield
        finally:
            for name, value in kept.items():
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


def _impulses(robot: str, law: str, target: str, blows: list[Blow]) -> Array:
    """(2, N): alone and as rows; NaN where refused."""
    model, out = model_of(robot, law, target), np.full((2, len(blows)), np.nan)
    for k, b in enumerate(blows):
        with contextlib.suppress(InputError):
            out[0, k] = model.collide(b.q, b.v, b.torque, require_separation=False, **b.numbers).impulse
        rows: dict[str, Any] = {"q": b.q[None], "v": b.v[None], "torque": b.torque[None]}
        rows |= {name: np.asarray(x)[None] for name, x in b.numbers.items()}
        with contextlib.suppress(InputError):
            out[1, k] = model.batch(outputs=("impulse",), threads=1, **rows)["impulse"][0]
    return out
