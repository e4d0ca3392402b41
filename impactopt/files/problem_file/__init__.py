"""Problem files: an `impactopt.problem.problem.ImpactProblem` written in TOML, in SI units.

* values.py     base class of sections, types and ranges of the keys' values
* robot_sections.py   section [robot]
* sections.py   the other sections and keys of a file, what they build, and their descriptions
* diagnostics.py   mistakes of a file: place, probable intention, permitted values
* reading.py    file to problem, with changed values by key paths; writing.py: problem to file
* toml.py       text from and to plain data
* reference.py  docs/problem_files.md, and the comments of `impactopt new`
"""

from impactopt.files.named_problems import problem_names
from impactopt.files.problem_file.reading import (
    ProblemFile,
    SolverSettings,
    change_data,
    key_place,
    load_problem,
    parse_problem_file,
    parse_settings,
    problem_file_from_data,
    problem_from_data,
    read_problem_file,
)
from impactopt.files.problem_file.toml import read_toml, write_toml
from impactopt.files.problem_file.writing import problem_data, write_problem

__all__ = [
    "ProblemFile",
    "SolverSettings",
    "change_data",
    "key_place",
    "load_problem",
    "parse_problem_file",
    "parse_settings",
    "problem_data",
    "problem_file_from_data",
    "problem_from_data",
    "problem_names",
    "read_problem_file",
    "read_toml",
    "write_problem",
    "write_toml",
]
