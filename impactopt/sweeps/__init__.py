"""Sweeps: many cases of one problem, done by many workers, and none of them lost.

* definition.py   sweep files: sections.py, varied_keys.py; design.py: grids, lists and draws
* units.py        inputs and results of a worker
* case_kinds.py   from a case's settings to its row; evaluate.py: on a worker; watchdog.py: time limits
* collisions.py   batches of collisions in compiled code: collision_batch.py, collision_keys.py;
                  states and measures of one: `impactopt.collide`
* local_pool.py   pool of processes on this machine; cluster.py: Dask workers
* journal.py      finished units on disk; store.py: the directory; table.py: the result
* progress.py     progress of a sweep
* running.py      all of it together
"""

from impactopt.sweeps.definition import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.progress import SweepProgress
from impactopt.sweeps.running import SweepResult, sweep

__all__ = ["Sweep", "SweepProgress", "SweepResult", "read_sweep_file", "sweep", "sweep_from_data"]
