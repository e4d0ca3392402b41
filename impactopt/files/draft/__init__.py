"""A problem file drafted for one's own robot, from its URDF or MJCF alone: `impactopt new --urdf FILE`.

`description.py` finds the file; `limbs.py` says which joints are legs, arms, fingers and wheels;
`default_drives.py` fills in what the file lacks; `robot.py` makes the robot of that; `soles.py` and `strikers.py`
find soles and strikers in the links' shapes and frames; `postures.py` stands the robot up and bends its arms;
`strong.py` finds where a bolted arm hits hard, and `target_placement.py` puts a target within reach of the others;
`drafting.py` writes all of it, with a comment to each guess.
"""
