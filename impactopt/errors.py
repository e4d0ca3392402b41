"""Errors and warnings that users see, and checks that raise them.

Shell completion imports this module; NumPy, which is slow to load, is imported by the checks alone.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

FARTHEST = 1e3  # [m] from the origin of a frame or the world; micrometres are still resolved there
# largest magnitude of other inputs, in SI units: products of a few of them are still finite
MOST = 1e15
MANY = 100  # entries of a list of parts, such as scenarios or obstacles
# characters that control a terminal, and surrogates, which cannot be written in UTF-8
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


class InputError(ValueError):
    """Bad input. The message names the mistake, its place, and its correction.

    mistakes : all of them, if the message has several.
    """

    def __init__(self, message: str = "", mistakes: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.mistakes = tuple(mistakes) or (message,)


class Mistakes:
    """Collects the mistakes that several checks find, for one message."""

    def __init__(self) -> None:
        self.found: list[str] = []

    def attempt(self, check: Callable[[], object]) -> bool:
        """True if a check passes; else its mistakes are recorded."""
        try:
            check()
        except InputError as error:
            self.found += error.mistakes
            return False
        return True

    def raise_if_any(self, what: str) -> None:
        """Raises one InputError for all mistakes of `what`."""
        if len(self.found) == 1:
            raise InputError(self.found[0])
        if self.found:
            lines = "".join(f"\n  {mistake}" for mistake in self.found)
            raise InputError(f"{what} has {len(self.found)} mistakes:{lines}", self.found)


class NoCompilerWarning(UserWarning):
    """No C compiler: functions run in CasADi's virtual machine or in NumPy, 10 to 100 times slower."""


class CacheWarning(UserWarning):
    """The on-disk cache of compiled functions cannot be used."""


class NotSolvedWarning(UserWarning):
    """The result is not a solution: its numbers are those of the best iterate."""


def counted(count: int, one: str, several: str = "") -> str:
    """Number with its noun: "1 joint", "2 joints"; several : plural of ``one``, if not by an s."""
    return f"{count} {one if count == 1 else several or f'{one}s'}"


def did_you_mean(name: str, options: Iterable[str]) -> str:
    """Suggestion for a misspelt name, for the end of a message: " (did you mean 'x'?)", or ""."""
    candidates = {str(option).casefold(): str(option) for option in options}
    near = difflib.get_close_matches(str(name).casefold(), list(candidates), n=1, cutoff=0.6)
    return f" (did you mean {candidates[near[0]]!r}?)" if near else ""


def check_choice(what: str, given: object, known: Iterable[str]) -> None:
    """InputError for an unknown name.

    what : start of the message, such as "there is no picture".
    """
    names = [*known]
    if not isinstance(given, str) or given not in names:
        near = did_you_mean(str(given), names)
        raise InputError(f"{what} {shortened(repr(given))}{near}; there are {', '.join(names) or 'none'}")


def check_kind(name: str, given: object, kind: type) -> None:
    """InputError unless an argument is an instance of a class."""
    if not isinstance(given, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise InputError(f"{name} must be {article} {kind.__name__}, not {shortened(repr(given))}")


def named_table(given: Any) -> Any:
    """A pandas Series by names as a dict; anything else as it is.

    As an array, it would count in its own order.

    Raises
    ------
    InputError : a name that it has twice.
    """
    if isinstance(given, Mapping) or not hasattr(given, "keys") or getattr(given, "ndim", 0) != 1:
        return given
    table = dict(given.items())
    if not table or not all(isinstance(name, str) for name in table):
        return given
    if len(table) < len(given):
        twice = next(name for name in table if list(given.keys()).count(name) > 1)
        raise InputError(f"a table names {twice!r} twice: give one value for it")
    return table


def missing_package(what: str, package: str, extra: str) -> InputError:
    """Error for a package that is not installed, with the command that installs it; impactopt is on no index.

    what : user of the package, such as "a sweep's table".  extra : of impactopt that includes it.
    """
    return InputError(
        f"{what} needs the package {package}; "
        f"in the folder of impactopt's clone run: pip install -e '.[{extra}]'"
    )


def printable(text: str) -> str:
    """Text for a terminal: control characters except new lines are replaced by their codes."""
    return "".join(c if c == "\n" or c.isprintable() else repr(c)[1:-1] for c in text)


def has_control(text: str) -> bool:
    """True if a text has control characters other than tabs and new lines; no file, name or result may."""
    return _CONTROL.search(text) is not None


def check_name(what: str, name: object, *, empty: bool = False) -> None:
    """InputError if a name cannot be printed in reports: it is no text, is empty, or has control characters.

    what : the named thing, such as "a scenario".  empty : an empty name is permitted.
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
    """Checked float64 copy of an array.

    Parameters
    ----------
    name : name of the value in messages, for example "q [rad]".
    value : anything that NumPy can convert to numbers.
    shape : required shape; None stands for any length, () for a single number.
    finite : refuse NaN and infinity if True, NaN alone if False.
    most : the largest permitted magnitude; None: any.

    Raises
    ------
    InputError : not numbers, another shape, or NaN, infinity or too large a number, with its index.
    """
    import numpy as np

    try:
        # NumPy would convert text and truth values to numbers, and drop the imaginary part of complex ones
        if np.asarray(value).dtype.kind in "bUSc":
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
    import numpy as np

    try:
        array = np.asarray(value)
        # NumPy would make text of the numbers beside a text
        return np.asarray(value, dtype=object) if array.dtype.kind in "US" else array
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected an array, got {shortened(repr(value))}") from error


def check_number(name: str, value: object, *, finite: bool = True, most: float | None = None) -> float:
    """Checked number as a float; InputError as of `check_array`."""
    # the usual case without NumPy, in a twentieth of the time
    if isinstance(value, float) and math.isfinite(value) and (most is None or abs(value) <= most):
        return float(value)
    return float(check_array(name, value, (), finite=finite, most=most))  # type: ignore[arg-type]


def check_positive(name: str, value: object, *, most: float | None = None) -> float:
    """Checked positive number as a float; InputError if it is not positive, or as of `check_array`."""
    number = check_number(name, value, most=most)
    if not number > 0:
        raise InputError(f"{name}: {number:g}; give a number > 0")
    return number


def check_whole(name: str, value: object, *, least: int, most: int) -> int:
    """Checked whole number as an int; InputError if it is not whole, or out of its range."""
    number = check_number(name, value)
    if number != round(number) or not least <= number <= most:
        raise InputError(f"{name}: {number:g}; give a whole number from {least} to {most:g}")
    return round(number)


def shortened(text: str, most: int = 80) -> str:
    """Text, with its middle left out if it is long."""
    return text if len(text) <= most else f"{text[: most - 20]} ... {text[-10:]}"


def check_direction(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Checked float64 copy of a unit vector (3,); InputError as of `check_array`, or for another length."""
    array = check_array(name, value, (3,))
    length = float((array @ array) ** 0.5)
    if abs(length - 1.0) > 1e-6:
        raise InputError(f"{name}: not a unit vector (length {length:.6g}); divide it by its length")
    return array
