"""Start postures of drafts: half sitting on level soles, arms bent with their ends in front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from impactopt.arrays import Array, Index
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb, unshared
from impactopt.files.draft.strikers import ROLLS
from impactopt.problem.strength import drawn_ranges
from impactopt.robots.build import neutral
from impactopt.robots.checks import LEG
from impactopt.robots.loads import weight_of
from impactopt.robots.robot import Robot, Sole

SQUAT = 0.06  # lowering of the hips, over the length of the legs
LEVEL = 1e-5  # [m], [rad]: tolerance of a sole's placement, to which angles are written and files have axes
STARTS = 10  # random initial guesses
# distances of the soles tried, over that in the zero posture: with splayed legs they may not be level
WIDTHS = (1.0, 0.9, 0.8)
GRAVITY_SHARE = 0.5  # largest gravity torque of an ankle or of an idle arm's joint, over its limit
HELD_SHARE = 0.75  # the same of a bent arm's joint, if that is possible: plans have 0.85
LOAD_COST = 0.1  # [m]: position error that costs as much as a gravity torque of the whole limit beyond that
MARGIN = 0.1  # of a joint's range, to both limits together
RANGE_COST = 0.02  # [m]: position error that costs as much as a deviation by a joint's whole range
UPPER_ARM = 0.2  # least length of an upper arm, over the arm's
# largest cosine between a shoulder's axis and the arm for which the shoulder may be moved along the axis, and
# least one between an ankle's pitch axis and the lateral direction
ACROSS = 0.7
EDGE = 0.2  # of a joint's range: nearest that its rest angle 0 may be to a limit, else it is the middle


def half_sitting(robot: Robot, legs: Sequence[Limb], soles: Sequence[Sole], forward: Array) -> Array:
    """A configuration (nq,) with level soles side by side, knees forward, and the centre of mass above their
    middle, or as near to it as the ankles carry the weight with `GRAVITY_SHARE` of their torque limits.

    robot : with the soles.  forward (3,) : in the root's frame.

    Raises
    ------
    InputError : none is found.
    """
    errors = list[InputError]()
    for width in WIDTHS:
        try:
            return _half_sitting(robot, legs, soles, forward, width)
        except InputError as error:
            errors.append(error)
    raise errors[0]


def _half_sitting(
    robot: Robot, legs: Sequence[Limb], soles: Sequence[Sole], forward: Array, width: float
) -> Array:
    """`half_sitting` with `width` times the soles' distance in the zero posture."""
    model, data = robot.model, robot.model.createData()
    q = rested(robot)
    pin.framesForwardKinematics(model, data, q)
    turn = np.column_stack([forward, np.cross([0.0, 0.0, 1.0], forward), [0.0, 0.0, 1.0]])
    straight = [np.array(data.oMf[model.getFrameId(s.frame)].translation) for s in soles]
    chains = unshared(robot.model, legs)
    hips = [np.array(data.oMi[own[0]].translation) for own in chains]
    aside = [width * float(spot @ turn[:, 1]) for spot in straight]
    below = [[j for j in leg.path if j > own[0]] for leg, own in zip(legs, chains, strict=True)]
    length = float(np.mean([_path(robot, joints) for joints in below]))
    height = min(float(spot[2]) for spot in straight) + SQUAT * length
    ahead = float(np.mean([hip @ forward for hip in hips]))
    rng = np.random.default_rng(0)
    for k in range(4):  # move the feet below the centre of mass, which moves with the legs
        for own, sole, out in zip(chains, soles, aside, strict=True):
            spot = ahead * turn[:, 0] + out * turn[:, 1] + height * turn[:, 2]
            q = _leg(robot, own, sole, pin.SE3(turn, spot), q, forward, rng, follow=k > 0)
        centre = np.array(pin.centerOfMass(model, data, q))
        pin.framesForwardKinematics(model, data, q)
        middles = [
            data.oMf[model.getFrameId(s.frame)].act(np.append(s.polygon.mean(axis=0), 0.0)) for s in soles
        ]
        above = float(np.mean(middles, axis=0) @ turn[:, 0])
        off = float(centre @ turn[:, 0]) - float(np.clip(above, *_carried(robot, chains, q, turn[:, :2])))
        if abs(off) < 2e-3:
            break
        ahead += off
    return robot.place(q, soles)


def _carried(robot: Robot, chains: Sequence[Sequence[int]], q: Array, axes: Array) -> tuple[float, float]:
    """Least and largest position [m] ahead at which the legs' ankles carry the centre of mass.

    chains : joints of each leg.  axes (3, 2) : directions ahead and to the side.
    """
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, q)
    weight, low, high = weight_of(robot), -np.inf, np.inf
    for own in chains:
        for joint in reversed(own):
            jac = np.array(pin.getJointJacobian(model, data, joint, pin.LOCAL_WORLD_ALIGNED))
            axis = jac[3:, model.joints[joint].idx_v]
            if abs(float(axis @ axes[:, 1])) > ACROSS:  # the ankle's pitch joint
                at = float(data.oMi[joint].translation @ axes[:, 0])
                limit = float(robot.torque_limit[_columns(robot, [joint])[0]])
                reach = GRAVITY_SHARE * limit * len(chains) / weight if weight > 0 else np.inf
                low, high = max(low, at - reach), min(high, at + reach)
                break
    return low, max(low, high)


