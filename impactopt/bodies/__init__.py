"""Bodies: what of a robot and of the world around it can touch something.

`convex_hulls.py` reads what links are made of from the robot's own files, as convex hulls; `fit.py` covers them
with spheres and puts planes about them, between which distances are simple functions; `robot_bodies.py` says
which pairs can meet; `world.py` has the bodies of the target, the ground and the obstacles; `clearance.py`
measures how far all of them are apart, with exact geometry. Numbers only: the rows of a plan are in
`transcription/apart.py`.
"""
