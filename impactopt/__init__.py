"""Impact motions of humanoid robots: planned by the impulse they deliver, checked in full dynamics.

Names are imported when they are first used, so that `import impactopt` and the command line start at once.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it
_EXPORTS = {
    "CacheWarning": "errors",
    "InputError": "errors",
    "NoCompilerWarning": "errors",
    "RigidBody": "rigid_body",
    "Robot": "robot",
    "Sole": "robot",
    "Striker": "robot",
    "g1": "presets",
    "load_robot": "presets",
    "talos": "presets",
}

__all__ = ["__version__", *sorted(_EXPORTS)]


def __getattr__(name: str) -> Any:
    module = _EXPORTS.get(name)
    if module is None:
        from impactopt.errors import did_you_mean

        raise AttributeError(f"module 'impactopt' has no attribute {name!r}{did_you_mean(name, _EXPORTS)}")
    value = getattr(importlib.import_module(f"impactopt.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
