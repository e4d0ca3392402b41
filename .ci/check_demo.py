"""Check the demo's summary.json: is the plan feasible, true in full dynamics, and does it stand?

Times are printed, not checked: they are the machine's as much as ours.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

PHASES = ("swing", "collision", "follow")
EDGE = 0.1  # [mm, N] by which a sole that tips on its edge may seem to be outside


def failures(summary: dict[str, Any]) -> list[str]:
    """What is wrong with a summary, a sentence each."""
    wrong = []

    def check(name: str, low: float, high: float) -> None:
        value: Any = summary
        for key in name.split("."):
            if not isinstance(value, dict) or key not in value:
                wrong.append(f"{name} is missing")
                return
            value = value[key]
        if not isinstance(value, int | float) or not math.isfinite(value) or not low <= value <= high:
            wrong.append(f"{name} is {value}, not in [{low:g}, {high:g}]")

    if summary.get("status") not in ("solved", "acceptable"):
        wrong.append(f"status is {summary.get('status')!r}, not 'solved' or 'acceptable'")
    check("max_violation", 0, 1e-4)
    check("impulse_Ns", 0, math.inf)
    check("simulated.impulse_error_pct", -2, 2)
    for phase in PHASES:
        check(f"simulated.zmp_margin_m.{phase}", 0, math.inf)
        check(f"simulated.torque_ratio.{phase}", 0, 1.02)
    wrong.extend(sole_failures(summary))
    check("replayed.impulse_error_pct", -3, 3)
    check("replayed.sole_slip_mm", 0, 5)
    check("replayed.sole_lift_collision_mm", 0, 2)
    for name, numbers in (("plan", summary), *((k, summary.get(k, {})) for k in ("simulated", "replayed"))):
        if numbers.get("contacts_besides") != []:
            wrong.append(f"{name}: bodies touch, or nobody looked: {numbers.get('contacts_besides')}")
    check("clearance_mm", 0, math.inf)
    replayed = summary.get("replayed", {})
    if replayed.get("standing") is not True:
        wrong.append(f"on free soles it does not stand: {replayed.get('reason', 'it was not replayed')}")
    return wrong


def sole_failures(summary: dict[str, Any]) -> list[str]:
    """Soles that keep less than half of a margin, planned or held, or are beyond their edges on free ones."""
    wrong = []
    for where in ("planned", "simulated", "replayed"):
        numbers = summary if where == "planned" else summary.get(where, {})
        for key, asked in (
            ("sole_cop_margin_mm", summary.get("sole_cop_margin_asked_mm", {})),
            ("sole_force_N", dict.fromkeys((*PHASES, "missed"), summary.get("sole_force_asked_N", 0.0))),
        ):
            soles = numbers.get(key)
            if not soles:
                wrong.append(f"{where}: {key} is missing")
                continue
            for sole, kept in soles.items():
                for phase in dict.fromkeys((*PHASES, *kept)):
                    least = -EDGE + (0.0 if where == "replayed" else asked.get(phase, 0.0) / 2)
                    if not kept.get(phase, -math.inf) >= least:
                        wrong.append(f"{where}: {key}.{sole}.{phase} is {kept.get(phase)}, below {least:g}")
    return wrong


def main() -> int:
    summary = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    wrong = failures(summary)
    for sentence in wrong:
        print(f"demo: {sentence}")
    if not wrong:
        shown = ("solver", "iterations", "solve_seconds", "build_seconds", "impulse_Ns")
        print("demo: " + ", ".join(f"{key} {summary.get(key)}" for key in shown))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
