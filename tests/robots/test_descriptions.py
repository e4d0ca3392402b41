"""Robots' files against MuJoCo on drawn files, and each line of the tables of what of a file is read."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import urdfs

from impactopt import InputError, Robot
from impactopt.codegen.cache import model_hash

mujoco = pytest.importorskip("mujoco")

Array = NDArray[np.float64]
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "robot.md"
EQUAL = 1e-10  # relative, between engines


# ------------------------------------------------------------------ drawn files
@dataclass(frozen=True)
class Drawn:
    """A joint with its link, or its body, on an earlier one: -1 is the root."""

    parent: int
    slides: bool
    named_as_link: bool
    numbers: tuple[float, ...]

    def vector(self, k: int) -> str:
        return " ".join(f"{x:.6f}" for x in self.numbers[3 * k : 3 * k + 3])

    def axis(self) -> Array:
        axis = np.array(self.numbers[:3]) + np.array([0.0, 0.0, 2.0])
        return np.asarray(axis / np.linalg.norm(axis))

    def positive(self, k: int) -> float:
        return round(abs(self.numbers[k]) + 0.1, 6)


@st.composite
def trees(draw: Any) -> list[Drawn]:
    numbers = st.tuples(*[st.floats(-1, 1).map(lambda x: round(x, 4))] * 18)
    count = draw(st.integers(1, 5))
    return [
        Drawn(draw(st.integers(-1, k - 1)), draw(st.booleans()), draw(st.booleans()), draw(numbers))
        for k in range(count)
    ]


def _name(k: int, drawn: Drawn) -> str:
    return f"link{k}" if drawn.named_as_link else f"joint{k}"


def _moments(d: Drawn) -> tuple[float, float, float]:
    """Of a body: each less than the sum of the others."""
    a, b, c = (d.positive(k) for k in (12, 13, 14))
    return round(a + b, 6), round(b + c, 6), round(a + c, 6)


def _urdf(tree: list[Drawn]) -> str:
    # MuJoCo's reader of URDFs takes its options from an extension
    parts = ['<mujoco><compiler fusestatic="false" balanceinertia="false"/></mujoco><link name="base"/>']
    for k, d in enumerate(tree):
        xx, yy, zz = _moments(d)
        parts.append(
            f'<link name="link{k}"><inertial><origin xyz="{d.vector(2)}" rpy="{d.vector(3)}"/>'
            f'<mass value="{d.positive(15)}"/>'
            f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        parent = "base" if d.parent < 0 else f"link{d.parent}"
        parts.append(
            f'<joint name="{_name(k, d)}" type="{"prismatic" if d.slides else "revolute"}">'
            f'<parent link="{parent}"/><child link="link{k}"/>'
            f'<origin xyz="{d.vector(1)}" rpy="{d.vector(4)}"/>'
            f'<axis xyz="{" ".join(map(repr, d.axis().tolist()))}"/>'
            f'<limit lower="-3" upper="3" effort="50" velocity="4"/>'
            f'<dynamics damping="{d.positive(16)}" friction="{d.positive(17)}"/></joint>'
        )
    return f'<robot name="drawn">{"".join(parts)}</robot>'


def _mjcf(tree: list[Drawn], gravcomp: float, gravity: str, borne: bool) -> str:
    compensated = ' actuatorgravcomp="true"' if borne else ""

    def another(k: int) -> str:
        """A second joint of some bodies, which nothing is between."""
        d = tree[k]
        return (
            f'<joint name="more{k}" axis="1 {d.numbers[1]} 0" pos="{d.vector(3)}" range="-3 3" '
            f'armature="{d.positive(3)}" stiffness="{d.positive(6)}" actuatorfrcrange="-9 9"'
            f"{compensated}/>"
            if d.numbers[8] > 0
            else ""
        )

    def body(k: int) -> str:
        d = tree[k]
        inertia = "{} {} {}".format(*sorted(_moments(d)))
        return (
            f'<body name="link{k}" pos="{d.vector(1)}" euler="{d.vector(4)}" gravcomp="{gravcomp}">'
            f'<joint name="{_name(k, d)}" type="{"slide" if d.slides else "hinge"}" pos="{d.vector(2)}" '
            f'axis="{" ".join(map(repr, d.axis().tolist()))}" ref="{d.numbers[5]}" range="-3 3"{compensated} '
            f'armature="{d.positive(3)}" damping="{d.positive(16)}" frictionloss="{d.positive(17)}" '
            f'stiffness="{10 * abs(d.numbers[6])}" springref="{d.numbers[7]}"/>'
            f"{another(k)}"
            f'<inertial pos="{d.vector(3)}" euler="{d.vector(2)}" mass="{d.positive(15)}" '
            f'diaginertia="{inertia}"/>'
            + "".join(body(i) for i, other in enumerate(tree) if other.parent == k)
            + "</body>"
        )

    # actuators have had armature and damping since MuJoCo 3.4
    own = 'armature="0.02" damping="0.3"' if hasattr(mujoco.MjModel, "actuator_armature") else ""
    motors = "".join(
        f'<motor joint="{_name(k, d)}" gear="{d.positive(4)}" ctrlrange="-1 1" {own}/>'
        for k, d in enumerate(tree)
    )
    bodies = "".join(body(k) for k, d in enumerate(tree) if d.parent < 0)
    return (
        f'<mujoco model="drawn"><compiler angle="radian"/><option gravity="{gravity}"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def _held(tree: list[Drawn], lock: int) -> dict[str, float]:
    """A joint of the tree that is locked, if others are left."""
    return {_name(lock, tree[lock]): 0.3} if lock < len(tree) > 1 else {}


def _same_as_mujoco(robot: Robot, mj: Any, seed: int, held: dict[str, float]) -> None:
    """Mass matrix; bias, gravity and passive torques; dry friction: of the joints that are not held."""
    rng, there, here = np.random.default_rng(seed), mujoco.MjData(mj), robot.model.createData()
    at = [mj.joint(name) for name in robot.joint_names]
    q, v = rng.uniform(-1, 1, robot.nq), rng.uniform(-2, 2, robot.nv)
    dofs = [int(joint.dofadr[0]) for joint in at]
    viscous = np.array([actuator.viscous_friction for actuator in robot.actuators])
    for rates in (v, 0 * v):
        there.qpos[[int(joint.qposadr[0]) for joint in at]] = q
        there.qvel[dofs] = rates
        for name, angle in held.items():
            there.qpos[int(mj.joint(name).qposadr[0])] = angle
        mujoco.mj_forward(mj, there)
        mass = np.zeros((mj.nv, mj.nv))
        for k, unit in enumerate(np.eye(mj.nv)):
            mujoco.mj_mulM(mj, there, mass[k], unit)
        upper = np.triu(pin.crba(robot.model, here, q))
        own = upper + np.triu(upper, 1).T
        assert np.abs(own - mass[np.ix_(dofs, dofs)]).max() <= EQUAL * np.abs(own).max()
        # what no motor gives: Coriolis, centrifugal and gravity forces, damping, compensated weight
        other = (there.qfrc_bias - there.qfrc_passive)[dofs]
        mine = robot.nonlinear_effects(here, q, rates) + viscous * rates
        assert np.abs(mine - other).max() <= EQUAL * max(1.0, np.abs(other).max())
    dry = [actuator.coulomb_friction for actuator in robot.actuators]
    assert dry == pytest.approx(mj.dof_frictionloss[dofs], rel=EQUAL)


@settings(max_examples=40, deadline=None)
@given(tree=trees(), seed=st.integers(0, 99), lock=st.integers(0, 9))
def test_a_drawn_urdf_has_mujocos_dynamics(tree: list[Drawn], seed: int, lock: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drawn.urdf"
        path.write_text(_urdf(tree))
        held = _held(tree, lock)
        robot = Robot.from_urdf(path, floating=False, locked=held)
        _same_as_mujoco(robot, mujoco.MjModel.from_xml_path(str(path)), seed, held)


@settings(max_examples=40, deadline=None)
@given(
    tree=trees(),
    seed=st.integers(0, 99),
    gravcomp=st.sampled_from([0.0, 0.4, 1.0]),
    gravity=st.sampled_from(["0 0 -9.81", "0 0 0", "3 -2 1.6"]),
    borne=st.booleans(),
    lock=st.integers(0, 9),
)
def test_a_drawn_mjcf_has_mujocos_dynamics(
    tree: list[Drawn], seed: int, gravcomp: float, gravity: str, borne: bool, lock: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drawn.xml"
        path.write_text(_mjcf(tree, gravcomp, gravity, borne))
        held = _held(tree, lock)
        robot = Robot.from_mjcf(path, velocity_limit=4.0, locked=held)
        _same_as_mujoco(robot, mujoco.MjModel.from_xml_path(str(path)), seed, held)


# ------------------------------------------------------------------ the tables
URDF = urdfs.robot(
    "two",
    urdfs.link("base", 1.0, (0.1, 0.1, 0.1), (0, 0, 0)),
    urdfs.link("one", 1.0, (0.1, 0.1, 0.3), (0, 0, 0.15)),
    urdfs.link("two", 1.0, (0.1, 0.1, 0.3), (0, 0, 0.15)),
    urdfs.joint("j1", "base", "one", "0 1 0", (0, 0, 0.1), (-1, 1)),
    urdfs.joint("j2", "one", "two", "0 1 0", (0, 0, 0.3), (-1, 1)),
)
MJCF = """
<mujoco model="two"><compiler angle="radian"/><option/>
  <worldbody>
    <body name="one" pos="0 0 1">
      <joint name="j1" axis="0 1 0" range="-1 1" actuatorfrcrange="-30 30"/>
      <geom name="g" type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><site name="s1"/>
      <body name="two" pos=".3 0 0">
        <joint name="j2" axis="0 1 0" range="-1 1" actuatorfrcrange="-30 30"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><site name="s2" pos=".3 0 .1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="a1" joint="j1" kp="100"/></actuator>
