"""Small URDFs as text: robots that nobody has prepared."""

from __future__ import annotations

import re
from collections.abc import Sequence

LIMIT = '<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{velocity}"/>'
SOLE = (0.2, 0.1)  # [m] of the biped's feet
ANKLE = 0.08  # [m] above the ground

_LEG = (
    ("hip_tilt", "0 1 0", (0.0, 0.1, 0.0), (-0.5, 0.5), 0.05),
    ("hip_yaw", "0 0 1", (0.0, 0.1, 0.0), (-0.8, 0.8), 0.05),
    ("hip_roll", "1 0 0", (0.0, 0.0, -0.05), (-0.6, 0.6), 0.05),
    ("hip_pitch", "0 1 0", (0.0, 0.0, 0.0), (-1.8, 0.8), 0.3),
    ("knee", "0 1 0", (0.0, 0.0, -0.35), (0.0, 2.2), 0.3),
    ("ankle_pitch", "0 1 0", (0.0, 0.0, -0.35), (-1.0, 1.0), 0.05),
    ("ankle_roll", "1 0 0", (0.0, 0.0, 0.0), (-0.6, 0.6), 0.05),
)
_ARM = (
    ("shoulder_pitch", "0 1 0", (0.0, 0.2, 0.4), (-2.8, 2.8), 0.05),
    ("shoulder_roll", "1 0 0", (0.0, 0.05, 0.0), (-1.5, 1.5), 0.25),
    ("elbow", "0 1 0", (0.0, 0.0, -0.28), (-2.4, 0.0), 0.2),
)


def link(name: str, mass: float, size: Sequence[float], at: Sequence[float], *, moments: str = "") -> str:
    """A link that is a box; moments: its `<inertia>`'s attributes, a solid box's if left out."""
    x, y, z = size
    a, b, c = (mass / 12 * (p * p + q * q) for p, q in ((y, z), (x, z), (x, y)))
    moments = moments or f'ixx="{a}" iyy="{b}" izz="{c}" ixy="0" ixz="0" iyz="0"'
    place = f'<origin xyz="{" ".join(map(str, at))}"/>'
    return (
        f'<link name="{name}"><inertial>{place}<mass value="{mass}"/><inertia {moments}/></inertial>'
        f'<collision>{place}<geometry><box size="{x} {y} {z}"/></geometry></collision></link>'
    )


def joint(
    name: str,
    parent: str,
    child: str,
    axis: str,
    at: Sequence[float],
    limits: Sequence[float],
    *,
    kind: str = "revolute",
    effort: float = 80.0,
    velocity: float = 6.0,
) -> str:
    """A joint between two links."""
    low, high = limits
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{" ".join(map(str, at))}"/><axis xyz="{axis}"/>'
        f"{LIMIT.format(low=low, high=high, effort=effort, velocity=velocity)}</joint>"
    )


def following(text: str, joint: str, law: str) -> str:
    """The text with a joint that follows another one by a `<mimic>` of these attributes."""
    return re.sub(rf'(<joint name="{joint}".*?)</joint>', rf"\1<mimic {law}/></joint>", text)


def robot(name: str, *parts: str) -> str:
    """The whole text."""
    return f'<robot name="{name}">{"".join(parts)}</robot>'


