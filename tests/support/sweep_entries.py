"""Cases and helpers that several tests share: those of `test_sweep_store.py`."""

from __future__ import annotations

import numpy as np

from impactopt.sweeps.store import Entry


def entry(unit: int, count: int = 3) -> Entry:
    rng = np.random.default_rng(unit)
    return Entry(
        unit=unit,
        peak_mb=100.0 + unit,
        columns={
            "status": ["solved"] * count,
            "reason": (["", 'odd "text"\n', "unit\x00"] * count)[:count],
            "impulse_Ns": rng.normal(size=count),
            "iterations": np.arange(count),
            "missing": ([None, 0.1, None] * count)[:count],
        },
    )
