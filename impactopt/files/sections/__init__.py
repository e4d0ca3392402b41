"""Sections of files in TOML: robot, target and contact, types of values, and all mistakes in one message.

* values.py       base class of sections, types and ranges of the keys' values
* robot.py        section [robot]
* collision.py    the sections that a collision needs, and what they build
* diagnostics.py  mistakes of a file: place, probable intention, permitted values
* reading.py      text to checked sections, with changed values by key paths
"""
