"""`Robot`: how one is read from its files, checked and built, and the presets.

Add a robot of the package in `presets.py`. `rigid_body/` has the symbolic dynamics of any of them.
"""
