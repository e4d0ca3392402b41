"""Command lines with something wrong, and saved results that were damaged: none may end in a traceback.

No command here plans: what takes long by itself is not what is looked for.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.attack_cases import Found, Generator, attempt, odd_number, pick
from fuzz.attack_files import mutated_file, spoil_bytes, texts
from impactopt.cli.command import BUG

RESULT = "result"
_PROBLEM = "arm_planar"
# commands as they should be: FILE is a problem file with something wrong, RESULT a damaged one
_LINES = (
    "check FILE",
    "check arm_planar --set target.mass=8 --json",
    "check arm7 --set problem.point.0=0.5",
    "check punch_standin",
    "collide FILE --speed 1.0 --json --quiet",
    "collide arm_planar --speed 2 --posture ready --model sdc --quiet",
    "collide arm_planar --speed 2 --model virtual-mass --freezes 0 --quiet --json",
    "collide arm_planar --speed 1 --set contact.stiffness=1e5 --quiet",
    "collide RESULT --quiet --json",
    "new arm_planar",
    "new --reference",
    "new --json",
    "problems --json",
    "problems",
    "robots --json",
    "show RESULT --out page.html",
    "show RESULT --problem FILE",
    "show planar_arm --out page.html",
    "show FILE --out page.html",
    "validate RESULT --engine pinocchio --quiet --json",
    "validate RESULT --engine pinocchio --missing --out replay --quiet",
    "validate RESULT --engine mujoco --mass 2 --settle 0.1 --step 0.001 --quiet",
    "validate RESULT --problem FILE --quiet",
    "export RESULT --to csv --rate 100 --out exported",
    "export RESULT --to ros2 --joints wrist,elbow,shoulder --json",
    "export RESULT --to mcap --problem FILE",
    "export RESULT --to mujoco --out exported",
    "export RESULT --to mjlab --json",
    "compare RESULT ../../../result --out compared",
    "compare RESULT ../../../result --json",
    "solve FILE --time-limit 0",
    "solve missing.toml --starts 2 --seed 1",
    "strike missing.toml --starts 2",
    "sweep FILE --out sweep",
    "--version",
    "--help",
)
# all of them stay in the folder that the command runs in
_WORDS = (
    "", " ", "x", "-", "--", "-h", "--json", "--quiet", "-v", "-q", "--set", "--out", "a" * 4000,
    "a\x00b", "\x1b[31mred", "\u202e",
    "é", "nan", "inf", "-1", "1e400", "1" * 500, "0", "1e-300", "target.mass=nan", "target.mass=-1", "=",
    "a=",
    "=1", "target=1", "target.mass", "problem.point=[1,2]", "problem.point.0=" + "9" * 400,
    "robot.kp=1e300",
    "contact.stiffness=[[[[1]]]]", "a.b.c.d=1", "problem.point.9=1", "[=", "x.toml", "folder", "pipe.toml",
    "empty.toml", "--model", "full", "--posture", "ready", "--freezes", "1000000", "--speed", "--step",
    "--settle", "--payload", "1e-12", "--missing", "--problem", "--engine", "../x.toml", "missing/x/y",
    "--to", "--rate", "--joints", "shoulder,shoulder",
)  # fmt: skip


def make_result(folder: Path) -> Path:
    """A saved result to damage: the plan of a small problem, replayed on fixed soles."""
    from impactopt.files.output import record_of, save_record
    from impactopt.files.problem_file import read_problem_file
    from impactopt.planning.solve import solve

    read = read_problem_file(_PROBLEM)
    solution = solve(read.build())
    record = record_of(
        solution, simulation=solution.validate(engine="pinocchio"), problem=read.text, problem_path=read.path
    )
    save_record(record, folder / RESULT)
    return folder / RESULT


def attack_command(result: Path, folder: Path, rng: Generator) -> Found:
    """One command line, run in a new folder in this process."""
    from typer.testing import CliRunner

    from impactopt.cli.app import app

    with _inside(folder, rng) as here:
        words = str(pick(rng, _LINES)).split()
        told = []
        if "FILE" in words:
            text = pick(rng, [t for t in texts(("planar_arm", "arm7")) if len(t) < 20_000])
            (here / "FILE.toml").write_bytes(mutated_file(text, rng)[0])
            words = ["FILE.toml" if word == "FILE" else word for word in words]
        if "RESULT" in words:
            shutil.copytree(result, here / "RESULT")
            told.append(damage(here / "RESULT", rng))
        if words[-1] != "nothing":
            words = _spoil_words(words, rng)
        if words and words[0] in ("solve", "strike", "drive", "sweep"):
            words = words[:1] + ["missing.toml"] * (words[1:2] != ["FILE.toml"]) + words[1:]

        def work() -> str:
            done = CliRunner().invoke(app, words)
            error = done.exception
            if error is not None and not isinstance(error, SystemExit):
                raise error
            if done.exit_code == BUG:
                raise Traceback(_last_lines(done.output))
            if "\x1b[31mred" in done.output:
                return "a terminal is given what it obeys"
            return ""

        return attempt("command", " ".join([repr(words), *told])[:2000], work)


class Traceback(RuntimeError):
    """A command's own report of its fault."""


def _last_lines(output: str) -> str:
    """The last place in a printed traceback, and its error."""
    lines = [
        line.strip() for line in output.splitlines() if line.strip() and not line.startswith("error: this")
    ]
    places = [line for line in lines if line.startswith("File ") and "impactopt" in line]
    where = places[-1].rpartition("impactopt/")[2] if places else ""
    return f"{where}: {lines[-1] if lines else ''}"


