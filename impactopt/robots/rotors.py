"""Rotor inertias that drives can have, by their torque."""

from __future__ import annotations

__all__ = ["HEAVIEST_ROTOR", "LIGHTEST_ROTOR", "USUAL_ROTOR"]

# [s2] armature (rotor inertia x gear ratio^2) over torque limit. Known robots have 2e-4 (G1: gears of
# 14 to 22) to 3e-3 (arms: 160). Motors without gears have some 1e-5 to 1e-4: 10 N m on 1e-3 kg m2. Large
# industrial arms have 2e-2: at 0.1 a drive takes a second to 10 rad/s by itself.
LIGHTEST_ROTOR, USUAL_ROTOR, HEAVIEST_ROTOR = 1e-6, 1e-3, 0.1
