"""Geoms of an MJCF as bodies, against the places that MuJoCo gives them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from impactopt import Robot
from impactopt.bodies.convex_hulls import pieces_of
from impactopt.bodies.file_shapes import geoms_of
from impactopt.bodies.visuals import visuals_of

mujoco = pytest.importorskip("mujoco")

ARM = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .2 0 0 0 .3"/></asset>
  <worldbody>
    <body name="upper" pos="0 0 .5" euler="10 0 20">
      <joint name="shoulder" axis="0 1 0" range="-100 100" pos="0 0 .1"/>
      <geom name="box" type="box" size=".1 .02 .03" pos=".1 .2 .3" euler="30 0 0"/>
      <geom name="capsule" type="capsule" size=".02 .1" pos=".1 .2 .3" euler="30 40 0"/>
      <geom name="seen" type="cylinder" size=".03 .01" contype="0" conaffinity="0" rgba="1 0 0 1"/>
      <body name="hand" pos="0 0 .4">
        <joint name="wrist" axis="1 0 0" range="-100 100"/>
        <geom name="egg" type="ellipsoid" size=".02 .03 .04" pos="0 .1 0" euler="0 20 0"/>
        <geom name="wedge" type="mesh" mesh="wedge" pos="0 .1 .1" euler="0 20 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return Robot.from_mjcf(path, velocity_limit=3.0, torque_limit=10.0, armature=0.01)


def test_geoms_are_where_mujoco_has_them(robot: Robot) -> None:
    mj = mujoco.MjModel.from_xml_path(robot.mjcf)
    there, data, q = mujoco.MjData(mj), robot.model.createData(), np.array([0.4, -0.7])
    there.qpos[:] = q
    mujoco.mj_forward(mj, there)
    pin.forwardKinematics(robot.model, data, q)
    geoms = geoms_of(robot.model, str(robot.mjcf))
    assert len(geoms) == mj.ngeom
    for g, geom in enumerate(geoms):
        # MuJoCo's frame of a geom: the corners in it are within its own box, and reach to its sides
        place = data.oMi[geom.joint]
        world = geom.solid.vertices @ place.rotation.T + place.translation
        own = (world - there.geom_xpos[g]) @ there.geom_xmat[g].reshape(3, 3)
        centre, half = mj.geom_aabb[g][:3], mj.geom_aabb[g][3:]
        assert own.max(axis=0) == pytest.approx(centre + half, abs=1e-3), mj.geom(g).name
        assert own.min(axis=0) == pytest.approx(centre - half, abs=1e-3), mj.geom(g).name


def test_what_collides_is_a_body_and_what_does_not_is_seen(robot: Robot) -> None:
    pieces, source = pieces_of(robot)
    assert source == "collision shapes of its MJCF"
    assert [piece.link for piece in pieces] == ["upper", "upper", "hand", "hand"]
    seen = visuals_of(robot)
    red = [visual for visual in seen if visual.colour == (1.0, 0.0, 0.0)]
    assert len(red) == 1 and len(seen) == 3  # of the upper link what is there to be seen; of the hand both
