"""Contact laws from measured blows: least squares on the package's own collision.

* log.py       a log's columns, what is wrong with them, and the contacts in it
* fitting.py   one law's numbers, with intervals, by the collision of two masses as histories
* start.py     where the search for them begins
* result.py    what comes out; identify.py puts all together
"""

from impactopt.identification.identify import identify
from impactopt.identification.log import ImpactLog, read_log
from impactopt.identification.result import Estimate, Identification, LawFit

__all__ = ["Estimate", "Identification", "ImpactLog", "LawFit", "identify", "read_log"]
