"""Bodies of the robot and of the world around it that can touch something.

* file_shapes.py    shapes of the links in the robot's own files
* convex_hulls.py   hulls of the links
* separation.py     smooth distances of pairs of hulls, with derivatives
* robot_bodies.py   collision geometry of a robot, pairs that can meet, corners that may touch first
* world.py          bodies of the target, the ground and the obstacles
* clearance.py      clearances of all bodies, with exact geometry

Numbers only: the constraints of a plan are in `transcription/clearance.py`.
"""
