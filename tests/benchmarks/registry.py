"""The benches, and the paper's tables and figures, by name.

A new one is a module here or in `paper/` with a function ``run(say, **options) -> Report`` whose
options all have defaults, a line here, and for a bench a command in `__main__.py`.
"""

from __future__ import annotations

import importlib
from typing import Any

from benchmarks.report import Report, Say, timed
from impactopt.errors import InputError, did_you_mean

# name -> module; `python -m benchmarks all` runs them in this order
BENCHES = {
    "truth": "benchmarks.truth",
    "contacts": "benchmarks.contacts",
    "robustness": "benchmarks.robustness",
    "replay": "benchmarks.replay",
    "baselines": "benchmarks.baselines",
    "margins": "benchmarks.margins",
    "feedback": "benchmarks.feedback",
    "models": "benchmarks.models",
    "moved": "benchmarks.moved",
    "rounding": "benchmarks.rounding",
    "causes": "benchmarks.causes",
    "fidelity": "benchmarks.fidelity",
    "freezes": "benchmarks.freezes",
    "gains": "benchmarks.gains",
    "machine": "benchmarks.machine",
    "softness": "benchmarks.softness",
    "virtual-base": "benchmarks.virtual_base",
    "collision": "benchmarks.collision",
    "scaling": "benchmarks.scaling",
    "skip": "benchmarks.skip",
    "stability": "benchmarks.stability",
    "attack": "fuzz.attack",
    "solve": "benchmarks.solve",
    "zoo": "benchmarks.zoo",
    "robots": "benchmarks.robots",
}
# modules in `paper`; `python -m benchmarks.paper all` runs them in this order
REPRODUCED = ("table1", "table2", "table3", "fig3", "fig4", "fig7")


def run_bench(name: str, say: Say, **options: Any) -> Report:
    """Run one bench.

    Raises
    ------
    InputError : there is no bench of that name, or it cannot be run so.
    """
    if name not in BENCHES:
        raise InputError(
            f"there is no bench {name!r}{did_you_mean(name, BENCHES)}: there are {', '.join(BENCHES)}"
        )
    return _run(BENCHES[name], say, **options)


def names_of(name: str) -> list[str]:
    """The tables and figures that a name stands for: itself, or `all`.

    Raises
    ------
    InputError : there is nothing of that name.
    """
    if name == "all":
        return list(REPRODUCED)
    if name not in REPRODUCED:
        known = [*REPRODUCED, "all"]
        raise InputError(f"nothing to reproduce is {name!r}{did_you_mean(name, known)}: {', '.join(known)}")
    return [name]


def reproduce(name: str, say: Say) -> Report:
    """One table or figure, ours beside the paper's.

    Raises
    ------
    InputError : there is none of that name, or it cannot be made.
    """
    (only,) = names_of(name)
    return _run(f"benchmarks.paper.{only}", say)


def _run(module: str, say: Say, **options: Any) -> Report:
    # modules are imported when they run: they pull in all that solves, simulates and draws
    return timed(importlib.import_module(module).run, say, **options)
