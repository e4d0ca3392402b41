"""Contact laws (force from penetration) and targets (motion from force).

One class a file, in `laws/` and `targets/`.
"""

from impactopt.contact import laws, targets
from impactopt.contact.fields import power
from impactopt.contact.friction import ContactFriction
from impactopt.contact.laws import *  # noqa: F403
from impactopt.contact.targets import *  # noqa: F403

__all__ = ["ContactFriction", "power"]
__all__ += laws.__all__
__all__ += targets.__all__
