"""Solids as triangle meshes: primitives, mesh files, and simplification."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import coal
import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.arrays import Array, Index
from impactopt.codegen.files import kept

SELF_CONTAINED = (
    ".dae",
    ".obj",
    ".stl",
)  # formats whose geometry is in one file, so that a hash of it identifies it
# Weight of the mean of the merged vertices in `simplified`, relative to the quadric: without it the least
# squares problem of flat parts has no unique solution.
_MEAN_WEIGHT = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """Surface: vertices (n, 3) [m] and triangles (m, 3), indices counter-clockwise seen from outside."""

    vertices: Array
    triangles: Index

    def moved(self, rotation: Array, translation: Array) -> Solid:
        """Copy, rotated and translated."""
        return Solid(vertices=self.vertices @ rotation.T + translation, triangles=self.triangles)


def joined(solids: Sequence[Solid]) -> Solid:
    """Union of the surfaces as one solid."""
    counts = np.cumsum([0, *(len(s.vertices) for s in solids)])
    return Solid(
        vertices=np.concatenate([s.vertices for s in solids]),
        triangles=np.concatenate([s.triangles + n for s, n in zip(solids, counts[:-1], strict=True)]),
    )


def box(sides: ArrayLike) -> Solid:
    """Box with these sides (3,) [m], about the origin."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])]
    return Solid(vertices=signs * np.asarray(sides) / 2, triangles=np.array(triangles))


def rounded_box(sides: ArrayLike) -> Solid:
    """Superellipsoid |x/a|^6 + |y/b|^6 + |z/c|^6 = 1 in a box of these sides (3,) [m]."""
    round_ = sphere(1.0, sides=24)
    # Each vertex of the sphere is moved along its ray to the surface.
    size = (np.abs(round_.vertices) ** 6).sum(axis=1) ** (1 / 6)
    return Solid(vertices=round_.vertices / size[:, None] * np.asarray(sides) / 2, triangles=round_.triangles)