def bend_arm(
    robot: Robot, arm: Limb, striker: str, axis: Array, q: Array, target: Array, way: Array
) -> tuple[Array, float]:
    """The configuration with an arm's striking point near `target` (3,) [m], its last link along `way` (3,),
    and the distance [m] of the point from the target.

    axis (3,) : direction of the last link, in its joint's frame.  All other joints are as in q (nq,).
    """
    model, data = robot.model, robot.model.createData()
    fid, own = model.getFrameId(f"striker:{striker}"), _columns(robot, arm.own)
    low, high = _limits(robot, own)
    span = high - low
    middle = np.where(np.minimum(high, -low) > EDGE * span, 0.0, (low + high) / 2)
    rng = np.random.default_rng(0)
    tries = []

    def errors(angles: Array) -> Array:
        now = _set(robot, q, own, angles)
        pin.forwardKinematics(model, data, now)
        pin.updateFramePlacement(model, data, fid)
        gap = target - data.oMf[fid].translation
        points = data.oMi[arm.tip].rotation @ axis
        preferred = RANGE_COST * (angles - middle) / span
        heavy = np.maximum(_gravity_share(robot, data, now, own) - HELD_SHARE, 0.0)
        return np.concatenate([gap, 0.02 * (points - way), preferred, LOAD_COST * heavy])

    for k in range(STARTS):
        start = np.clip(middle + (0.25 * span * rng.standard_normal(len(own)) if k else 0.05), low, high)
        found = least_squares(errors, start, bounds=(low - 1e-9, high + 1e-9), max_nfev=60)
        tries.append((float(found.cost), found.x))
    _, angles = min(tries, key=lambda one: one[0])
    return _set(robot, q, own, angles), float(np.linalg.norm(errors(angles)[:3]))


def shoulder(robot: Robot, arm: Limb, q: Array) -> Array:
    """Position of an arm's shoulder (3,) [m]: on the axis of the upper arm's joint, nearest to the centre of
    mass of the arm.
    """
    model, data = robot.model, robot.model.createData()
    first = arm.own[_upper(robot, arm)]
    pin.computeJointJacobians(model, data, q)
    pin.centerOfMass(model, data, q)
    joint, column = data.oMi[first], model.joints[first].idx_v
    jacobian = np.reshape(pin.getJointJacobian(model, data, first, pin.LOCAL_WORLD_ALIGNED), (6, model.nv))
    axis = jacobian[3:, column]
    middle = joint.act(np.array(data.com[first])) - joint.translation
    along = float(axis @ middle)
    if abs(along) > ACROSS * np.linalg.norm(middle):
        return np.array(joint.translation)  # the axis is along the arm
    return np.asarray(joint.translation + along * axis)


def arm_length(robot: Robot, arm: Limb, striker: str) -> float:
    """Distance [m] from the shoulder to the striking point of a stretched arm."""
    frame = robot.model.frames[robot.model.getFrameId(f"striker:{striker}")]
    beyond = _path(robot, arm.own[_upper(robot, arm) + 1 :])
    return beyond + float(np.linalg.norm(frame.placement.translation))


def _upper(robot: Robot, arm: Limb) -> int:
    """Index of the last of an arm's own joints before its first long link.

    A link ends at the next joint that bends the arm: joints that roll about the link are a part of it. Only
    the part of a link that one of the joints before it turns counts: if the first joint turns about the line
    through both shoulders, its link along that line is a part of the shoulder.
    """
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, neutral(model))
    pin.computeJointJacobians(model, data)
    places = [np.array(data.oMi[joint].translation) for joint in arm.own]
    axes = [
        np.reshape(pin.getJointJacobian(model, data, joint, pin.WORLD), (6, model.nv))[
            3:, model.joints[joint].idx_v
        ]
        for joint in arm.own
    ]
    length = sum(map(np.linalg.norm, np.diff(places, axis=0)))
    links = []
    for k, start in enumerate(places[:-1]):
        end = k + 1
        while end + 1 < len(places) and all(_along(axes[end], p - start) for p in places[end : end + 2]):
            end += 1
        links.append(places[end] - start)
    turned = (
        max(np.linalg.norm(np.cross(axis, link)) for axis in axes[: k + 1]) for k, link in enumerate(links)
    )
    return next((k for k, part in enumerate(turned) if part > UPPER_ARM * length), 0)


def _along(axis: Array, link: Array) -> bool:
    """True if a joint with an axis (3,) rolls about a link (3,)."""
    return bool(abs(axis @ link) > ROLLS * np.linalg.norm(link))