def biped(
    *,
    legs: int = 6,
    without: str = "",
    waist: bool = False,
    behind: bool = False,
    moments: str = "",
    effort: float = 80.0,
    pairs: int = 1,
    arms: bool = True,
    inward: float = 0.0,
    arm: Sequence[tuple[str, str, Sequence[float], tuple[float, float], float]] = _ARM,
) -> str:
    """Two legs of so many joints with box feet, and two arms of three.

    without : one of these joints.  waist : one more joint, from the trunk to both legs.
    behind : its root looks along -x.  moments : of the right elbow's link.  effort : of all joints [N m].
    pairs : of legs, one behind the other.  arms : False: none.  inward [m] : of the feet, from the ankles.
    arm : name, axis, place, limits and length of each joint of an arm.
    """
    sign = -1.0 if behind else 1.0
    parts = [link("trunk", 15.0, (0.2, 0.3, 0.5), (0.0, 0.0, 0.25))]
    if waist:
        parts += [link("hips", 2.0, (0.2, 0.2, 0.1), (0.0, 0.0, 0.0))]
        parts += [joint("waist", "trunk", "hips", "0 0 1", (0.0, 0.0, 0.0), (-1.0, 1.0), effort=effort)]
    for pair in range(pairs):
        for side, out in (("left", sign), ("right", -sign)):
            parent = first = "hips" if waist else "trunk"
            mark = f"{side}_{pair}" if pairs > 1 else side
            for name, axis, (x, y, z), limits, long in _LEG[len(_LEG) - legs :]:
                if name == without:
                    continue
                child = f"{mark}_{name}_link"
                turn = " ".join(str(sign * float(a)) for a in axis.split())
                place = (x - 0.4 * pair, out * 0.1 if parent == first else out * y, z)
                size, at, mass = (0.08, 0.08, max(long, 0.06)), (0.0, 0.0, -long / 2), 1.0 + 5 * long
                if name == ("ankle_roll" if without != "ankle_roll" else "ankle_pitch"):
                    size, at, mass = (*SOLE, 0.04), (0.04 * sign, -out * inward, -ANKLE + 0.02), 1.0
                parts += [link(child, mass, size, at)]
                parts += [joint(f"{mark}_{name}", parent, child, turn, place, limits, effort=effort)]
                parent = child
    for side, out in (("left", sign), ("right", -sign)) if arms else ():
        parent = "trunk"
        for name, axis, (x, y, z), limits, long in arm:
            child = f"{side}_{name}_link"
            turn = " ".join(str(sign * float(a)) for a in axis.split())
            own = moments if child == "right_elbow_link" else ""
            parts += [link(child, 1.0, (0.06, 0.06, long), (0.0, 0.0, -long / 2), moments=own)]
            parts += [joint(f"{side}_{name}", parent, child, turn, (x, out * y, z), limits, effort=effort)]
            parent = child
    return robot("walker", *parts)


def arm(*, effort: float = 60.0, velocity: float = 4.0, wheels: bool = False) -> str:
    """An arm of four joints on a pedestal, with a gripper of two fingers; wheels: on a cart."""
    chain = (
        ("turn", "0 0 1", (0.0, 0.0, 0.4), (-2.8, 2.8), 0.1),
        ("shoulder", "0 1 0", (0.0, 0.0, 0.1), (-1.8, 1.8), 0.3),
        ("elbow", "0 1 0", (0.0, 0.0, 0.3), (-2.4, 2.4), 0.3),
        ("wrist", "0 1 0", (0.0, 0.0, 0.3), (-2.0, 2.0), 0.1),
    )
    parts, parent = [link("base", 10.0, (0.3, 0.3, 0.4), (0.0, 0.0, 0.2))], "base"
    for name, axis, at, limits, long in chain:
        parts += [link(f"{name}_link", 2.0, (0.08, 0.08, long), (0.0, 0.0, long / 2))]
        parts += [joint(name, parent, f"{name}_link", axis, at, limits, effort=effort, velocity=velocity)]
        parent = f"{name}_link"
    for k, y in enumerate((0.02, -0.02)):
        parts += [link(f"claw_{k}", 0.03, (0.01, 0.01, 0.05), (0.0, 0.0, 0.025))]
        grip = {"kind": "prismatic", "effort": 20.0, "velocity": 0.1}
        parts += [joint(f"slide_{k}", parent, f"claw_{k}", "0 1 0", (0.0, y, 0.1), (0.0, 0.03), **grip)]
    for k, y in enumerate((0.2, -0.2) if wheels else ()):
        parts += [link(f"disc_{k}", 0.5, (0.1, 0.02, 0.1), (0.0, 0.0, 0.0))]
        parts += [
            joint(f"drive_{k}", "base", f"disc_{k}", "0 1 0", (0.0, y, 0.05), (0, 0), kind="continuous")
        ]
    return robot("reacher", *parts)
