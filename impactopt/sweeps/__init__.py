"""Sweeps: many cases of one problem, done by many workers, and none of them lost.

* definition.py   sweep files; sections.py: their sections; design.py: grids, lists and draws, units of work
* evaluate.py     from a unit to its rows: kinds of cases, on a process of this machine; cluster.py: on Dask
* collisions.py   batches of collisions in compiled code; states and measures of one: `impactopt.collide`
* store.py        finished units on disk; table.py: the result
* progress.py     progress of a sweep
* running.py      all of it together
"""

from impactopt.sweeps.definition import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.progress import SweepProgress
from impactopt.sweeps.running import SweepResult, sweep

__all__ = ["Sweep", "SweepProgress", "SweepResult", "read_sweep_file", "sweep", "sweep_from_data"]
