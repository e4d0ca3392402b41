"""Terms and objectives of a user's own: they do what the package's do, or are refused with what to do."""

from __future__ import annotations

import math
from dataclasses import dataclass, make_dataclass, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from support.small_plans import changed

from impactopt import Effort, Gaze, Impulse, InputError, Objective, Status, Term, TorqueLimit, write_problem
from impactopt.planning.bounds import bounds_of
from impactopt.planning.strike import optimize_strike
from impactopt.problem.block import make_block
from impactopt.problem.violation import millimetres
from impactopt.solvers.ipm import solve_ipm
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.transcription.blocks import key_of
from impactopt.transcription.initial_guess import first_iterate, strike_iterate
from impactopt.transcription.objective import Quantity
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]


def height_of(frame: str, coordinates: Any) -> Any:
    y, legs = ca.SX.sym("y", coordinates.ny), ca.SX.sym("legs", coordinates.nl)
    _, origin = coordinates.rb_frame(frame, coordinates.configuration(y, legs))
    return make_block([y, legs], [], {"height": origin[2]})


@dataclass(frozen=True, kw_only=True)
class Ceiling(Term):
    """As in docs/extending.md."""

    name: ClassVar[str] = "ceiling"
    unit: ClassVar[str] = "m"
    frame: str = "hand"
    height: float

    @property
    def frames(self) -> tuple[str, ...]:
        return (self.frame,)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, Any]:
        return {"ceiling": height_of(self.frame, coordinates)}

    def add_constraints(self, program: Any) -> None:
        spots = [*program.swing_spots(), *program.follow_spots()]
        at = program.add_block("ceiling", [slots for _, slots in spots], np.zeros(0))
        for k, (place, _) in enumerate(spots):
            program.constraints.add(
                term=self.name,
                place=place,
                components=[self.frame],
                outputs=np.array([at + k]),
                upper=self.height,
                measure=millimetres("too high"),
            )


@dataclass(frozen=True, kw_only=True)
class Strain(Objective):
    """Cost: the integral of the squares of torque over limit, as `Effort`, of the swing, and by a block."""

    name: ClassVar[str] = "strain"
    unit: ClassVar[str] = "s"
    cost: ClassVar[bool] = True
    whole_motion: ClassVar[bool] = True
    needs_torques: ClassVar[bool] = True

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, Any]:
        torque, T = ca.SX.sym("torque", problem.robot.n), ca.SX.sym("T")
        return {"strain": make_block([torque, T], [], {"strain": T * ca.sumsqr(torque)})}

    def quantity(self, program: Any) -> Any:
        count = len(program.swing_nodes)
        slots = [[torque, program.swing_T[0]] for torque in program.torques[:count]]
        at = program.add_block("strain", slots, np.zeros(0))
        labels = [program.swing_place(s).name for s in program.swing_nodes]
        strains = program.lift("strain", at + np.arange(count), labels=labels)[0]
        return strains.apply(np.gradient(np.concatenate([[0.0], program.swing_nodes]))[None, 1:])


@dataclass(frozen=True, kw_only=True)
class Pushes(Objective):
    """Squares of variables: the feed-forward at contact."""

    name: ClassVar[str] = "push"
    unit: ClassVar[str] = "-"
    cost: ClassVar[bool] = True

    def quantity(self, program: Any) -> Any:
        return Quantity(program.contact_T * 0.0, program.feedforward)


def heights(t: Transcription, x: Array) -> Array:
    """Of the hand at the nodes, by Pinocchio."""
    model, plan = t.robot.model, t.decode(x)
    data, out = model.createData(), []
    for curve, nodes in ((plan.swing, t.swing_nodes), (plan.follow, t.follow_nodes)):
        for y in curve.sample(nodes * curve.duration)[0]:
            pin.framesForwardKinematics(model, data, t.coordinates.join(y, np.zeros(0)))
            out.append(float(data.oMf[model.getFrameId("hand")].translation[2]))
    return np.array(out)


def test_a_plan_obeys_a_term_of_ones_own(arm_transcription: Transcription) -> None:
    """With either solver; where it cannot, the term is named."""
    free = solve_ipopt(arm_transcription.program, first_iterate(arm_transcription))
    top = heights(arm_transcription, free.x).max()
    term = Ceiling(height=float(top - 0.01))
    t = changed(arm_transcription, terms=(term,))
    for result in (
        solve_ipm(t.program, first_iterate(t)),
        solve_ipopt(t.program, first_iterate(t)),
    ):
        assert result.status is Status.SOLVED
        assert heights(t, result.x).max() <= term.height + 1e-5
    low = changed(arm_transcription, terms=(Ceiling(height=0.2),))
    result = solve_ipopt(low.program, first_iterate(low))
    assert result.status is Status.INFEASIBLE
    assert "ceiling, " in result.message and " mm too high" in result.message
    (bound,) = (bound for bound in bounds_of(low) if bound.name == "ceiling")
    (cause,) = bound.causes(result.x)
    assert "(Ceiling.height; " in cause.text, "no section of a file has it"