def _leg(
    robot: Robot,
    joints: Sequence[int],
    sole: Sole,
    goal: object,
    q: Array,
    forward: Array,
    rng: np.random.Generator,
    *,
    follow: bool,
) -> Array:
    """The configuration with a leg's sole at its goal, a pin.SE3, and the knee as far forward as possible.

    joints : of the leg, of which the last six (or all) move.
    follow : take the configuration that is found from q, where the knee is forward already.
    """
    model, data = robot.model, robot.model.createData()
    fid, own = model.getFrameId(sole.frame), _columns(robot, joints[-LEG:])
    low, high = _limits(robot, own)
    now = robot.joint_positions(q)[own]
    best, nearest = None, np.inf

    def remaining(angles: Array) -> pin.SE3:
        pin.computeJointJacobians(model, data, _set(robot, q, own, angles))
        return pin.updateFramePlacement(model, data, fid).actInv(goal)

    def errors(angles: Array) -> Array:
        return np.asarray(pin.log6(remaining(angles)).vector)

    def jacobian(angles: Array) -> Array:
        left = remaining(angles)
        twists = pin.getFrameJacobian(model, data, fid, pin.LOCAL)[:, robot.nv - robot.n + own]
        # the sole moves by exp(twist): exp(-twist) left = left exp(-Ad(left)^-1 twist)
        return np.asarray(-pin.Jlog6(left) @ left.toActionMatrixInverse() @ twists)

    for k in range(2 * STARTS):
        start = np.clip(now + (0.6 * rng.standard_normal(len(own)) if k else 0.0), low, high)
        found = least_squares(
            errors, start, jacobian, bounds=(low - 1e-9, high + 1e-9), xtol=1e-14, ftol=1e-14, gtol=1e-14
        )
        off = float(np.abs(errors(found.x)).max())
        nearest = min(nearest, off)
        if off > LEVEL:
            continue
        knee = max(float(data.oMi[j].translation @ forward) for j in joints)
        if best is None or knee > best[0] + 1e-4:
            best = knee, found.x
        if follow:
            break
    if best is None:
        names = [model.names[j] for j in joints]
        raise InputError(
            f"no posture with level soles is found for the leg {', '.join(map(str, names))}: the best one is"
            f" {nearest:.2g} m or rad off; give postures by hand (docs/howto/robot.md)"
        )
    return _set(robot, q, own, best[1])


def _columns(robot: Robot, joints: Sequence[int]) -> Index:
    """Indices into arrays of length n of joints of the model, each once; a follower has its leader's."""
    base = robot.nv - robot.n
    return np.array(list(dict.fromkeys(robot.model.joints[j].idx_v - base for j in joints)), dtype=np.intp)


def _limits(robot: Robot, own: Index) -> tuple[Array, Array]:
    """Position limits of joints, of a turn at most, tightened by a margin."""
    low, high = (limits[own] for limits in drawn_ranges(robot))
    margin = np.minimum(MARGIN * (high - low) / 2, 0.15)
    return low + margin, high - margin


def rested(robot: Robot) -> Array:
    """The configuration (nq,) nearest to zero that keeps a margin to the limits."""
    q, every = neutral(robot.model), np.arange(robot.n)
    low, high = _limits(robot, every)
    return _set(robot, q, every, np.clip(robot.joint_positions(q), low, high))


def eased(robot: Robot, limbs: Sequence[Limb], q: Array) -> Array:
    """The configuration (nq,) near q with limbs moved so that their gravity torques are small.

    Of several the one with the fewest collisions of links.
    """
    own = _columns(robot, [joint for limb in limbs for joint in limb.own])
    data = robot.model.createData()
    low, high = _limits(robot, own)
    rest, rng = robot.joint_positions(q)[own], np.random.default_rng(0)

    def errors(angles: Array) -> Array:
        share = _gravity_share(robot, data, _set(robot, q, own, angles), own)
        return np.concatenate(
            [np.maximum(share - GRAVITY_SHARE, 0.0), RANGE_COST * (angles - rest) / (high - low)]
        )

    if not errors(rest)[: len(own)].any():
        return q
    tries = []
    for _ in range(STARTS):
        start = np.clip(rest + 0.25 * (high - low) * rng.standard_normal(len(own)), low, high)
        found = least_squares(errors, start, bounds=(low - 1e-9, high + 1e-9), max_nfev=60)
        posture = _set(robot, q, own, found.x)
        tries.append((len(bodies_of(robot).piece_pairs(posture)[1]), float(found.cost), posture))
    return min(tries, key=lambda one: one[:2])[2]


def _gravity_share(robot: Robot, data: pin.Data, q: Array, own: Index) -> Array:
    """Gravity torques of joints at q (nq,) over their torque limits."""
    gravity = robot.generalized_gravity(data, q)
    return np.asarray(np.abs(gravity[robot.nv - robot.n + own]) / robot.torque_limit[own])


def _set(robot: Robot, q: Array, own: Index, angles: Array) -> Array:
    """The configuration with other angles of some joints; own : their indices in arrays of length n."""
    every = robot.angles.of(q)
    every[own] = angles
    return robot.angles.put(q.copy(), every)


def _path(robot: Robot, joints: Sequence[int]) -> float:
    """Length [m] of the steps to each of these joints from the one before."""
    return sum(float(np.linalg.norm(robot.model.jointPlacements[j].translation)) for j in joints)
