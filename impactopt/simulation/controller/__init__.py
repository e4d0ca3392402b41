"""A whole-body controller for replays, between the plan and the robot's drives.

* settings.py             its parameters
* sensors.py              encoders, inertial unit and the hand's force sensor; state estimate
* tracking_reference.py   reference, switched by the sensed impact, and the recovery after it
* clearance.py            constraints that slow down bodies before they touch
* whole_body.py           the controller: QP, tasks, and wrench cones of the soles
"""

from impactopt.simulation.controller.settings import CONTROLLERS, ControllerSettings, controller_of
from impactopt.simulation.controller.whole_body import WholeBodyController

__all__ = ["CONTROLLERS", "ControllerSettings", "WholeBodyController", "controller_of"]
