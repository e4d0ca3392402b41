"""Problem files with something wrong: in their bytes, their values, their keys, their structure."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.attack_cases import Found, Generator, attempt, odd_number, pick
from fuzz.attack_sound import wrong_with_problem
from impactopt.files.named_problems import problem_file, problem_names
from impactopt.files.problem_file import load_problem
from impactopt.files.toml import read_toml, write_toml

Change = Callable[[Generator, dict[str, Any]], bool]

# a word that a file says is kept for reading a case: longer ones make a report unreadable
_WORDS = (
    "", " ", "x", "nan", "inf", "-", "a" * 5000, "é" * 50, "\u202e", "\x1b[31m", "..", "/", "~",
    "~nobody/x",
    "{{scripts}}", "%s", "$HOME", "punch\n", "'", '"', "\\", "1e400", "true", "None", "hammer", "ready",
    "talos", "planar_arm", "nail", "wall", "Hertz", "ipm", "sqp", "ipopt", "[[", "x.urdf", "\x00",
)  # fmt: skip


def odd_text(rng: Generator) -> str:
    """A text that nobody means."""
    return str(pick(rng, _WORDS))


def texts(robots: tuple[str, ...] = ()) -> list[str]:
    """The problem files of the package, of all robots or of some."""
    found = [problem_file(name).read_text(encoding="utf-8") for name in problem_names()]
    return [t for t in found if not robots or any(f'"{robot}"' in t for robot in robots)]


def attack_file(text: str, folder: Path, rng: Generator) -> Found:
    """One file with something wrong: is it refused, or sound?"""
    content, deadly = mutated_file(text, rng)
    path = folder / "problem.toml"
    path.write_bytes(content)

    def work() -> str:
        problem = load_problem(path)
        return f"it is called sound with {deadly}" if deadly else wrong_with_problem(problem)

    return attempt("file", content.decode(errors="replace"), work)


def mutated_file(text: str, rng: Generator) -> tuple[bytes, str]:
    """(the bytes of a file with something wrong, what makes it wrong for certain or "")."""
    if rng.random() < 0.25:
        return spoil_bytes(text.encode(), rng), ""
    data = read_toml(text)
    deadly = ""
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        deadly = spoil_data(data, rng) or deadly
    if deadly and not _still_there(data, deadly):
        deadly = ""
    try:
        return write_toml(data).encode("utf-8", "surrogatepass"), deadly
    except (RecursionError, UnicodeError):
        return spoil_bytes(text.encode(), rng), ""


# ------------------------------------------------------------ bytes
def spoil_bytes(content: bytes, rng: Generator) -> bytes:
    """Bytes changed, left out, put in, said twice, or cut off."""
    made = bytearray(content)
    for _ in range(int(rng.integers(1, 6))):
        if not made:
            break
        at, long = int(rng.integers(len(made))), int(rng.integers(1, 40))
        kind = rng.integers(6)
        if kind == 0:
            made[at] = int(rng.integers(256))
        elif kind == 1:
            del made[at : at + long]
        elif kind == 2:
            made[at:at] = bytes(rng.integers(0, 256, long, dtype=np.uint8))
        elif kind == 3:
            made[at:at] = made[at : at + long]
        elif kind == 4:
            made[at:at] = pick(rng, (b"[", b"]", b'"', b"=", b"\n", b"{", b"}", b"[[", b"#", b"'''",
            b"9" * 300, b"-",
                                     b"." * 40, b"nan", b"\xff\xfe", b"\x00", b"[a.b.c]\n",
                                     b"e999"))  # fmt: skip
        elif rng.random() < 0.2:
            del made[at:]
    return bytes(made)


# ------------------------------------------------------------ data
def spoil_data(data: dict[str, Any], rng: Generator) -> str:
    """Change one thing in a file's data; what it is if no file with it can be sound."""
    tables, values = _places(data)
    kind = rng.integers(8)
    if kind >= 4 and values:  # most often a value
        table, key = pick(rng, values)
        return _other_value(table, key, rng)
    table = pick(rng, tables)
    if kind == 0:
        table[odd_text(rng) or "x"] = _odd_value(rng)
    elif kind == 1 and table:
        del table[pick(rng, list(table))]
    elif kind == 2 and table:
        key = pick(rng, list(table))
        name = str(key)
        at = int(rng.integers(len(name) + 1))
        table[name[:at] + str(rng.choice(["x", "_", "", "-m"])) + name[at:]] = table.pop(key)
    elif table:
        other = pick(rng, tables)
        key = pick(rng, list(table))
        # a table in itself would have no end
        if isinstance(key, str):
            other[str(key)] = copy.deepcopy(table[key])
    return ""


def _other_value(table: Any, key: Any, rng: Generator) -> str:
    old = table[key]
    if isinstance(old, bool) or not isinstance(old, (int, float)) or rng.random() < 0.2:
        table[key] = _odd_value(rng)
        return ""
    table[key] = odd_number(rng, float(old))
    if isinstance(old, int) and abs(table[key]) < 2**62 and rng.random() < 0.7:
        table[key] = int(table[key])
    return f"{key} = nan" if np.isnan(table[key]) else ""


def _odd_value(rng: Generator) -> Any:
    kind = rng.integers(7)
    if kind == 0:
        return odd_text(rng)
    if kind == 1:
        return odd_number(rng)
    if kind == 2:
        return [odd_number(rng) for _ in range(int(rng.integers(0, 6)))]
    if kind == 3:
        return {odd_text(rng) or "x": odd_number(rng)}
    if kind == 4:
        return bool(rng.integers(2))
    if kind == 5:
        return int(rng.integers(-(2**62), 2**62))
    value: Any = odd_number(rng)
    for _ in range(int(rng.choice([2, 5, 40]))):
        value = [value] if rng.random() < 0.5 else {"a": value}
    return value


def _places(data: Any) -> tuple[list[dict[str, Any]], list[tuple[Any, Any]]]:
    """All tables; and all values that are none, as (their table or list, their key or index)."""
    tables: list[dict[str, Any]] = []
    values: list[tuple[Any, Any]] = []
    left = [data]
    while left:
        thing = left.pop()
        if isinstance(thing, dict):
            tables.append(thing)
        for key, value in list(thing.items()) if isinstance(thing, dict) else list(enumerate(thing)):
            if isinstance(value, (dict, list)) and value:
                left.append(value)
            else:
                values.append((thing, key))
    return tables, values


def _still_there(data: Any, deadly: str) -> bool:
    """Whether a later change has left what makes the file wrong."""
    _, values = _places(data)
    found = [table[key] for table, key in values]
    return any(isinstance(x, float) and np.isnan(x) for x in found)
