"""Is what is planned what happens?  TALOS punches, planned and then re-simulated in full dynamics.

    python benchmarks/bench_truth.py [--json]

One row a problem: solver time, planned impulse, and from the re-simulation the impulse's error, the least ZMP
margin, the largest torque demand over limit and the least normal force of a sole.  What fails stays in.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from impactopt import FreeMass, ImpactProblem, InputError, Phase, SpringDamper, solve, talos

VARIANTS: dict[str, dict[str, Any]] = {
    "demo": {},
    "nearer": {"point": [0.55, -0.2, 1.05]},
    "higher": {"point": [0.55, -0.3, 1.25]},
    "20 kg": {"target": FreeMass(mass=20.0)},
    "1 kg": {"target": FreeMass(mass=1.0)},
    "10 x stiffer": {"law": SpringDamper(stiffness=1e5, damping=300.0)},
    "left hand": {"striker": "left_hand", "point": [0.6, 0.25, 1.1]},
    "free durations": {
        "swing": Phase(duration=(0.5, 1.0)),
        "follow": Phase(duration=(0.6, 1.4), intervals=10),
    },
}


def row(name: str, changes: dict[str, Any]) -> dict[str, Any]:
    options: dict[str, Any] = {
        "robot": talos(),
        "striker": "right_hand",
        "point": [0.6, -0.25, 1.1],
        "normal": [1.0, 0.0, 0.0],
        "law": SpringDamper(stiffness=1e4, damping=300.0),
        "target": FreeMass(mass=5.0),
    }
    try:
        solution = solve(ImpactProblem(**{**options, **changes}), time_limit=60.0)
        summary = solution.summary(solution.validate())
    except InputError as error:
        return {"problem": name, "status": f"error: {error}"}
    simulated = summary["simulated"]
    return {
        "problem": name,
        "status": summary["status"],
        "iterations": summary["iterations"],
        "solve_seconds": summary["solve_seconds"],
        "impulse_planned_Ns": summary["impulse_Ns"],
        "impulse_error_pct": simulated["impulse_error_pct"],
        "zmp_margin_m": min(simulated["zmp_margin_m"].values()),
        "torque_ratio": max(simulated["torque_ratio"].values()),
        "min_normal_force_N": simulated["min_normal_force_N"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", action="store_true", help="print rows as JSON, no table")
    as_json = parser.parse_args().json
    rows = []
    if not as_json:
        print(f"{'problem':<15} {'status':<10} it     s  impulse  error %  ZMP mm  torque  force N")
    for name, changes in VARIANTS.items():
        rows.append(r := row(name, changes))
        if as_json:
            continue
        if "iterations" not in r:
            print(f"{name:<15} {r['status']}", flush=True)
            continue
        print(
            f"{name:<15} {r['status']:<10} {r['iterations']:3d} {r['solve_seconds']:5.1f} "
            f"{r['impulse_planned_Ns']:7.2f} {r['impulse_error_pct']:8.2f} {1e3 * r['zmp_margin_m']:7.1f} "
            f"{r['torque_ratio']:7.2f} {r['min_normal_force_N']:8.0f}",
            flush=True,
        )
    if as_json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
