"""Command `impactopt compare`: comparison of results."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from impactopt.cli.command import AsJson, out_option, plain_errors, print_json

FILES = ("compare.json", "compare.png", "compare.html")


def compare(
    results: Annotated[
        list[Path],
        typer.Argument(metavar="A B [C...]", help="Directories that `impactopt solve` wrote; two to five."),
    ],
    out: Annotated[Path | None, out_option(f"Write {', '.join(FILES)} there.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare results: numbers, differences of problems and versions, force, ZMP and torque.

    Exit code: 0 compared, 2 bad input.
    """
    with plain_errors("interrupted before the results were compared", as_json=as_json):
        from impactopt.files.output import make_directory, write_file
        from impactopt.files.record import load_record
        from impactopt.report.comparison import compare as comparison_of

        names = _names(results)
        found = comparison_of({name: load_record(path) for name, path in zip(names, results, strict=True)})
        text, written = json.dumps(found.describe(), indent=2), []
        if out is not None:
            from impactopt.report.pictures.compare import comparison_picture

            picture, page = comparison_picture(found.records), found.page()
            directory = make_directory(out)
            written = [directory / name for name in FILES]
            write_file(written[0], lambda file: file.write(f"{text}\n".encode()))
            write_file(written[1], picture.write)
            page.save(written[2])
        if as_json:
            print_json(found.describe(), True)
            return
        from impactopt.report.console import comparison_tables, output, say

        console = output()
        for table in comparison_tables(found):
            console.print(table)
        say(console, *written)


def _names(results: Sequence[Path]) -> list[str]:
    """Names of the directories; their paths as given if two have the same name.

    Raises
    ------
    InputError : a result is given twice.
    """
    from impactopt.errors import InputError

    folders = [path.parent if path.name == "solution.npz" else path for path in results]
    places = [os.path.realpath(folder) for folder in folders]
    for path, place in zip(results, places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{path} is given twice; give different results")
    names = [Path(place).name for place in places]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]
