"""Cases and helpers that several tests share: those of `test_codegen.py`."""

from __future__ import annotations

import numpy as np
import pinocchio as pin


def model() -> pin.Model:
    made = pin.Model()
    for name, axis in (("a", [0, 0, 1.0]), ("b", [0, 0.6, 0.8])):
        joint = made.addJoint(
            made.njoints - 1,
            pin.JointModelRevoluteUnaligned(*axis),
            pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.3])),
            name,
        )
        made.appendBodyToJoint(
            joint, pin.Inertia(2.0, np.array([0.1, 0, 0.2]), 0.1 * np.eye(3)), pin.SE3.Identity()
        )
    made.addFrame(pin.Frame("tip", 2, 0, pin.SE3(np.eye(3), np.array([0, 0, 0.4])), pin.FrameType.OP_FRAME))
    return made
