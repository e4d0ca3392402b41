"""Contact laws from measured impacts, by least squares on the package's own collision.

* log.py               logs and their checks, and the impacts in them
* fitting.py           fit of one law, with intervals, by the collision of two masses
* free_parameters.py   fitted parameters of a law, and their initial guesses
* result.py            result of an identification
* identify.py          the public function
"""

from impactopt.identification.identify import identify
from impactopt.identification.log import ImpactLog, read_log
from impactopt.identification.result import Estimate, Identification, LawFit

__all__ = ["Estimate", "Identification", "ImpactLog", "LawFit", "identify", "read_log"]