</mujoco>
"""
FREE = MJCF.replace(
    '<body name="one" pos="0 0 1">',
    '<body name="base" pos="0 0 1"><joint name="root" type="free"/><geom size=".1"/><body name="one">',
).replace("</worldbody>", "</body></worldbody>")
SIX = "".join(
    f'<joint type="{kind}" axis="{axis}"/>'
    for kind in ("slide", "hinge")
    for axis in ("1 0 0", "0 1 0", "0 0 1")
)
CLOTH = (
    '<flexcomp type="grid" count="3 3 1" spacing=".1 .1 .1" pos="2 0 0" name="cloth" dim="2" radius=".01" '
    'rigid="true"/>'
)
J2 = 'name="j2" axis'
END = "</mujoco>"
Edit = tuple[str, str]


def _before(end: str, more: str) -> Edit:
    return end, f"{more}{end}"


def _between(link: str) -> list[Edit]:
    """Another joint before j2, and nothing but this link between them."""
    limits = '<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="9" velocity="4"/>'
    joint = '<joint name="j0" type="revolute"><parent link="one"/><child link="between"/>'
    return [
        ('parent link="one"', 'parent link="between"'),
        _before("</robot>", f"{link}{joint}{limits}</joint>"),
    ]


# by the beginning of a line's first column: edits of the file above; a part of the note, or of the refusal
URDF_CASES: dict[str, tuple[list[Edit], str]] = {
    "`<inertial>`": ([('<mass value="1.0"/>', '<mass value="3.0"/>')], ""),
    "`<joint>` of type revolute": ([('<axis xyz="0 1 0"/>', '<axis xyz="1 1 0"/>')], ""),
    "`<limit>`": ([('effort="80.0"', 'effort="30.0"')], ""),
    "`<dynamics>`": ([_before("</joint>", '<dynamics damping="3" friction="1.5"/>')], ""),
    "links without mass and shapes": (_between('<link name="between"/>'), ""),
    "links with shapes": (
        _between('<link name="between"><visual><geometry><sphere radius=".1"/></geometry></visual></link>'),
        "the link 'between', moved by '.*', has shapes and mass 0 kg",
    ),
    "`<mimic>`: a follower": (
        [('velocity="6.0"/></joint></robot>', 'velocity="6.0"/><mimic joint="j1"/></joint></robot>')],
        "",
    ),
    "`<mimic>` of a joint that comes": (
        [("</joint><joint", '<mimic joint="j2"/></joint><joint')],
        "'j1' follows 'j2' by <mimic>, which comes after it in the tree: 'j1' leads",
    ),
    "`<mimic>` of a joint that turns": (
        [
            ('type="revolute"', 'type="continuous"'),
            ('velocity="6.0"/></joint></robot>', 'velocity="6.0"/><mimic joint="j1"/></joint></robot>'),
        ],
        "is continuous",
    ),
    "`<mimic>` of a joint that does not": (
        [('velocity="6.0"/></joint></robot>', 'velocity="6.0"/><mimic joint="j"/></joint></robot>')],
        "'j2' follows 'j' by <mimic>, and there is no such joint.*lock it",
    ),
    "`<joint>` of type floating": (
        [('name="j2" type="revolute"', 'name="j2" type="planar"')],
        "'j2' is a .*freedom",
    ),
    "`<springStiffness>`": (
        [_before("</robot>", '<gazebo reference="j1"><springStiffness>9</springStiffness></gazebo>')],
        "",
    ),
    "`<joint>` in `<gazebo>`": (
        [
            _before(
                "</robot>",
                '<gazebo><joint name="rod"><parent>base</parent><child>two</child></joint></gazebo>',
            )
        ],
        "'rod' closes a loop.*j1, j2",
    ),
    "`<gravity>`": (
        [_before("</robot>", '<gazebo reference="one"><turnGravityOff>true</turnGravityOff></gazebo>')],
        "without gravity .* have their weight here: one",
    ),
    "`<transmission>`": (
        [
            _before(
                "</robot>",
                '<transmission><joint name="j1"/><motorInertia>1</motorInertia></transmission>',
            )
        ],
        "rotors' inertia .* of j1",
    ),
    "xacro's": ([_before("</robot>", '<xacro:leg side="left"/>')], "run `xacro robot.urdf"),
    "`<safety_controller>`": ([_before("</joint>", '<safety_controller k_velocity="1"/>')], ""),
}
MJCF_CASES: dict[str, tuple[list[Edit], str]] = {
    "`<inertial>`": ([('name="g"', 'name="g" density="500"')], ""),
    "`<joint>` of type hinge": ([(J2, 'name="j2" pos=".1 0 0" axis')], ""),
    "three slides": (
        [
            ('<body name="one" pos="0 0 1">', f'<body name="base">{SIX}<geom size=".1"/><body name="one">'),
            _before("</worldbody>", "</body>"),
        ],
        "are read as a free joint of body 'base'",
    ),
    "`<joint>` with `armature`": ([(J2, f'armature=".1" {J2}')], ""),
    "`<joint>` with `damping`": ([(J2, f'damping="2" frictionloss="1" {J2}')], ""),
    "`forcerange`": ([('kp="100"', 'kp="100" forcerange="-9 9"')], ""),
    "`kp`": ([('kp="100"', 'kp="100" kv="7"')], ""),
    "`armature` and `damping` of actuators": ([('kp="100"', 'kp="100" armature=".2" damping=".3"')], ""),
    "`<option>` with `gravity`": ([("<option/>", '<option gravity="1 0 -3"/>')], ""),
    "`<flag>`": ([("<option/>", '<option><flag gravity="disable"/></option>')], ""),
    "`gravcomp`, the same": ([("<body name=", '<body gravcomp="1" name=')], "gravcomp 1"),
    "`gravcomp` with": (
        [("<body name=", '<body gravcomp="1" name='), ("<joint ", '<joint actuatorgravcomp="true" ')],
        "",
    ),
    "`gravcomp` of some": (
        [('<body name="two"', '<body gravcomp="1" name="two"')],
        "gravcomp of 'two' is not that of the rest.*lock",
    ),
    "`stiffness`, ": ([(J2, f'stiffness="9" springref=".5" {J2}')], ""),
    "`stiffness` that": ([(J2, f'stiffness="9 1" {J2}')], "'j2' has a spring whose torque is not linear"),
    "`damping` that": ([(J2, f'damping="2 1" {J2}')], "'j2' has damping that is not linear"),
    "`<fixed>`": (
        [_before(END, '<tendon><fixed name="t" range="-1 1"><joint joint="j2" coef="2"/></fixed></tendon>')],
        "",
    ),
    "`<tendon>`": (
        [
            _before(
                END,
                '<tendon><spatial name="t" stiffness="9"><site site="s1"/><site site="s2"/></spatial>'
                "</tendon>",
            )
        ],
        "tendon 't' acts on j2 .stiffness.",
    ),
    "`<connect>`": (
        [_before(END, '<equality><weld name="rod" site1="s1" site2="s2"/></equality>')],
        "closes a loop by the equality 'rod'.*lock it",
    ),
    "`<weld>` or `<connect>` to a mocap": (
        [
            _before("</worldbody>", '<body name="handle" mocap="true"><site name="grip"/></body>'),
            _before(END, '<equality><connect name="drag" site1="grip" site2="s2"/></equality>'),
        ],
        "'drag' to a mocap body is left out",
    ),
    "`<joint>` in `<equality>`, linear": (
        [_before(END, '<equality><joint joint1="j2" joint2="j1"/></equality>')],
        "",
    ),
    "`<joint>` in `<equality>`, otherwise": (
        [_before(END, '<equality><joint joint1="j2" joint2="j1" polycoef="0 1 .1 0 0"/></equality>')],
        "'j2' follows 'j1'.*lock one",
    ),
    "`<joint>` of type ball": (
        [
            (
                '<joint name="j2" axis="0 1 0" range="-1 1" actuatorfrcrange="-30 30"/>',
                '<joint name="j2" type="ball"/>',
            )
        ],
        "'j2' is a ball",
    ),
    "several joints": (
        [
            (
                f"<joint {J2}",
                f'<joint name="j0" axis="1 0 0" range="-1 1" armature=".1" actuatorfrcrange="-9 9"/>'
                f"<joint {J2}",
            )
        ],
        "",
    ),
    "`<option>` with `density`": (
        [("<option/>", '<option density="1000" wind="1 0 0"/>')],
        "fluid drag",
    ),
    "`damping`, `frictionloss`, `armature`, `stiffness` of a free": (
        [('type="free"', 'type="free" damping="1"')],
        "damping of the free joint 'root'",
    ),
    "`dyntype`": ([('kp="100"', 'kp="100" timeconst=".1"')], "'a1' has dynamics of its own"),
    "actuators of sites": ([_before("</actuator>", '<motor name="jet" site="s2"/>')], "'jet', of no joint"),
    "`<flex>`": ([_before("</worldbody>", CLOTH)], "deformable bodies"),
    "`margin`": ([(J2, f'margin=".1" solreflimit=".1 1" user="3" {J2}')], ""),
    "`<contact>`": ([_before(END, '<contact><exclude body1="one" body2="two"/></contact>')], ""),
}


def _lines(kind: str) -> list[tuple[str, str]]:
    """Features and their treatment, of the table of a kind of file."""
    table = PAGE.read_text(encoding="utf-8").partition(f"| {kind} | treatment |")[2]
    rows = re.findall(r"^\| (.+?) \| (.+) \|$", table.split("\n\n")[0], flags=re.MULTILINE)
    return [row for row in rows if not row[0].startswith("---")]


def _shape(robot: Robot) -> tuple[Any, ...]:
    """All that a robot's file gives it."""
    numbers = (robot.kp, robot.kd, robot.torque_limit, robot.lower, robot.upper, robot.armature)
    return model_hash(robot.model), robot.actuators, robot.tendons, *(tuple(x) for x in numbers)


