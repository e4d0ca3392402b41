"""Summary of a plan for the live page, as Markdown."""

from __future__ import annotations

from impactopt.live.replanning import Answer
from impactopt.planning.solution import Solution

__all__ = ["failure_message", "plan_message"]

_WORST = 5  # constraints


def plan_message(answer: Answer, first: Solution) -> str:
    """A plan's numbers, how it was found, and its worst constraints."""
    solution = answer.solution
    assert solution is not None
    plan, duration = solution.plan, solution.plan.compression + solution.plan.restitution
    lines = [
        f"**{solution.impulse:.2f} N s** (first plan: {first.impulse:.2f})",
        f"- {plan.hand_speed:.2f} m/s at contact",
    ]
    if duration > 0:
        lines.append(f"- {plan.collision.force.max():.0f} N at most, for {1e3 * duration:.1f} ms")
    for name, words, unit, factor in (
        ("zmp_margin_m", "ZMP margin", " mm", 1e3),
        ("torque_ratio", "torque", " % of its limit", 1e2),
    ):
        told = ", ".join(f"{phase} {factor * x:.0f}" for phase, x in answer.margins.get(name, {}).items())
        lines += [f"- {words}: {told}{unit}"] if told else []
    seconds = first.solve_seconds if solution is first else answer.seconds
    lines.append(f"\n{solution.status.value}: {solution.result.iterations} iterations, {seconds:.2f} s")
    worst = [f"- {row}" for row in solution.violations[:_WORST]]
    return "\n".join(
        [*lines, *(["\nViolated constraints:", *worst] if worst else ["\nAll constraints are met."])]
    )


def failure_message(answer: Answer) -> str:
    """Message that there is no plan, with the reason, and that the one before is still drawn."""
    return f"**No plan for this.** {answer.why}\n\nThe one before is shown ({answer.seconds:.2f} s)."
