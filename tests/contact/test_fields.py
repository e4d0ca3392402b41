"""What fields of laws, targets, terms and objectives say is what classes and problem files hold to."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from typing import Any

import pytest
from pydantic import ValidationError

import impactopt
from impactopt import InputError
from impactopt.contact.fields import About, Described, about, abouts
from impactopt.contact.laws import LAWS, ContactLaw, CustomLaw
from impactopt.contact.targets import TARGETS, Target
from impactopt.files.sections.values import section_of
from impactopt.problem.objectives import OBJECTIVES, Objective
from impactopt.problem.terms import TERMS, Term

# package -> its classes, and others that are defined there
FAMILIES: dict[str, tuple[tuple[type, ...], set[type]]] = {
    "contact.laws": (LAWS, {ContactLaw, CustomLaw}),
    "contact.targets": (TARGETS, {Target}),
    "problem.objectives": (OBJECTIVES, {Objective}),
    "problem.terms": (TERMS, {Term}),
}
KINDS = [kind for kinds, _ in FAMILIES.values() for kind in kinds]
# of one instance of each, what has no default
NEEDED: dict[str, Any] = {"axis": (1.0, 0.0, 0.0), "frame": "head", "limit": 1.0, "radius": 0.1}


@pytest.mark.parametrize("name", FAMILIES)
def test_each_class_is_listed_and_public(name: str) -> None:
    """A class whose line in the package's list was forgotten is found here."""
    kinds, others = FAMILIES[name]
    package = importlib.import_module(f"impactopt.{name}")
    # a family is one file, or a folder of files
    files = pkgutil.iter_modules(getattr(package, "__path__", ()), f"impactopt.{name}.")
    modules = [package, *(importlib.import_module(file.name) for file in files)]
    family = {
        thing
        for module in modules
        for thing in vars(module).values()
        if isinstance(thing, type)
        and issubclass(thing, tuple(others))
        and thing.__module__ == module.__name__
    }
    assert family - others == {*kinds}
    for kind in kinds:
        assert getattr(impactopt, kind.__name__) is kind


def instance(kind: type, **changes: Any) -> Any:
    needed = {
        f.name: NEEDED.get(f.name, 1.0)
        for f in dataclasses.fields(kind)
        if f.default is dataclasses.MISSING or f.name == "radius"
    }
    return kind(**(needed | changes))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_class_and_its_section_have_the_same_range(kind: type) -> None:
    section = section_of(kind)
    assert [f.name for f in dataclasses.fields(kind)] == list(section.model_fields)
    made = instance(kind)
    for field, told in abouts(kind):
        outside = [told.least - 1e-6] if told.least is not None else []
        outside += [told.above] if told.above is not None else []
        outside += [told.most + 1e-6] if told.most is not None else []
        for value in outside:
            with pytest.raises(InputError, match=f"{kind.__name__}.*{field.name}"):
                instance(kind, **{field.name: value})
            given = {
                known.key_of(f.name): list(v) if isinstance(v := getattr(made, f.name), tuple) else v
                for f, known in abouts(kind)
                if getattr(made, f.name) is not None
            }
            with pytest.raises((ValidationError, InputError)):
                section.model_validate(given | {told.key_of(field.name): value})
            section.model_validate(given)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_docstring_lists_each_field_with_its_unit(kind: type) -> None:
    listed = str(kind.__doc__).split("----------\n")[-1].split("\n")
    for field, told in abouts(kind):
        assert any(line.startswith(f"{field.name} : {told.text}") for line in listed)
        assert told.unit in told.text


@pytest.mark.parametrize(
    ("field", "unit", "key"),
    [
        ("mass", "kg", "mass_kg"),
        ("speed", "m/s", "speed_m_s"),
        ("damping", "N s/m^1.25", "damping_N_s_m1_25"),
        ("stiffness", "N/m^p", "stiffness_N_mp"),
        ("limit", "rad/s^2", "limit_rad_s2"),
        ("fraction", "", "fraction"),
    ],
)
def test_a_key_has_its_unit(field: str, unit: str, key: str) -> None:
    assert About(what="", unit=unit).key_of(field) == key
    assert About(what="", unit=unit, key="other").key_of(field) == "other"


def test_a_range_is_told_and_held() -> None:
    said = About(what="along it; inf: any", unit="m/s", above=0, most=2)
    assert said.text == "along it [m/s]; inf: any"
    assert said.range == "> 0 and <= 2"
    assert [said.allows(x) for x in (-1.0, 0.0, 1e-9, 2.0, 2.1, float("nan"))] == [0, 0, 1, 1, 0, 0]
    assert About(what="").allows(-1e9) and About(what="").range == ""
    assert not About(what="", least=1).allows(0.999)


def test_a_section_is_made_of_any_such_class() -> None:
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Rope(Described):
        """A rope.

        More of it.
        """

        length: float = dataclasses.field(metadata=about("of it", unit="m", above=0, most=9))
        colour: str | None = dataclasses.field(default=None, metadata=about("seen", choices=("red", "blue")))
        slack: float = dataclasses.field(default=0.5, metadata=about("any; inf too", endless=True, least=0))
        hidden: int = 3

    section = section_of(Rope)
    assert section.model_validate({"length_m": 2.0, "colour": "red", "slack": float("inf")}).build() == Rope(
        length=2.0, colour="red", slack=float("inf")
    )
    for wrong in ({"length_m": 10.0}, {"length_m": 1.0, "colour": "green"}, {"length_m": 1.0, "hidden": 4}):
        with pytest.raises(ValidationError):
            section.model_validate(wrong)
    assert "length : of it [m]; > 0 and <= 9." in str(Rope.__doc__)
    assert "hidden" not in str(Rope.__doc__)