@contextlib.contextmanager
def _inside(folder: Path, rng: Generator) -> Iterator[Path]:
    """A new folder, some levels down, to run in; it is gone afterwards. Home is there too."""
    before, home = Path.cwd(), os.environ.get("HOME")
    top = folder / f"run{rng.integers(1 << 60)}"
    here = top / "a" / "b"
    here.mkdir(parents=True)
    (here / "folder").mkdir()
    (here / "empty.toml").write_text("", encoding="utf-8")
    with contextlib.suppress(AttributeError, OSError):
        os.mkfifo(here / "pipe.toml")
    cache = os.environ.get("IMPACTOPT_CACHE") or os.environ.get("XDG_CACHE_HOME")
    if cache:  # functions that are compiled stay where they are
        os.environ["HOME"] = str(here)
    os.chdir(here)
    try:
        yield here
    finally:
        os.chdir(before)
        if cache and home is not None:
            os.environ["HOME"] = home
        shutil.rmtree(top, ignore_errors=True)


def _spoil_words(words: list[str], rng: Generator) -> list[str]:
    words = list(words)
    for _ in range(int(rng.choice([0, 1, 1, 2, 3]))):
        at = int(rng.integers(len(words) + 1))
        kind = rng.integers(5)
        if kind == 0 and words:
            del words[min(at, len(words) - 1)]
        elif kind == 1:
            words.insert(at, str(pick(rng, _WORDS)))
        elif kind == 2 and words:
            words[min(at, len(words) - 1)] = str(pick(rng, _WORDS))
        elif kind == 3:
            words += ["--set", f"{pick(rng, _KEYS)}={_value(rng)}"]
        elif words:
            k = min(at, len(words) - 1)
            words[k] = f"{odd_number(rng)!r}"
    # nothing is opened in a browser
    return [word for word in words if word != "--open"]


_KEYS = (
    "target.mass", "target.mass_kg", "target.resistance", "target.kind", "contact.stiffness",
    "contact.damping", "contact.law",
    "problem.point", "problem.point.0", "problem.normal", "problem.robot", "problem.start",
    "problem.striker", "swing.duration",
    "swing.intervals", "follow.duration", "terms.hand_orientation.angle", "collision.duration",
    "solver.name", "robot.kp", "robot",
    "solver.ipopt.tol", "objectives.impulse.weight", "scenarios", "x",
)  # fmt: skip


def _value(rng: Generator) -> str:
    return str(
        pick(rng, (f"{odd_number(rng)!r}", "[]", "[1, 2, 3]", "{}", '"x"', "true", "[0.1, nan]", "x y"))
    )


# ------------------------------------------------------------ saved results
def damage(result: Path, rng: Generator) -> str:
    """Something wrong with a result's files; what, in words."""
    kind = rng.integers(8)
    numbers, summary = result / "solution.npz", result / "summary.json"
    if kind == 0:
        content = numbers.read_bytes()
        numbers.write_bytes(content[: int(rng.integers(len(content)))])
        return "numbers cut off"
    if kind == 1:
        numbers.write_bytes(spoil_bytes(numbers.read_bytes(), rng))
        return "other bytes of numbers"
    if kind == 2:
        summary.write_bytes(spoil_bytes(summary.read_bytes(), rng))
        numbers.unlink(missing_ok=bool(rng.integers(2)))
        return "other bytes of the summary, no numbers"
    if kind == 3:
        return "as it was"
    with zipfile.ZipFile(numbers) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name = str(pick(rng, sorted(parts)))
    if kind == 4:
        del parts[name]
        told = f"no {name}"
    elif kind == 5:
        parts[name] = spoil_bytes(parts[name][:4000], rng) + parts[name][4000:]
        told = f"other bytes of {name}"
    else:
        array = np.load(io.BytesIO(parts[name]), allow_pickle=False)
        made = _other_array(array, rng)
        written = io.BytesIO()
        np.save(written, made, allow_pickle=False)
        parts[name] = written.getvalue()
        told = f"{name}: {made.dtype} {made.shape} for {array.dtype} {array.shape}"
    with zipfile.ZipFile(numbers, "w") as archive:
        for key, content in parts.items():
            archive.writestr(key, content)
    return told


def _other_array(array: Any, rng: Generator) -> Any:
    """An array of another shape, type or content; of text, JSON with another value."""
    if array.dtype.kind == "U" and array.size == 1:
        return np.array(_other_text(str(array.reshape(-1)[0]), rng))
    kind = rng.integers(6)
    if kind == 0:
        return array[: max(1, len(array) // 2)] if array.ndim and len(array) else np.zeros(3)
    if kind == 1:
        return array.T[..., None]
    if kind == 2 and array.dtype.kind in "fiu":
        made = array.astype(float).copy()
        if made.size:
            made.reshape(-1)[int(rng.integers(made.size))] = odd_number(rng)
        return made
    if kind == 3:
        return array.astype(str)
    if kind == 4:
        return np.zeros(0)
    return (array.astype(float) * odd_number(rng)) if array.dtype.kind in "fiu" else np.array(["x"])


def _other_text(text: str, rng: Generator) -> str:
    try:
        data = json.loads(text)
    except ValueError:
        return spoil_bytes(text.encode(), rng).decode(errors="replace").replace("\x00", "")
    if isinstance(data, dict) and data:
        key = str(pick(rng, list(data)))
        data[key] = pick(rng, (None, [], {}, "x", odd_number(rng), {"a": [1]}, "\x1b[31mred", [[0.0]], True))
    return json.dumps(data)
