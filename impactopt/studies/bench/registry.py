"""The benches by name.

A new bench is a module here with a function ``run(say, **options) -> Report`` whose options all have
defaults, a line in BENCHES, and a command in `command.py`.
"""

from __future__ import annotations

import importlib
from typing import Any

from impactopt.errors import InputError, did_you_mean
from impactopt.studies.bench.report import Report, Say, timed

# name -> module of this package; `impactopt bench all` runs them in this order
BENCHES = {
    "truth": "truth",
    "robustness": "robustness",
    "replay": "replay",
    "baselines": "baselines",
    "margins": "margins",
    "fidelity": "fidelity",
    "freezes": "freezes",
    "virtual-base": "virtual_base",
    "collision": "collision",
    "scaling": "scaling",
    "skip": "skip",
    "stability": "stability",
    "attack": "attack",
    "solve": "solve",
    "zoo": "zoo",
}


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
    # modules are imported when they run: they pull in all that solves, simulates and draws
    run = importlib.import_module(f"impactopt.studies.bench.{BENCHES[name]}").run
    return timed(run, say, **options)
