"""The geoms of an MJCF, as solids in the frames of a robot's joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.solids import Solid, box, capsule, cylinder, sphere
from impactopt.robots.mjcf import compile_mjcf

__all__ = ["Geom", "geoms_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Geom:
    """A geom of a body: ``joint`` of the model that moves it, ``solid`` in that joint's frame [m].

    collides : with anything; else it is there to be seen.  colour : red, green, blue.
    """

    link: str
    joint: int
    solid: Solid
    collides: bool
    colour: tuple[float, float, float]


def geoms_of(model: Any, mjcf: str) -> list[Geom]:
    """Geoms of a pin.Model's bodies; planes, height fields and signed distance fields are left out."""
    return list(_geoms(model, _compiled(mjcf, Path(mjcf).stat().st_mtime_ns)))


@lru_cache(maxsize=4)
def _compiled(mjcf: str, _changed: int) -> Any:
    return compile_mjcf(mjcf)


def _geoms(model: Any, mj: Any) -> Iterator[Geom]:
    for g in range(mj.ngeom):
        name = mj.body(int(mj.geom_bodyid[g])).name or f"body{int(mj.geom_bodyid[g])}"
        solid = _solid(mj, g)
        if solid is None or not model.existFrame(name, pin.FrameType.BODY):
            continue
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        w, x, y, z = (float(a) for a in mj.geom_quat[g])
        place = frame.placement * pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.array(mj.geom_pos[g]))
        material = int(mj.geom_matid[g])
        red, green, blue, _ = (mj.geom_rgba[g] if material < 0 else mj.mat_rgba[material]).tolist()
        yield Geom(
            link=name,
            joint=int(frame.parentJoint),
            solid=solid.moved(place.rotation, place.translation),
            collides=bool(mj.geom_contype[g] or mj.geom_conaffinity[g]),
            colour=(red, green, blue),
        )


def _solid(mj: Any, g: int) -> Solid | None:
    """A geom in its own frame; None for what is no solid."""
    import mujoco

    kind, kinds = int(mj.geom_type[g]), mujoco.mjtGeom
    a, b, c = (float(x) for x in mj.geom_size[g])
    if kind == int(kinds.mjGEOM_SPHERE):
        return sphere(a)
    if kind == int(kinds.mjGEOM_CAPSULE):
        return capsule(a, 2 * b)
    if kind == int(kinds.mjGEOM_CYLINDER):
        return cylinder(a, 2 * b)
    if kind == int(kinds.mjGEOM_BOX):
        return box([2 * a, 2 * b, 2 * c])
    if kind == int(kinds.mjGEOM_ELLIPSOID):
        ball = sphere(1.0)
        return Solid(vertices=ball.vertices * [a, b, c], triangles=ball.triangles)
    if kind == int(kinds.mjGEOM_MESH):
        m = int(mj.geom_dataid[g])
        points, faces = int(mj.mesh_vertadr[m]), int(mj.mesh_faceadr[m])
        return Solid(
            vertices=np.array(mj.mesh_vert[points : points + mj.mesh_vertnum[m]], dtype=np.float64),
            triangles=np.array(mj.mesh_face[faces : faces + mj.mesh_facenum[m]], dtype=np.intp),
        )
    return None
