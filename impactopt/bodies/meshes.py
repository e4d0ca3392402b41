"""Mesh files as triangles."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import coal
import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.solids import Solid

__all__ = ["find_mesh", "lack_of", "read_mesh"]

Array = NDArray[np.float64]
_POINTER = b"version https://git-lfs.github.com/spec/"


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
    """Folders that packages of meshes may be in, beside a URDF's own folders."""
    for place in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield from (Path(place), Path(place).parent)  # it holds packages, or it is one
    for place in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(place) / "share"
    with contextlib.suppress(PackageNotFoundError):
        share = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share")))
        yield from (share, share / "example-robot-data" / "robots")


def lack_of(name: str, urdf: Path) -> str:
    """Reason why a URDF's mesh cannot be used (`find_mesh`); "" if it can."""
    try:
        path = find_mesh(name, urdf)
        return _lack(path, path.stat().st_mtime_ns)
    except (OSError, ValueError):
        return "is not found"


@cache
def _lack(path: Path, _changed: int) -> str:
    try:
        read_mesh(path, np.ones(3))
    except (ValueError, RuntimeError, OSError) as error:
        return f"cannot be read: {error}"
    return ""


def read_mesh(path: Path, scale: Array) -> Solid:
    """The triangles of a mesh file: STL, or another kind that coal reads, such as Collada and OBJ.

    Raises
    ------
    ValueError, RuntimeError, OSError : it cannot be read, or there are no triangles in it.
    """
    solid = _read(path, scale)
    if not len(solid.triangles):
        raise ValueError("there are no triangles in it")
    if not np.isfinite(solid.vertices).all():
        raise ValueError("it has corners that are nowhere")
    return solid


def _read(path: Path, scale: Array) -> Solid:
    data = path.read_bytes()
    if data.startswith(_POINTER):
        raise ValueError("it is a pointer to large-file storage; get the file itself by `git lfs pull`")
    count = int.from_bytes(data[80:84], "little")
    if path.suffix.lower() == ".stl" and len(data) == 84 + 50 * count:  # binary; coal takes seconds for it
        facets = np.frombuffer(data, offset=84, dtype=[("at", "<f4", (4, 3)), ("attribute", "<u2")])
        vertices = facets["at"][:, 1:].reshape(-1, 3).astype(float)
        return Solid(vertices=scale * vertices, triangles=np.arange(3 * count).reshape(-1, 3))
    try:
        mesh = coal.MeshLoader().load(str(path), scale)
    except (ValueError, RuntimeError) as error:  # the reader's own words come after the file's name
        said = str(error).partition(str(path))[2].strip().splitlines()
        raise ValueError(said[0].rstrip(".") if said else "no reader of meshes takes it") from error
    corners = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return Solid(
        vertices=np.array(mesh.vertices()), triangles=np.array([[t[0], t[1], t[2]] for t in corners])
    )
