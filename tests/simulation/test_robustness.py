"""Drawn perturbations, and replays under them: in range, reproducible, and a bad draw is a row of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fake_solution import still_problem, still_solution

from impactopt import (
    CustomLaw,
    InputError,
    Perturbation,
    PerturbationRanges,
    RigidWall,
    Robustness,
    SpringDamper,
    draw_perturbations,
)
from impactopt.simulation import ControllerSettings
from impactopt.simulation import workers as _workers
from impactopt.simulation.robustness import LOGARITHMIC, robustness
from impactopt.simulation.workers import map_on_workers

STEP = 1e-3


# ---------------------------------------------------------------- draws
def test_draws_are_in_range_and_fill_it() -> None:
    draws = draw_perturbations(400, seed=3)
    assert all(draw.period == 1e-3 and draw.delay == 0 and not draw.missing for draw in draws)
    for name, (low, high) in PerturbationRanges().bounds().items():
        value = np.array([getattr(draw, name) for draw in draws])
        assert low <= value.min() and value.max() <= high
        x, ends = (np.log(a) if name in LOGARITHMIC else a for a in (value, np.array([low, high])))
        # a tenth of the range is empty with a probability of 0.9^400 = 5e-19
        counts, _ = np.histogram((x - ends[0]) / (ends[1] - ends[0]), bins=10, range=(0.0, 1.0))
        assert counts.min() > 0 and counts.sum() == len(draws), name


def test_factors_are_as_often_halved_as_doubled() -> None:
    mass = np.array([draw.mass for draw in draw_perturbations(2000, seed=1)])
    assert np.mean(mass < 1.0) == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(len(mass)))


def test_a_seed_makes_the_draws_and_fewer_are_the_first_of_more() -> None:
    assert draw_perturbations(5, seed=7) == draw_perturbations(9, seed=7)[:5]
    assert draw_perturbations(5, seed=7) != draw_perturbations(5, seed=8)


def test_no_payload_is_lighter_than_one_may_be() -> None:
    """One of these was drawn with a payload of less than a milligram, which is refused."""
    ranges = PerturbationRanges(payload=(0.0, 1e-4))
    assert all(d.payload == 0 or d.payload >= 1e-6 for d in draw_perturbations(500, ranges=ranges))


def test_parameters_are_drawn_independently() -> None:
    names = PerturbationRanges().bounds()
    table = np.array([[getattr(d, n) for n in names] for d in draw_perturbations(2000)])
    correlation = np.corrcoef(table.T) - np.eye(table.shape[1])
    assert np.abs(correlation).max() < 5 / np.sqrt(len(table))


def test_a_range_without_width_is_that_number() -> None:
    draws = draw_perturbations(
        20, ranges=PerturbationRanges(mass=(1.3, 1.3), distance=(0.0, 0.0), period=0.0)
    )
    assert {draw.mass for draw in draws} == {1.3}
    assert {(draw.distance, draw.period) for draw in draws} == {(0.0, 0.0)}


def test_every_range_is_a_condition() -> None:
    assert set(PerturbationRanges().bounds()) <= {f.name for f in fields(Perturbation)}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"mass": (2.0, 0.5)}, "mass is from 2 to 0.5"),
        ({"kp": (0.0, 1.0)}, "kp starts at 0"),
        ({"payload": (-1.0, 1.0)}, "payload is -1"),
        ({"friction": (0.0, 1.0)}, "friction: 0; give"),
        ({"distance": (0.0, np.inf)}, "distance: inf at index 1; give a finite number"),
        ({"period": -1.0}, "period is -1"),
    ],
)
def test_a_spread_that_cannot_be_is_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        PerturbationRanges(**changes)


# ---------------------------------------------------------------- what is made of the rows
def made_up(standing: list[bool], *, impulse: list[float] | None = None, reasons: Any = None) -> Robustness:
    n = len(standing)
    return Robustness(
        perturbations=tuple(draw_perturbations(n)),
        drawn_from=PerturbationRanges(),
        standing=np.array(standing),
        reason=reasons if reasons is not None else tuple("" if s else "fell" for s in standing),
        impulse=np.array(impulse) if impulse is not None else np.full(n, 10.0),
        slip=np.zeros(n),
        lift=np.zeros(n),
        planned_impulse=10.0,
    )


@pytest.mark.parametrize("stands", [0, 3, 17, 20])
def test_wilsons_interval_is_where_the_score_test_turns(stands: int) -> None:
    """Its ends p solve (rate - p)^2 = z^2 p (1 - p) / n."""
    n = 20
    result = made_up([k < stands for k in range(n)])
    assert result.rate == stands / n

    w = 1.959964**2 / n
    ends = np.sort(np.roots([1 + w, -2 * result.rate - w, result.rate**2]))
    assert result.interval == pytest.approx(tuple(ends), abs=1e-9)


def test_impulses_are_of_all_draws_that_have_one() -> None:
    result = made_up([True, False, False], impulse=[12.0, 6.0, np.nan])
    assert result.rate == pytest.approx(1 / 3)
    assert (result.impulse_mean, result.impulse_std) == (9.0, 3.0)
    assert "1 of 3 draws stand, 9 N s" in repr(result)


def test_nothing_known_is_nan_without_a_warning() -> None:
    result = made_up([False], impulse=[np.nan])
    assert np.isnan(result.impulse_mean) and np.isnan(result.impulse_std)
    assert np.isnan(result.separation()["mass"]["stands"])
    assert sum(np.isnan(share) for share in result.by_third()["mass"]) == 2


def test_reasons_are_counted_without_their_numbers() -> None:
    reasons = (
        "",
        "fell: the base leans by 1.1 rad at t = 2.34 s",
        "fell: the base leans by 1.0 rad at t = 0.20 s",
        "the simulation diverged at t = 1e-05 s: take a smaller step than 0.0005 s, or softer gains",
        "leg_6 bears no load at the end",
    )
    counts = made_up([True] + [False] * 4, reasons=reasons).reasons()
    assert counts == {
        "fell: the base leans by ... rad at t = ... s": 2,
        "the simulation diverged at t = ... s: take a smaller step than ... s, or softer gains": 1,
        "leg_6 bears no load at the end": 1,
    }


def test_separation_finds_the_parameter_that_decides() -> None:
    heavy = [draw.mass > 1.0 for draw in draw_perturbations(200)]
    result = made_up(heavy)
    apart = {name: abs(v["apart"]) for name, v in result.separation().items()}
    assert max(apart, key=lambda name: apart[name]) == "mass" and apart["mass"] > 1.5
    means = result.separation()["mass"]
    assert means["falls"] < 1.0 < means["stands"]
    low, _, high = result.by_third()["mass"]
    assert (low, high) == (0.0, 1.0)


def test_thirds_show_a_middle_that_means_hide() -> None:
    spread = PerturbationRanges().bounds()["friction"]
    result = made_up([abs(d.friction - np.mean(spread)) < 0.06 for d in draw_perturbations(300)])
    low, middle, high = result.by_third()["friction"]
    assert middle > 0.8 and low == high == 0.0


# ---------------------------------------------------------------- replays
@pytest.fixture(scope="module")
def still() -> tuple[Any, Any]:
    """A biped that stands still with its fist at the target; and its reference."""
    problem = still_problem()
    return problem, still_solution(problem=problem).trajectory


def rows_of(result: Robustness) -> list[tuple[Any, ...]]:
    columns = (result.standing, result.reason, result.impulse, result.slip, result.lift)
    return [tuple(row) for row in zip(*columns, strict=True)]


@pytest.mark.slow
def test_one_worker_and_two_give_the_same_numbers(still: tuple[Any, Any]) -> None:
    told: list[tuple[int, int]] = []
    given: dict[str, Any] = {"draws": 3, "step": STEP / 2}
    one = robustness(*still, 1.0, **given, workers=1)
    two = robustness(*still, 1.0, **given, workers=2, progress=lambda done, of: told.append((done, of)))
    assert np.isfinite(one.impulse).all()
    assert rows_of(one) == rows_of(two)
    assert one.perturbations == two.perturbations == tuple(draw_perturbations(3))
    assert told == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.slow
def test_what_is_drawn_reaches_the_replay(still: tuple[Any, Any]) -> None:
    """A still robot stands by its servo, and falls without it; the payload is not the reason."""
    calm = PerturbationRanges(
        mass=(1.0, 1.0), payload=(0.0, 0.0), distance=(0.1, 0.1), kp=(1.0, 1.0), kd=(1.0, 1.0)
    )
    stands = robustness(*still, 1.0, draws=1, ranges=calm, workers=1, step=STEP)
    assert stands.rate == 1.0 and stands.reason == ("",)
    assert stands.impulse[0] == 0.0  # the target waits farther than the fist gets
    weak = PerturbationRanges(torque_limit=(0.01, 0.01), distance=(0.1, 0.1))
    falls = robustness(*still, 1.0, draws=1, ranges=weak, workers=1, step=STEP)
    assert falls.rate == 0.0 and falls.reason[0].startswith("fell")
    assert falls.lift[0] >= 0.0 and np.isfinite(falls.slip[0])


def test_a_controller_has_its_own_rate(still: tuple[Any, Any]) -> None:
    slow = ControllerSettings(rate=250.0)
    result = robustness(*still, 1.0, draws=1, workers=1, step=STEP, controller=slow)
    assert result.perturbations[0].period == result.drawn_from.period == 0


@pytest.mark.slow
def test_of_a_wall_no_mass_is_drawn(still: tuple[Any, Any]) -> None:
    _, motion = still
    wall = still_problem(target=RigidWall())
    result = robustness(
        wall, motion, 1.0, draws=2, ranges=PerturbationRanges(distance=(0.1, 0.1)), workers=1, step=STEP
    )
    assert [c.mass for c in result.perturbations] == [1.0, 1.0] and result.drawn_from.mass == (1.0, 1.0)
    assert len({c.stiffness for c in result.perturbations}) == 2
    assert np.isfinite(result.impulse).all(), result.reason


def test_a_law_that_cannot_go_to_processes_is_refused(still: tuple[Any, Any]) -> None:
    _, motion = still
    problem = still_problem(law=CustomLaw(compression=lambda x, _rate, k: k * x, k=1e4))
    with pytest.raises(InputError, match="no lambdas, or ask for workers=1"):
        robustness(problem, motion, 1.0, draws=2, workers=2, step=STEP)


def test_a_replay_that_diverges_is_a_row(still: tuple[Any, Any]) -> None:
    """The fist, pressed into a target far stiffer than the step can follow."""
    _, motion = still
    problem = still_problem(law=SpringDamper(stiffness=1e9, damping=300.0))
    hard = PerturbationRanges(stiffness=(1e6, 1e6), distance=(-0.01, -0.01))
    result = robustness(problem, motion, 1.0, draws=2, ranges=hard, workers=1, step=STEP)
    assert not result.standing.any()
    assert all("diverged" in reason for reason in result.reason)
    assert np.isnan(result.impulse).all() and np.isnan(result.slip).all() and np.isnan(result.lift).all()


def test_what_an_engine_raises_is_a_row(still: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_args: Any, **_options: Any) -> None:
        raise ArithmeticError("no such luck")

    monkeypatch.setattr("impactopt.simulation.robustness.simulate_mujoco", broken)
    result = robustness(*still, 1.0, draws=2, workers=1, step=STEP)
    assert result.reason == ("ArithmeticError: no such luck",) * 2


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"draws": 0}, "draws: 0; give a whole number from 1"),
        ({"seed": -1}, "seed: -1; give a whole number from 0"),
        ({"workers": 0}, "0 workers"),
        ({"step": 0.0}, r"step \[s\]: 0; give a number > 0"),
        ({"step": float("nan")}, r"step \[s\]: nan; give a finite number"),
    ],
)
def test_options_out_of_range_are_refused(still: tuple[Any, Any], options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        robustness(*still, 1.0, **options)


# ---------------------------------------------------------------- processes
def die(shared: int, given: int) -> int:
    """For worker processes: one of the inputs ends them."""
    if given == shared:
        os.kill(os.getpid(), signal.SIGKILL)
    return given * given


@pytest.mark.slow
def test_a_process_that_dies_costs_its_own_input_only() -> None:
    found = map_on_workers(die, 2, [1, 2, 3, 4], workers=2, crashed=lambda code: code)
    assert found == [1, -signal.SIGKILL, 9, 16]


def test_one_worker_is_this_process() -> None:
    assert map_on_workers(lambda a, b: a + b, 1, [1, 2], workers=1, crashed=int) == [2, 3]


def run_script(folder: Path, text: str) -> subprocess.Popen[str]:
    script = folder / "script.py"
    script.write_text(textwrap.dedent(text), encoding="utf-8")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    try:
        return subprocess.Popen(
            [sys.executable, str(script)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
def test_a_script_without_a_guard_is_told_of_it(tmp_path: Path) -> None:
    process = run_script(
        tmp_path,
        """\
        from impactopt.simulation.workers import map_on_workers

        def square(_, x):
            return x * x

        map_on_workers(square, None, [1, 2], workers=2, crashed=int)
        """,
    )
    _, errors = process.communicate(timeout=60)
    assert process.returncode != 0
    assert 'under `if __name__ == "__main__":`' in errors


@pytest.mark.slow
def test_ctrl_c_ends_the_processes_and_is_raised(tmp_path: Path) -> None:
    process = run_script(
        tmp_path,
        """\
        import os, time
        from impactopt.simulation.workers import map_on_workers

        def wait(_, x):
            os.write(1, f"{os.getpid()}\\n".encode())  # at once: two of them write
            time.sleep(60)

        if __name__ == "__main__":
            try:
                map_on_workers(wait, None, [1, 2, 3], workers=2, crashed=int)
            except KeyboardInterrupt:
                print("stopped", flush=True)
        """,
    )
    assert process.stdout is not None
    workers = [int(process.stdout.readline()) for _ in range(2)]
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all processes of the command
    output, errors = process.communicate(timeout=30)
    assert (output, errors, process.returncode) == ("stopped\n", "", 0)
    for pid in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_workers_do_not_see_ctrl_c() -> None:
    with _workers._interrupts_blocked():
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
