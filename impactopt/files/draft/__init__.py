"""Drafts of problem files from a URDF or MJCF alone: `impactopt new --urdf FILE`.

* limbs.py              classifies joints as legs, arms, fingers and wheels
* default_drives.py     guesses the drive parameters that the file lacks
* robot.py              finds the description and makes a robot of it
* soles.py, strikers.py   find soles and strikers in the links' shapes and frames
* postures.py           finds standing postures and bent arms
* hits.py               chooses targets and contact laws
* strong.py             finds the strongest postures of a bolted arm
* target_placement.py   places a target within reach of other arms
* drafting.py           writes the problem file, with a comment to each guess
"""