@pytest.mark.filterwarnings("error::impactopt.errors.NoCompilerWarning")
def test_a_block_may_be_named_as_a_function_of_c(arm_transcription: Transcription) -> None:
    class Floor(Ceiling):
        def blocks(self, problem: Any, coordinates: Any) -> dict[str, Any]:
            return {"floor": height_of(self.frame, coordinates)}

    problem = replace(arm_transcription.problem, terms=(Floor(height=1.0),))
    assert "floor_hess" in block_functions(problem)


def test_variables_with_a_name_that_is_taken_are_refused(arm_transcription: Transcription) -> None:
    class Taken(Pushes):
        def quantity(self, program: Any) -> Any:
            program.layout.add("swing duration", 1, 1)
            return super().quantity(program)

    with pytest.raises(InputError, match="there are variables 'swing duration' already"):
        changed(arm_transcription, objectives=(Impulse(), Taken(weight=1.0)))


def test_an_objective_of_ones_own_is_kept_small(arm_transcription: Transcription) -> None:
    objectives = (Impulse(), Strain(weight=10.0))
    t = changed(arm_transcription, objectives=objectives)
    result = solve_ipm(t.program, first_iterate(t))
    assert result.status is Status.SOLVED
    plan, limit = t.decode(result.x), t.robot.torque_limit
    swing = plan.trajectory(hold=0.0)
    k = swing.phase == 0
    exact = float(trapezoid(np.sum((swing.torque[k] / limit) ** 2, axis=1), swing.time[k]))
    assert t.achieved(result.x)["strain"] == pytest.approx(exact, rel=0.1)
    easy = changed(arm_transcription, objectives=(Impulse(), Effort(weight=10.0)))
    less = solve_ipm(easy.program, first_iterate(easy))
    assert t.impulse(result.x) == pytest.approx(easy.impulse(less.x), rel=0.2), "it is the larger part of it"


def test_squares_of_variables_are_weighed(arm_transcription: Transcription) -> None:
    plain = changed(arm_transcription)
    first = solve_ipm(plain.program, first_iterate(plain))
    t = changed(arm_transcription, objectives=(Impulse(), Pushes(weight=0.5)))
    result = solve_ipm(t.program, first_iterate(t))
    push = float(np.sum(t.feedforward.read(result.x) ** 2))
    assert t.achieved(result.x)["push"] == pytest.approx(push)
    assert push < float(np.sum(plain.feedforward.read(first.x) ** 2))
    assert -result.objective == pytest.approx(t.impulse(result.x) - 0.5 * push, abs=0.02)  # and small prices


def test_a_strike_takes_what_says_something_of_it(arm_transcription: Transcription) -> None:
    own = {"terms": (Ceiling(height=2.0),), "objectives": (Impulse(), Strain(weight=1.0))}
    t = changed(arm_transcription, **own)
    strike = StrikeTranscription(t.problem, t.functions)
    assert [o.name for o, _ in strike.objectives] == ["impulse"]
    names = [strike.program.constraint_name(i) for i in range(strike.program.m)]
    assert [name for name in names if name.startswith("ceiling")] == [
        "ceiling, contact, hand",
        "ceiling, after contact, hand",
    ]
    assert np.isfinite(strike.program.constraints(strike_iterate(strike))).all()
    with pytest.raises(InputError, match="no objective of this problem is one of a strike"):
        optimize_strike(replace(t.problem, objectives=(Strain(weight=1.0),)))


def test_a_subclass_of_one_of_the_packages_is_that_one(arm_transcription: Transcription) -> None:
    """It was ignored before, or a KeyError."""

    @dataclass(frozen=True, kw_only=True)
    class Stare(Gaze):
        angle: float = 0.3

    @dataclass(frozen=True, kw_only=True)
    class Thrift(Effort):
        weight: float = 3.0

    @dataclass(frozen=True, kw_only=True)
    class Weak(TorqueLimit):
        fraction: float = 0.5

    def program(*terms: Term, effort: Effort) -> Any:
        return changed(arm_transcription, terms=terms, objectives=(Impulse(), effort)).program

    look = {"frame": "elbow", "axis": (0, 0, 1)}
    mine = program(Stare(**look), Weak(), effort=Thrift())
    same = program(Gaze(**look, angle=0.3), TorqueLimit(fraction=0.5), effort=Effort(weight=3.0))
    assert [mine.constraint_name(i) for i in range(mine.m)] == [
        same.constraint_name(i) for i in range(same.m)
    ]
    x = np.random.default_rng(0).normal(size=mine.n)
    np.testing.assert_array_equal(mine.constraints(x), same.constraints(x))
    assert mine.objective(x) == same.objective(x)
    with pytest.raises(InputError, match="two terms of kind Gaze"):
        program(Stare(**look), Gaze(**look), effort=Effort())


