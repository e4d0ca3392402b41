"""Robots: `Robot`, readers of URDF and MJCF, checks, and presets.

`presets.py` is where a robot of the package is added; `rigid_body/` has the symbolic dynamics.
"""
