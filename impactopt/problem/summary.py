"""A problem in a few plain words and numbers, for reports."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from impactopt.bodies.world import body_message
from impactopt.problem.objectives import DEFAULT_OBJECTIVES
from impactopt.problem.terms import ON_DEMAND_TERMS

if TYPE_CHECKING:
    from impactopt.problem.problem import ImpactProblem

__all__ = ["described"]


def described(problem: ImpactProblem) -> dict[str, Any]:
    """Summary of a problem; see `ImpactProblem.describe`."""
    p = problem
    out: dict[str, Any] = {
        "name": p.name,
        "robot": p.robot.name,
        "striker": p.striker,
        "point_m": p.point.tolist(),
        "normal": p.normal.tolist(),
        "target": repr(p.target),
        "target_body": body_message(p.body, p.target),
        "law": repr(p.law),
        "hash": p.hash,
    }
    if not p.robot.floating:
        out["ground"] = "none" if p.ground_height is None else f"z = {p.ground_height:g} m"
    if p.collision != "full":
        frozen = f", {p.freezes} freezes" if p.freezes else ""
        more = {"rigid": f", restitution {p.coefficient_of_restitution:g}", "sdc": frozen}
        out["collision"] = p.collision + more.get(p.collision, "")
    if p.second is not None:
        out["second"] = {"striker": p.second.striker, "point_m": p.second.point.tolist()}
    if hands := p.stance.held_hands(p.robot):
        out["holds_on_with"] = [hand.name for hand in hands]
    if p.robot.source and p.robot.source.repairs:
        out["inertias"] = [f"repaired: {text}" for text in p.robot.source.repairs]
    if p.robot.source and p.robot.source.notes:
        out["notes"] = list(p.robot.source.notes)
    out |= {"scenarios": [str(s) for s in p.scenarios]} if p.scenarios else {}
    if p.gains:
        out["gains"] = [f"{', '.join(g.joints)}: {g.factor[0]:g} to {g.factor[1]:g} times" for g in p.gains]
    if p.objectives != DEFAULT_OBJECTIVES:
        out["objectives"] = [f"{o.weight:g} x {o.name} [{o.unit}]" for o in p.objectives]
    off = [term.name for term in (p.self_collision, p.keep_out) if not term.active]
    off += [term.name for term in ON_DEMAND_TERMS if p.term(type(term)) not in p.on_demand]
    if off:
        out["off"] = off
    return out
