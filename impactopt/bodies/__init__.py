"""Bodies of the robot and of the world around it that can touch something.

* convex_hulls.py   hulls of the links, from the robot's own files
* separation.py     smooth distances of pairs of hulls, with derivatives
* striker_face.py   face of a striking link, and the corners that may touch first
* robot_bodies.py   collision geometry of a robot, and the pairs that can meet
* world.py          bodies of the target, the ground and the obstacles
* clearance.py      clearances of all bodies, with exact geometry

Numbers only: the constraints of a plan are in `transcription/clearance.py`.
"""
