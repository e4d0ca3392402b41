"""Mesh files as triangles."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import coal
import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.solids import Solid

__all__ = ["find_mesh", "read_mesh"]

Array = NDArray[np.float64]


def find_mesh(name: str, urdf: Path) -> Path:
    """The file of a mesh: a path from the URDF, or package://NAME/..., where a folder above it holds NAME.

    Packages are looked for in ROS's own folders too (ROS_PACKAGE_PATH, AMENT_PREFIX_PATH), and where
    example-robot-data is installed.

    Raises
    ------
    FileNotFoundError : there is none.
    """
    path = Path(name.removeprefix("package://").removeprefix("file://"))
    above = [*urdf.resolve().parents]
    places = [folder / path for folder in above]
    if name.startswith("package://"):  # the folder may be called otherwise than the package
        places += [folder.joinpath(*path.parts[1:]) for folder in above]
        places += [folder / path for folder in _package_folders()]
    for place in places if not path.is_absolute() else [path]:
        if place.is_file():
            return place
    raise FileNotFoundError(name)


def _package_folders() -> Iterator[Path]:
    """Where packages of meshes may be, beside a URDF's own folders."""
    for place in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield from (Path(place), Path(place).parent)  # it holds packages, or it is one
    for place in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(place) / "share"
    with contextlib.suppress(PackageNotFoundError):
        share = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share")))
        yield from (share, share / "example-robot-data" / "robots")


def read_mesh(path: Path, scale: Array) -> Solid:
    """The triangles of a mesh file: STL, or another kind that coal reads, such as Collada and OBJ."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if path.suffix.lower() == ".stl" and len(data) == 84 + 50 * count:  # binary; coal takes seconds for it
        facets = np.frombuffer(data, offset=84, dtype=[("at", "<f4", (4, 3)), ("attribute", "<u2")])
        vertices = facets["at"][:, 1:].reshape(-1, 3).astype(float)
        return Solid(vertices=scale * vertices, triangles=np.arange(3 * count).reshape(-1, 3))
    mesh = coal.MeshLoader().load(str(path), scale)
    corners = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return Solid(
        vertices=np.array(mesh.vertices()), triangles=np.array([[t[0], t[1], t[2]] for t in corners])
    )
