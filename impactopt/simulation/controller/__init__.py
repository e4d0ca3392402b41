"""A whole-body controller for replays: what a laboratory has between a plan and its robot's drives.

* settings.py   its numbers
* sensors.py    what encoders, inertial unit and the hand's force sensor tell it, and the state by that
* tracking_reference.py   what it tracks, by what it has felt of the blow, and how it comes to rest after it
* clearance.py  near bodies slow down before they touch
* whole_body.py the controller: its QP, its tasks, and what wrenches soles can have
"""

from impactopt.simulation.controller.settings import CONTROLLERS, ControllerSettings, controller_of
from impactopt.simulation.controller.whole_body import WholeBodyController

__all__ = ["CONTROLLERS", "ControllerSettings", "WholeBodyController", "controller_of"]
