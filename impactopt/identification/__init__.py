"""Contact laws from measured blows: least squares on the package's own collision.

* log.py       a log's columns, and what is wrong with them
* blows.py     the contacts in it, each with the samples that are fitted
* lump.py      the collision of two masses as histories, for many numbers at once
* fitting.py   one law's numbers, with intervals; start.py: where the search for them begins
* result.py    what comes out; identify.py puts all together
"""

from impactopt.identification.identify import identify
from impactopt.identification.log import ImpactLog, read_log
from impactopt.identification.result import Estimate, Identification, LawFit

__all__ = ["Estimate", "Identification", "ImpactLog", "LawFit", "identify", "read_log"]
