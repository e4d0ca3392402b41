"""Do collisions hold at the edges: is every number right, or refused with a reason?

Gains x 1e-3 to 1e4, armature down to 0, links of 1e-3 to 1e3 kg, k of 1e2 to 1e9 N/m, d of 0 to 1e6 N s/m,
targets of 1e-4 to 1e6 kg and walls, v_c of 1e-6 to 30 m/s, none and negative, straight limbs, torque limits x
1e-9 to 1e12, virtual bases of 1e2 to 1e15 kg, 1 to 1000 freezes: drawn over all ranges at once, over narrower
ones, and with one thing at a time at its edge. Each case is judged by something independent:

* one freeze: the exact solution, piece by piece, without steps; where law or target are not linear, or it
  gives up, SciPy's LSODA on the same frozen dynamics;
* several freezes: full dynamics; the error has to fall with their number;
* effective mass: Pinocchio's matrices in 60-digit arithmetic.

A case agrees where its impulse is within its method's accuracy (`TOLERANCES`) and all else is finite.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.report import Report, Say, make_table
from benchmarks.stability_cases import RIGS, Case, Rig, draw
from benchmarks.stability_others import FREEZES, MASSES, freezes_of, masses_of, refusals
from benchmarks.stability_reference import TakesTooLong, reference
from impactopt.collision import Collision
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError
from impactopt.simulation.workers import map_on_workers

# of the impulse, or of that of a plastic blow of two masses where the contact is broken off before: what the
# methods say of themselves (see `SymbolicModel`)
TOLERANCES = {"implicit": 1e-5, "rk4": 1e-2}
CASES = 5400
VERDICTS = ("agree", "refused", "nan", "wrong")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a case: "agree", "refused", "nan" or "wrong"; why, and how far off."""

    verdict: str
    reason: str = ""
    error: float = 0.0
    case: str = ""


# ---------------------------------------------------------------- judging
def judge_rig(rig: Rig, cases: int) -> list[Outcome]:
    """Outcomes of so many cases of a rig."""
    model = rig.model()
    rng = np.random.default_rng([rig.seed, *map(ord, rig.name)])
    return [judge(model, draw(model, rng, k), rig.name) for k in range(cases)]


def judge(model: SymbolicModel, case: Case, name: str = "") -> Outcome:
    """One case."""
    what = f"{name}: {case}"
    try:
        found = model.collide(case.q, case.v, case.torque, require_separation=False, **case.overrides)
    except InputError as refusal:
        return Outcome(verdict="refused", reason=kind_of(str(refusal)))
    except Exception as crash:
        return Outcome(verdict="wrong", reason=type(crash).__name__, case=what)
    if not _finite(found):
        return Outcome(verdict="nan", reason="a result that is no number", case=what)
    try:
        expected, scale, by = reference(model, case)
    except TakesTooLong:
        return Outcome(verdict="refused", reason="nothing to judge it by in time")
    error = abs(found.impulse - expected.impulse) / max(abs(expected.impulse), scale, 1e-300)
    if error > TOLERANCES[model.stepping]:
        what += f": {found.impulse!r} N s in {found.duration:g} s, not {expected}"
        return Outcome(verdict="wrong", reason=f"impulse, by {by}", error=error, case=what)
    at_horizon = abs(expected.duration - model.horizon) < 1e-3 * model.horizon
    if found.separated != expected.separated and not at_horizon and expected.impulse > 1e-3 * scale:
        return Outcome(verdict="wrong", reason=f"separation, by {by}", error=error, case=what)
    return Outcome(verdict="agree", reason=by, error=error)


def kind_of(refusal: str) -> str:
    """A refusal without its numbers."""
    for words, kind in _REFUSALS.items():
        if words in refusal:
            return kind
    return refusal[:60]


_REFUSALS = {
    "is unstable here": "step unstable",
    "too long to follow this contact": "step too long for the contact",
    "steps are used up": "too many events for the steps",
    "diverges": "diverges",
    "ends within": "contact shorter than a step",
    "held frames depend on each other": "held frames depend on each other",
    "no motion along the normal": "hand held fast",
    "rounding": "rounding",
}


def _finite(found: Collision) -> bool:
    names = ("impulse", "peak_force", "duration", "energy", "velocity", "configuration", "force", "torque")
    return all(np.isfinite(x).all() for x in (getattr(found, n) for n in names) if x is not None)


# ---------------------------------------------------------------- the bench
def run(
    say: Say, *, cases: int | None = None, quick: bool = False, workers: int = 2, seed: int = 0
) -> Report:
    """Counts of outcomes; with `quick` a tenth of the cases, the large robots left out."""
    rigs = [replace(rig, seed=seed) for rig in RIGS if not (quick and rig.robot in ("standin", "talos"))]
    cases = CASES if cases is None else cases
    cases = cases // 10 if quick else cases
    share = sum(rig.share for rig in rigs)
    jobs: list[tuple[Any, ...]] = [("struck", rig, max(4, round(cases * rig.share / share))) for rig in rigs]
    bases = MASSES[:: 6 if quick else 1]
    jobs += [("mass", mass, max(3, cases // 400), seed) for mass in bases]
    jobs += [("freezes", FREEZES[: 3 if quick else None])] if FREEZES else []
    jobs.append(("refusals",))
    found = map_on_workers(
        _job,
        None,
        jobs,
        workers=workers,
        crashed=lambda code: [Outcome(verdict="wrong", reason=f"the process died ({code})")],
        progress=lambda done, of: say(f"{done} of {of} models struck"),
    )
    names = [job[1].name if job[0] == "struck" else _NAMES[job[0]].format(*job[1:]) for job in jobs]
    return report(names, found)


_NAMES = {"mass": "walker on M_g = {0:g} kg", "freezes": "arm, several freezes", "refusals": "bad input"}


def _job(_shared: None, job: tuple[Any, ...]) -> list[Outcome]:
    kind, *given = job
    if kind == "struck":
        return judge_rig(*given)
    judges: dict[str, Any] = {"mass": masses_of, "freezes": freezes_of, "refusals": refusals}
    found = judges[kind](*given)
    return [Outcome(verdict=v, reason=reason, error=error, case=case) for v, reason, error, case in found]


def _counts(outcomes: Sequence[Outcome]) -> dict[str, int]:
    return {verdict: sum(o.verdict == verdict for o in outcomes) for verdict in VERDICTS}


def report(names: Sequence[str], found: Sequence[Sequence[Outcome]]) -> Report:
    """What came out, in numbers and as a table."""
    every = [outcome for outcomes in found for outcome in outcomes]
    numbers: dict[str, Any] = {"cases": len(every), **_counts(every)}
    numbers["reasons"] = dict(Counter(f"{o.verdict}: {o.reason}" for o in every).most_common())
    numbers["rows"] = [
        {
            "model": name,
            "cases": len(outcomes),
            **_counts(outcomes),
            "largest_error": max((o.error for o in outcomes if o.verdict == "agree"), default=0.0),
        }
        for name, outcomes in zip(names, found, strict=True)
    ]
    numbers["failures"] = [
        {"reason": o.reason, "error": o.error, "case": o.case} for o in every if o.verdict in ("nan", "wrong")
    ][:50]
    rows = [
        [row["model"], *(str(row[v]) for v in ("cases", *VERDICTS)), f"{row['largest_error']:.0e}"]
        for row in [*numbers["rows"], {"model": "all", **numbers, "largest_error": 0.0}]
    ]
    table = make_table("collisions at the edges", ["model", "cases", *VERDICTS, "largest error"], rows)
    return Report(name="stability", numbers=numbers, tables=(table,))
