"""Symbolic rigid-body kinematics and dynamics (CasADi SX), driven by a `pin.Model`.

Conventions are Pinocchio's: spatial vectors are [linear; angular], the free-flyer's velocity is in the base's
own frame, frame Jacobians and velocities are LOCAL_WORLD_ALIGNED (at the frame's origin, along the world's
axes).
"""

from impactopt.robots.rigid_body._body import RigidBody
from impactopt.robots.rigid_body._dynamics import Factor

__all__ = ["Factor", "RigidBody"]
