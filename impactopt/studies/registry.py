"""The benches, and the paper's tables and figures, by name.

A new one is a module in `bench/` or `reproduce/` with a function ``run(say, **options) -> Report`` whose
options all have defaults, a line here, and for a bench a command in `bench_command.py`.
"""

from __future__ import annotations

import importlib
from typing import Any

from impactopt.errors import InputError, did_you_mean
from impactopt.studies.report import Report, Say, timed

__all__ = ["BENCHES", "REPRODUCED", "names_of", "reproduce", "run_bench"]

# name -> module in `bench`; `impactopt bench all` runs them in this order
BENCHES = {
    "truth": "truth",
    "contacts": "contacts",
    "robustness": "robustness",
    "replay": "replay",
    "baselines": "baselines",
    "margins": "margins",
    "feedback": "feedback",
    "models": "models",
    "moved": "moved",
    "causes": "causes",
    "fidelity": "fidelity",
    "freezes": "freezes",
    "gains": "gains",
    "machine": "machine",
    "softness": "softness",
    "virtual-base": "virtual_base",
    "collision": "collision",
    "scaling": "scaling",
    "skip": "skip",
    "stability": "stability",
    "attack": "attack",
    "solve": "solve",
    "zoo": "zoo",
}
# modules in `reproduce`; `impactopt reproduce all` runs them in this order
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
    return _run(f"bench.{BENCHES[name]}", say, **options)


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
    return _run(f"reproduce.{only}", say)


def _run(module: str, say: Say, **options: Any) -> Report:
    # modules are imported when they run: they pull in all that solves, simulates and draws
    return timed(importlib.import_module(f"impactopt.studies.{module}").run, say, **options)