def cylinder(radius: float, length: float, *, tip: float = 1.0, sides: int = 20) -> Solid:
    """Cylinder along z about the origin [m]; tip : radius of its upper end over that of its lower one."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    up = np.array([0.0, 0.0, length / 2])
    # Lower ring, upper ring, then the middles of both ends.
    vertices = np.concatenate([radius * ring - up, radius * tip * ring + up, [-up, up]])
    k, n = np.arange(sides), (np.arange(sides) + 1) % sides
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    triangles = ((k, n, n + sides), (k, n + sides, k + sides), (n, k, bottom), (k + sides, n + sides, top))
    return Solid(vertices=vertices, triangles=np.concatenate([np.column_stack(t) for t in triangles]))


def sphere(radius: float, *, sides: int = 16) -> Solid:
    """Sphere of a radius [m] about the origin, with `sides` meridians."""
    rings, angle = sides // 2, 2 * np.pi * np.arange(sides) / sides
    polar = np.pi * np.arange(1, rings) / rings
    grid = np.stack(
        [
            np.outer(np.sin(polar), np.cos(angle)),
            np.outer(np.sin(polar), np.sin(angle)),
            np.outer(np.cos(polar), np.ones(sides)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    # Rings from north to south, then the two poles.
    vertices = radius * np.concatenate([grid, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    k, n = np.arange(sides), (np.arange(sides) + 1) % sides
    north, south, last = np.full(sides, len(grid)), np.full(sides, len(grid) + 1), (rings - 2) * sides
    triangles = [(north, k, n), (south, last + n, last + k)]
    for r in range(rings - 2):
        a, b = r * sides, (r + 1) * sides
        triangles += [(a + k, b + k, b + n), (a + k, b + n, a + n)]
    return Solid(vertices=vertices, triangles=np.concatenate([np.column_stack(t) for t in triangles]))


def capsule(radius: float, length: float, *, sides: int = 50) -> Solid:
    """Capsule of a radius about a line of a length along z, with its middle at the origin [m].

    sides : 4 k + 2, so that the sphere has an odd number of triangle rows; the middle row becomes the
        cylinder.
    """
    round_ = sphere(radius, sides=sides)
    # Each half of the sphere is moved outwards; a ring at z = 0 would stay behind.
    lift = np.sign(round_.vertices[:, 2:]) * [0.0, 0.0, length / 2]
    return Solid(vertices=round_.vertices + lift, triangles=round_.triangles)


def simplified(solid: Solid, cell: float) -> Solid:
    """Mesh with one vertex in each cube of side `cell` [m], nearest to the planes of all triangles there.

    Source: vertex clustering with quadric error; P. Lindstrom, "Out-of-core simplification of large polygonal
    models", SIGGRAPH 2000, 259-262.
    """
    v, t = solid.vertices, solid.triangles
    cube = np.floor((v - v.min(axis=0)) / cell).astype(np.int64)
    sizes = cube.max(axis=0) + 1
    # One integer a cube, as np.unique of rows takes longer.
    _, label = np.unique((cube[:, 0] * sizes[1] + cube[:, 1]) * sizes[2] + cube[:, 2], return_inverse=True)
    n = int(label.max()) + 1
    mean = _sums(label, v, n) / np.bincount(label, minlength=n)[:, None]
    a, b, c = (v[t[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    cells = label[t]
    plane, offset = np.zeros((n, 9)), np.zeros((n, 3))
    for k in range(3):
        owner = cells[:, k]
        away = ((a - mean[owner]) * normal).sum(axis=1)  # relative to the mean, for the conditioning
        plane += _sums(owner, (normal[:, :, None] * normal[:, None, :]).reshape(-1, 9), n)
        offset += _sums(owner, away[:, None] * normal, n)
    planes = plane.reshape(n, 3, 3)
    weight = _MEAN_WEIGHT * (np.trace(planes, axis1=1, axis2=2) + 1e-30)
    shift = np.linalg.solve(planes + weight[:, None, None] * np.eye(3), offset[:, :, None])[:, :, 0]
    vertices = mean + np.clip(shift, -cell / 2, cell / 2)
    # keep the triangles whose corners are in three different cubes, each once: rotated to begin with the
    # least index
    distinct = (cells[:, 0] != cells[:, 1]) & (cells[:, 1] != cells[:, 2]) & (cells[:, 0] != cells[:, 2])
    cells = cells[distinct]
    first = np.argmin(cells, axis=1)[:, None]
    cells = np.take_along_axis(cells, (first + np.arange(3)) % 3, axis=1)
    _, kept = np.unique((cells[:, 0] * n + cells[:, 1]) * n + cells[:, 2], return_index=True)
    used, triangles = np.unique(cells[kept], return_inverse=True)
    return Solid(vertices=vertices[used], triangles=triangles.reshape(-1, 3))


def _sums(label: Index, values: Array, n: int) -> Array:
    """Sums (n, k) of values (m, k) by label (m,)."""
    return np.stack([np.bincount(label, weights=column, minlength=n) for column in values.T], axis=1)


NOT_FOUND = "not found"  # of a mesh
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"


def find_mesh(name: str, urdf: Path) -> Path:
    """File of a mesh, by a path relative to the URDF, or package://NAME/... with NAME in a folder above it.

    Without a file of this name, one whose name differs in case is taken, as Windows does. Packages are also
    searched in ROS_PACKAGE_PATH, AMENT_PREFIX_PATH, and the installed example-robot-data.

    Raises
    ------
    FileNotFoundError : there is none.
    """
    if name.startswith("package://"):  # some files have a superfluous slash
        path = Path(name.removeprefix("package://").lstrip("/"))
    else:
        path = Path(name.removeprefix("file://"))
    # The nearest folder first.
    above = [*urdf.resolve().parents]
    places = [folder / path for folder in above]
    if name.startswith("package://"):  # the folder's name may differ from the package's
        places += [folder.joinpath(*path.parts[1:]) for folder in above]
        places += [folder / path for folder in _package_folders()]
    places = [path] if path.is_absolute() else places
    for place in places:
        if place.is_file():
            return place
    for place in places:
        with contextlib.suppress(OSError):
            for file in sorted(place.parent.iterdir()):
                if file.name.lower() == place.name.lower() and file.is_file():
                    return file
    raise FileNotFoundError(name)


def _package_folders() -> Iterator[Path]:
    """Folders that may contain packages of meshes, besides those above a URDF."""
    for place in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield from (Path(place), Path(place).parent)  # it contains packages, or it is one
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
        return NOT_FOUND


@cache
def _lack(path: Path, _changed: int) -> str:
    try:
        read_mesh(path, np.ones(3))
    except (ValueError, RuntimeError, OSError) as error:
        return f"cannot be read: {error}"
    return ""


def read_mesh(path: Path, scale: Array) -> Solid:
    """Solid of a mesh file: STL, or another format that coal reads, such as Collada and OBJ.

    Raises
    ------
    ValueError, RuntimeError, OSError : it cannot be read, or has no triangles.
    """
    solid = _read(path, scale)
    if not len(solid.triangles):
        raise ValueError("there are no triangles in it")
    if not np.isfinite(solid.vertices).all():
        raise ValueError("coordinates of its vertices are NaN or infinite")
    return solid


def _read(path: Path, scale: Array) -> Solid:
    data = path.read_bytes()
    if data.startswith(_LFS_POINTER):
        raise ValueError("it is a pointer to large-file storage; get the file itself by `git lfs pull`")
    count = int.from_bytes(data[80:84], "little")
    kind = path.suffix.lower()
    if kind == ".stl" and len(data) == 84 + 50 * count:  # binary, for which coal takes seconds
        facets = np.frombuffer(data, offset=84, dtype=[("at", "<f4", (4, 3)), ("attribute", "<u2")])
        vertices = facets["at"][:, 1:].reshape(-1, 3).astype(float)
        return Solid(vertices=scale * vertices, triangles=np.arange(3 * count).reshape(-1, 3))
    if kind not in SELF_CONTAINED:  # not cached, as its geometry may be in other files
        solid = _loaded(path)
    else:
        digest = hashlib.sha256(data + b"coal").hexdigest()
        solid = Solid(**cached_arrays("mesh", digest, lambda: vars(_loaded(path))))
    return Solid(vertices=scale * solid.vertices, triangles=solid.triangles)


def cached_arrays(kind: str, digest: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> dict[str, Any]:
    """Arrays by name, from the cache on disk (`impactopt.codegen.files.kept`), or made and stored there."""

    def archive() -> bytes:
        file = io.BytesIO()
        np.savez(file, **make())  # type: ignore[arg-type]  # of keywords that are not arrays
        return file.getvalue()

    # Pickles in a cache could run code.
    with np.load(io.BytesIO(kept(kind, digest, archive)), allow_pickle=False) as found:
        return dict(found)


def _loaded(path: Path) -> Solid:
    """Solid of a mesh file, read by coal, which takes seconds for a large one."""
    try:
        mesh = coal.MeshLoader().load(str(path), np.ones(3))
    except (ValueError, RuntimeError) as error:  # coal's reason comes after the file's name
        reason = str(error).partition(str(path))[2].strip().splitlines()
        raise ValueError(reason[0].rstrip(".") if reason else "no reader of meshes takes it") from error
    corners = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    triangles = np.array([[t[0], t[1], t[2]] for t in corners], dtype=np.intp)
    return Solid(vertices=np.array(mesh.vertices()), triangles=triangles.reshape(-1, 3))
