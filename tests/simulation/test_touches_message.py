"""Message about penetrating bodies."""

from __future__ import annotations

from typing import Any

from impactopt.report.console import replayed_touches_message, touches_message


def touch(one: str, other: str, depth: float, **more: Any) -> dict[str, Any]:
    return {"one": one, "other": other, "start_s": 0.1, "end_s": 0.2, "depth_mm": depth, **more}


def test_nothing_is_said_where_nothing_touches() -> None:
    assert (
        touches_message({"contacts_besides": []})
        == touches_message({"contacts_besides": None})
        == touches_message({})
        == ""
    )


def test_the_deepest_is_named_and_pairs_are_counted_once() -> None:
    both = [
        touch("hand", "thigh", 3.2),
        touch("arm", "torso", 41.6),
        touch("hand", "thigh", 5.0, missed=True),
    ]
    said = touches_message({"contacts_besides": both})
    assert said.startswith("2 pairs of bodies penetrate each other, arm and torso by 42 mm")
    assert "two bodies penetrate" in touches_message({"contacts_besides": both[:1]})


def test_bodies_that_hit_each_other_in_a_replay_are_named_with_the_time_of_the_first() -> None:
    hits = [
        touch("hand", "thigh", 3.2),
        {**touch("arm", "torso", 0.3), "start_s": 0.0854},
        touch("hand", "thigh", 1.0),
    ]
    said = replayed_touches_message({"contacts_besides": hits})
    assert "arm and torso (and 1 more) hit each other from 0.085 s" in said and "gear loads" in said
    assert "hand and thigh hit each other from 0.100 s" in replayed_touches_message(
        {"contacts_besides": hits[::2]}
    )
    assert replayed_touches_message({"contacts_besides": None}) == replayed_touches_message({}) == ""
