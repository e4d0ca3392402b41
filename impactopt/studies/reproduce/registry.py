"""The paper's tables and figures by name.

A new one is a module here with a function ``run(say, **options) -> Report`` whose options all have defaults,
and a line in REPRODUCED.
"""

from __future__ import annotations

import importlib

from impactopt.errors import InputError, did_you_mean
from impactopt.studies.bench.report import Report, Say, timed

# name -> module of this package; `impactopt reproduce all` runs them in this order
REPRODUCED = {
    "table1": "table1",
    "table2": "table2",
    "table3": "table3",
    "fig3": "fig3",
    "fig4": "fig4",
    "fig7": "fig7",
}


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
    # modules are imported when they run: they pull in all that simulates and draws
    return timed(importlib.import_module(f"impactopt.studies.reproduce.{REPRODUCED[only]}").run, say)
