"""Sweeps: many cases of one problem, evaluated by many workers; an interrupted sweep resumes.

* definition.py   sweep files; sections.py: their sections; design.py: grids, lists and draws, units of work
* evaluate.py     evaluation of units by kind of case, on local processes; cluster.py: on Dask
* collisions.py   batches of collisions in compiled code; states and measures of one: `impactopt.collide`
* store.py        finished units on disk; table.py: the table of results
* progress.py     progress of a sweep
* running.py      run of a sweep
"""

from impactopt.sweeps.definition import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.progress import SweepProgress
from impactopt.sweeps.running import SweepResult, sweep

__all__ = ["Sweep", "SweepProgress", "SweepResult", "read_sweep_file", "sweep", "sweep_from_data"]
