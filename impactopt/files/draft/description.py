"""The file that describes a robot: by path, or by its name in example-robot-data."""

from __future__ import annotations

from pathlib import Path

from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.robots.presets import example_robots

SUFFIXES = (".urdf", ".xml", ".mjcf", ".xacro")  # of files; a robot's name may have another dot


def find_description(given: str) -> Path:
    """The file at a path, or the URDF of a name in example-robot-data, such as "panda" or "ur5_robot".

    Raises
    ------
    InputError : there is none, or there are several; the message lists them.
    """
    path = Path(given).expanduser()
    if is_plain_file(path):
        return path
    if path.suffix.lower() in SUFFIXES or len(path.parts) != 1:
        raise InputError(f"there is no file {shortened(given, 300)}")
    known = _examples()
    if given in known:
        return known[given]
    near = sorted(name for name in known if name.startswith(f"{given}_"))
    if f"{given}_robot" in near or len(near) == 1:
        return known[f"{given}_robot" if f"{given}_robot" in near else near[0]]
    if near:
        raise InputError(f"example-robot-data has several robots {given!r}: {', '.join(near)}; name one")
    raise InputError(
        f"there is no file {shortened(given)!r}, and no such robot in example-robot-data"
        f"{did_you_mean(given, known)}; it has {', '.join(sorted(known))}"
    )


def _examples() -> dict[str, Path]:
    """URDFs by their names without suffix."""
    folder = example_robots("a robot by its name")
    return {path.stem: path for path in sorted(folder.glob("*/*/*.urdf"))}