def test_constraints_that_would_be_ignored_are_refused(arm_transcription: Transcription) -> None:
    def add(program: Any, **changes: Any) -> None:
        at = program.add_block("ceiling", [slots for _, slots in program.swing_spots()], np.zeros(0))
        ours = {"outputs": at + np.arange(len(program.swing_spots())), "upper": 2.0} | changes
        program.constraints.add(term="own", components=["hand"] * len(ours["outputs"]), **ours)

    class Own(Ceiling):
        def __init__(self, changes: dict[str, Any] | None) -> None:
            super().__init__(height=1.0)
            object.__setattr__(self, "changes", changes)

        def add_constraints(self, program: Any) -> None:
            if self.changes is not None:
                add(program, **self.changes)

    for changes, words in (
        (None, "Own.add_constraints adds no constraint"),
        ({"upper": np.inf}, "Own.add_constraints adds no constraint with a finite bound"),
        ({"upper": np.nan}, "own: a bound of its constraints is NaN"),
        ({"upper": [1.0, 2.0]}, r"own: a bound of its \d+ constraints is .*2.0.*; give one number"),
        *(({"measure": x}, "own: measure must be a Measure, or one for each component") for x in ("mm", 1.0)),
        ({"place": None}, "own: place must be a Place, not None"),
        ({"outputs": np.array([0])}, r"Own.add_constraints: \d+ of the \d+ outputs of its blocks are in no"),
    ):
        with pytest.raises(InputError, match=words):
            changed(arm_transcription, terms=(Own(changes),))
    assert changed(arm_transcription, terms=(Own({}),)).program.m > arm_transcription.program.m

    class Far(Pushes):
        def quantity(self, program: Any) -> Any:
            return program.lift("far", np.array([10**6]))[0]

    with pytest.raises(InputError, match="far, far: there is no output 1000000 of a block"):
        changed(arm_transcription, objectives=(Impulse(), Far(weight=1.0)))


def test_what_a_program_would_know_nothing_of_is_refused(arm_transcription: Transcription) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Silent(Term):
        name: ClassVar[str] = "silent"

    @dataclass(frozen=True, kw_only=True)
    class Wish(Objective):
        name: ClassVar[str] = "wish"
        weight: float = 1.0

    @dataclass(frozen=True, kw_only=True)
    class Again(Pushes):
        pass

    class Nameless(Ceiling):
        name: ClassVar[str] = ""

    problem = arm_transcription.problem
    # the field's type is a class here, not its name as text
    low = make_dataclass("Low", [("height", float)], bases=(Term,), frozen=True, kw_only=True)
    with pytest.raises(InputError, match=r"Low\.height: expected numbers, got 'high'"):
        low(height="high")
    for terms, words in (
        ((Silent(),), r"Silent has no add_constraints\(program\).*docs/extending.md"),
        ((Term(),), r"Term has no add_constraints\(program\)"),
        ((Nameless(height=1.0),), "Nameless.name is empty"),
        ((Ceiling(height=1.0), Ceiling(height=2.0)), "two terms of kind Ceiling"),
        ((Ceiling(height=1.0, frame="hnd"),), "no frame 'hnd'.*did you mean 'hand'"),
        (("ceiling",), "terms must be a tuple of terms"),
    ):
        with pytest.raises(InputError, match=words):
            replace(problem, terms=terms)
    for objectives, words in (
        ((Wish(),), r"Wish has no quantity\(program\).*docs/extending.md"),
        ((Objective(weight=1.0),), r"Objective has no quantity\(program\)"),
        ((Pushes(weight=1.0), Again(weight=1.0)), "two objectives are called 'push'"),
    ):
        with pytest.raises(InputError, match=words):
            replace(problem, objectives=objectives)


