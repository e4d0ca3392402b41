"""Problem files: an `impactopt.problem.problem.ImpactProblem` written in TOML, in SI units.

* sections.py   the sections and keys of a file, what they build, and their descriptions; those of a
  collision, and their types and mistakes, are in `impactopt.files.sections`
* reading.py    file to problem, with changed values by key paths; writing.py: problem to file
* ipopt_options.py   IPOPT options that a file may set
* reference.py  docs/problem_files.md, and the comments of `impactopt new`
"""

from impactopt.files.named_problems import problem_names
from impactopt.files.problem_file.reading import (
    ProblemFile,
    change_data,
    key_place,
    load_problem,
    parse_problem_file,
    problem_file_from_data,
    problem_from_data,
    read_problem_file,
)
from impactopt.files.problem_file.sections import SolverSettings
from impactopt.files.problem_file.writing import problem_data, write_problem
from impactopt.files.sections.reading import parse_settings
from impactopt.files.toml import read_toml, write_toml

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
