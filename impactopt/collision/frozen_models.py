"""The models of a collision that stand by themselves and have frozen dynamics, by their names."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from impactopt.collision.sdc import SDC
from impactopt.collision.symbolic import SymbolicModel
from impactopt.collision.virtual_mass import VirtualMass
from impactopt.errors import InputError, did_you_mean

__all__ = ["FROZEN", "frozen_model"]

FROZEN = ("virtual-mass", "sdc-paper", "sdc")


def frozen_model(
    name: str, freezes: int = 0, *, accuracy: float | None = None, **scene: Any
) -> SymbolicModel:
    """The model that a plan with `ImpactProblem.collision` of this name has in it, on its own.

    Its steps find their own length, and "sdc-paper" has no virtual base but that of the stance: soles are
    held exactly, as plans do. `SDC.paper` by itself is the paper's in these too.

    Parameters
    ----------
    name : one of `FROZEN`.
    freezes, accuracy : of "sdc": as of `SDC`.
    scene : robot, striker, normal, law, target, stance, horizon: as of `SDC`.

    Raises
    ------
    InputError : an unknown name; what the models refuse.
    """
    if name == "virtual-mass":
        return VirtualMass(**scene)
    if name == "sdc-paper":
        return replace(SDC.paper(**scene), method=None, step=None)
    if name == "sdc":
        return SDC(**scene, freezes=freezes, accuracy=accuracy)
    raise InputError(
        f"no model with frozen dynamics is called {name!r}{did_you_mean(name, FROZEN)}: there are "
        + ", ".join(FROZEN)
    )