def test_what_is_no_block_or_no_quantity_is_refused(arm_transcription: Transcription) -> None:
    class Odd(Ceiling):
        wrong: ClassVar[dict[str, Any]] = {}

        def blocks(self, problem: Any, coordinates: Any) -> dict[str, Any]:
            return self.wrong

    c = arm_transcription.coordinates
    good, y, legs = height_of("hand", c), ca.SX.sym("y", c.ny), ca.SX.sym("legs", c.nl)
    forgotten = make_block([y, legs], [], {"height": c.rb.mass_matrix()[0, 0]})
    rooted = make_block([y, legs], [], {"height": math.sqrt(y[0])})  # NaN, not an error
    for wrong, words in (
        ({"node": good}, "Odd.blocks: there is a block 'node' already"),
        ({"effort": good}, "Odd.blocks: there is a block 'effort' already"),
        ({"too high": good}, "Odd.blocks: 'too high' is no name for a function"),
        ({"ceiling": lambda y: y}, "Odd.blocks: 'ceiling' is .*make_block"),
        ({"ceiling": forgotten}, "Odd.blocks: 'ceiling' has symbols .* q_1"),
        ({"ceiling": rooted}, "Odd.blocks: 'ceiling' has NaN in its expression"),
    ):
        Odd.wrong = wrong
        with pytest.raises(InputError, match=words):
            changed(arm_transcription, terms=(Odd(height=1.0),), objectives=(Impulse(), Effort()))

    class Wide(Pushes):
        def quantity(self, program: Any) -> Any:
            return program.feedforward[0]

    class Number(Pushes):
        def quantity(self, program: Any) -> Any:
            return 3.0

    with pytest.raises(InputError, match="a block has CasADi's MX; write it with SX"):
        make_block([ca.MX.sym("y")], [], {"height": ca.MX.sym("y")})

    for kind in (Wide, Number):
        with pytest.raises(InputError, match=rf"{kind.__name__}\.quantity gave .*one affine expression"):
            changed(arm_transcription, objectives=(Impulse(), kind(weight=1.0)))

    class Unknown(Pushes):
        def quantity(self, program: Any) -> Any:
            return program.swing_T[0] * np.nan

    with pytest.raises(InputError, match=r"Unknown\.quantity has a number that is not finite"):
        changed(arm_transcription, objectives=(Impulse(), Unknown(weight=1.0)))


def test_mistakes_in_rows_are_told_where_they_are_made(arm_transcription: Transcription) -> None:
    """They were a KeyError, shapes of arrays elsewhere, or constraints without a derivative."""

    class Wrong(Ceiling):
        block: ClassVar[str] = "ceiling"
        numbers: ClassVar[Any] = 0
        rows: ClassVar[list[Any]] = []

        def add_constraints(self, program: Any) -> None:
            (_, slots), *_ = program.follow_spots()
            at = program.add_block(self.block, [slots], np.zeros(self.numbers))
            for components, outputs in self.rows:
                program.constraints.add(
                    term=self.name, components=components, outputs=at + outputs, upper=1.0
                )

    def program() -> Any:
        return changed(arm_transcription, terms=(Wrong(height=1.0),)).program

    Wrong.rows = [("a", 0)]
    assert program().constraint_name(program().m - 1) == "ceiling, a", (
        "a number is as good as an array of one"
    )
    violation = program().describe_violation(program().m - 1, first_iterate(arm_transcription), 0.15)
    assert violation == ("ceiling, a", "0.15 m beyond its bound"), "in the term's unit, without a measure"
    for attribute, value, words in (
        ("rows", [("ab", np.zeros(1, dtype=int))], "ceiling: outputs are 1, components 2"),
        ("rows", [("a", 0), ("b", 0)], "in two constraints, ceiling, a and ceiling, b: "),
        ("numbers", 2, "block ceiling takes 0 parameters, was given 2"),
        ("numbers", (2, 0), "block ceiling has 1 instances, was given parameters of 2"),
        ("block", "cieling", r"no block 'cieling' \(did you mean 'ceiling'\?\): return it from `blocks`"),
    ):
        setattr(Wrong, attribute, value)
        with pytest.raises(InputError, match=words):
            program()


def test_a_block_is_known_by_what_it_computes(arm_transcription: Transcription) -> None:
    """So that the cache does not give one formula's functions to another of the same name."""
    c = arm_transcription.coordinates
    keys = [key_of(height_of(frame, c)) for frame in ("hand", "hand", "elbow")]
    assert keys[0] == keys[1] != keys[2]


def test_a_problem_with_them_has_a_hash_but_no_file(arm_transcription: Transcription) -> None:
    problem = arm_transcription.problem
    hashes = [replace(problem, terms=(Ceiling(height=h),)).hash for h in (1.0, 1.0, 1.1)]
    assert hashes[0] == hashes[1] != hashes[2] and problem.hash not in hashes
    with pytest.raises(InputError):
        write_problem(replace(problem, terms=(Ceiling(height=1.0),)))
