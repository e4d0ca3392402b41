"""Sweeps: many cases of one problem, done by many workers, and none of them lost.

* definition.py   sweep files: sections.py, varied_keys.py; design.py: grids, lists and draws
* units.py        what goes to a worker, and what comes back
* case_kinds.py   from a case's settings to its row; evaluate.py: on a worker; watchdog.py: in time
* collisions.py   rows of collisions in compiled code: at_contact.py, collision_keys.py, contact_states.py, scene.py,
                  measures.py
* local_pool.py      processes that do the units; cluster.py: Dask workers that do
* journal.py      finished units on disk; store.py: the directory; table.py: the result
* progress.py     how far a sweep is
* running.py      all of it together
"""

from impactopt.sweeps.definition import Sweep, read_sweep_file, sweep_from_data
from impactopt.sweeps.progress import SweepProgress
from impactopt.sweeps.running import SweepResult, sweep

__all__ = ["Sweep", "SweepProgress", "SweepResult", "read_sweep_file", "sweep", "sweep_from_data"]
