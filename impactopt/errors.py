"""Errors and warnings that users see, and the small checks that raise them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "FARTHEST",
    "MOST",
    "CacheWarning",
    "InputError",
    "Mistakes",
    "NoCompilerWarning",
    "NotSolvedWarning",
    "check_array",
    "check_choice",
    "check_positive",
    "did_you_mean",
    "missing_package",
    "printable",
]

FARTHEST = 1e3  # [m] from the origin of a frame or the world; micrometres still count there
# of any other number that is given, in SI units: products of a few such ones are still finite
MOST = 1e15
# a terminal obeys them, and half of a pair (a surrogate) cannot be written in UTF-8
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


class InputError(ValueError):
    """Bad input. The message names what is wrong, where, and how to correct it.

    mistakes : each of them, where the message has several.
    """

    def __init__(self, message: str = "", mistakes: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.mistakes = tuple(mistakes) or (message,)


class Mistakes:
    """Gathers what several checks find, so that all of it can be said at once."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def attempt(self, check: Callable[[], object]) -> bool:
        """True if a check passes; its InputError is kept."""
        try:
            check()
        except InputError as error:
            self.found += error.mistakes
            return False
        return True

    def raise_if_any(self, what: str) -> None:
        """One InputError for all mistakes of `what`."""
        if len(self.found) == 1:
            raise InputError(self.found[0])
        if self.found:
            rows = "".join(f"\n  {mistake}" for mistake in self.found)
            raise InputError(f"{what} has {len(self.found)} mistakes:{rows}", self.found)


class NoCompilerWarning(UserWarning):
    """No C compiler: functions run in CasADi's virtual machine or in NumPy, 10 to 100 times slower."""


class CacheWarning(UserWarning):
    """The on-disk cache of compiled functions cannot be used."""


class NotSolvedWarning(UserWarning):
    """A result that is no solution: its numbers are those of the best iterate, which is no plan."""


def did_you_mean(name: str, options: Iterable[str]) -> str:
    """The option nearest to a misspelt name, as the tail of a message.

    Returns " (did you mean 'x'?)", or "" when nothing is near.
    """
    candidates = {str(option).casefold(): str(option) for option in options}
    near = difflib.get_close_matches(str(name).casefold(), list(candidates), n=1, cutoff=0.6)
    return f" (did you mean {candidates[near[0]]!r}?)" if near else ""


def check_choice(what: str, given: object, known: Iterable[str]) -> None:
    """InputError for a name that is none of those known.

    what : begins the message, as "there is no picture".
    """
    names = [*known]
    if not isinstance(given, str) or given not in names:
        near = did_you_mean(str(given), names)
        raise InputError(f"{what} {shortened(repr(given))}{near}; there are {', '.join(names) or 'none'}")


def missing_package(what: str, package: str, extra: str) -> InputError:
    """The error for a package that is not installed, and how to get it: this one is on no index.

    what : that needs it, as "a sweep's table".  extra : of ours that brings it.
    """
    return InputError(
        f"{what} needs the package {package}; "
        f"in the folder of impactopt's clone run: pip install -e '.[{extra}]'"
    )


def printable(text: str) -> str:
    """Text for a terminal: control characters but new lines are shown by their codes, not obeyed."""
    return "".join(c if c == "\n" or c.isprintable() else repr(c)[1:-1] for c in text)


def has_control(text: str) -> bool:
    """True if a text has control characters besides tabs and new lines: no file, name or result may."""
    return _CONTROL.search(text) is not None


def check_name(what: str, name: object, *, empty: bool = False) -> None:
    """InputError if reports cannot call a thing so: it is no text, it is empty, or a terminal would obey it.

    what : that is called so, as "a scenario".  empty : may the name be.
    """
    if not isinstance(name, str) or not (empty or name.strip()):
        raise InputError(f"{what}'s name is {shortened(repr(name))}; give a word that reports can call it by")
    if has_control(name):
        raise InputError(f"{what}'s name {shortened(repr(name))} has control characters; take them out")


def check_array(
    name: str,
    value: ArrayLike,
    shape: tuple[int | None, ...],
    *,
    finite: bool = True,
    most: float | None = None,
) -> NDArray[np.float64]:
    """A float64 copy of `value`, known to have the given shape.

    Parameters
    ----------
    name : what messages call the value, for example "q [rad]".
    value : anything NumPy can turn into numbers.
    shape : the wanted shape; None stands for any length, () for a single number.
    finite : refuse NaN and infinity when True, NaN alone when False.
    most : the largest magnitude, if there is one.

    Raises
    ------
    InputError : not numbers, another shape, or NaN, infinity or too large a number at a named place.
    """
    try:
        # NumPy would read text as numbers, and leave out the imaginary part of complex ones
        if np.asarray(value).dtype.kind in "USc":
            raise TypeError
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected numbers, got {shortened(repr(value))}") from error
    if array.ndim != len(shape) or any(
        want is not None and have != want for have, want in zip(array.shape, shape, strict=True)
    ):
        wanted = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise InputError(f"{name}: expected shape {wanted}, got {array.shape}")
    bad = ~np.isfinite(array) if finite else np.isnan(array)
    limit = ""
    if most is not None and not bad.any():
        bad, limit = np.abs(array) > most, f" of at most {most:g}"
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        where = f" at index {place[0] if len(place) == 1 else place}" if place else ""
        allowed = "a finite number" if finite else "a number"
        raise InputError(f"{name}: {array[place]}{where}; give {allowed}{limit}")
    return array


def raw_array(name: str, value: object) -> NDArray[Any]:
    """NumPy array of any type from a value; InputError if its rows differ in length."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected an array, got {shortened(repr(value))}") from error


def check_number(name: str, value: object, *, finite: bool = True, most: float | None = None) -> float:
    """A single number as a float; InputError as of `check_array`."""
    return float(check_array(name, value, (), finite=finite, most=most))  # type: ignore[arg-type]


def check_positive(name: str, value: object, *, most: float | None = None) -> float:
    """A number above zero as a float; InputError if it is none, or as of `check_array`."""
    number = check_number(name, value, most=most)
    if not number > 0:
        raise InputError(f"{name}: {number:g}; give a number > 0")
    return number


def check_whole(name: str, value: object, *, least: int, most: int) -> int:
    """A whole number as an int; InputError if it is none, or out of its range."""
    number = check_number(name, value)
    if number != round(number) or not least <= number <= most:
        raise InputError(f"{name}: {number:g}; give a whole number from {least} to {most:g}")
    return round(number)


def shortened(text: str, most: int = 80) -> str:
    """Text with its middle left out where it is long."""
    return text if len(text) <= most else f"{text[: most - 20]} ... {text[-10:]}"


def check_direction(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy of a unit vector (3,); InputError as of `check_array`, or for another length."""
    array = check_array(name, value, (3,))
    length = float(np.linalg.norm(array))
    if abs(length - 1.0) > 1e-6:
        raise InputError(f"{name}: not a unit vector (length {length:.6g}); divide it by its length")
    return array