def _tried(kind: str, text: str, folder: Path) -> Robot:
    path = folder / f"robot.{kind.lower()}"
    path.write_text(text)
    if kind == "URDF":
        return Robot.from_urdf(path, floating=False)
    return Robot.from_mjcf(path, velocity_limit=4.0)


LINES = [(kind, *line) for kind in ("URDF", "MJCF") for line in _lines(kind)]


@pytest.mark.parametrize(("kind", "what", "becomes"), LINES, ids=[f"{k}: {w[:40]}" for k, w, _ in LINES])
def test_what_of_a_file_is_read_is_as_the_tables_say(
    kind: str, what: str, becomes: str, tmp_path: Path
) -> None:
    text, cases = (URDF, URDF_CASES) if kind == "URDF" else (MJCF, MJCF_CASES)
    (case,) = [case for key, case in cases.items() if what.startswith(key)]
    edits, said = case
    text = FREE if "free joint" in what else text
    edited = text
    for old, new in edits:
        assert old in edited
        edited = edited.replace(old, new)
    plain = _tried(kind, text, tmp_path)
    if becomes.startswith("refused"):
        with pytest.raises(InputError, match=said):
            _tried(kind, edited, tmp_path)
        return
    robot = _tried(kind, edited, tmp_path)
    assert robot.source is not None
    notes = "; ".join(robot.source.notes)
    assert bool(re.search(said, notes)) if said else not notes
    assert (_shape(robot) != _shape(plain)) == becomes.startswith("read")
    assert bool(said) == ("noted" in becomes)


@pytest.mark.skipif(not hasattr(mujoco, "mj_printSchema"), reason="this MuJoCo does not tell its language")
def test_the_table_has_all_that_mujoco_can_say_of_a_joint() -> None:
    schema = mujoco.mj_printSchema(False, False)
    in_body = schema[schema.index("(world)body") :]
    found = re.search(r"^ +joint \(\*\) +(.*?)^ +\w+ \(", in_body, re.DOTALL | re.MULTILINE)
    assert found is not None
    words = set(re.findall(r"`(\w+)`", "\n".join(line[0] for line in _lines("MJCF"))))
    assert set(found[1].split()) - words == set()
