"""A whole-body controller for replays: what a laboratory has between a plan and its robot's drives.

* settings.py   its numbers
* sensors.py    what encoders, an inertial unit and the striking hand's force sensor tell it
* estimate.py   from there to the state of the robot
* setpoint.py        what it tracks at one instant
* tracking_reference.py     what it tracks, by what it has felt of the blow
* recovery.py   how it comes to rest after the blow
* constrained_dynamics.py       accelerations and sole wrenches as functions of the torques
* cones.py      what wrenches soles can have, and where they are pressed
* clearance.py  near bodies slow down before they touch
* quadratic.py  its QP in OSQP, in place
* whole_body.py the controller, and its tasks: squared errors, weighed against each other
"""

from impactopt.simulation.controller.settings import CONTROLLERS, ControllerSettings, controller_of
from impactopt.simulation.controller.whole_body import WholeBodyController

__all__ = ["CONTROLLERS", "ControllerSettings", "WholeBodyController", "controller_of"]
