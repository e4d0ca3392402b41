"""Problem files: an `impactopt.problem.problem.ImpactProblem` written in TOML, in SI units.

* sections.py   the sections and keys of a file, what they build, and their descriptions; those of a
  collision, and their types and mistakes, are in `impactopt.files.sections`
* reading.py    file to problem, with changed values by key paths; writing.py: problem to file
* ipopt_options.py   IPOPT options that a file may set
* reference.py  docs/problem_files.md, and the comments of `impactopt new`
"""

# X as X: a name that is exported, for type checkers, too
from impactopt.files.named_problems import problem_names as problem_names
from impactopt.files.problem_file.reading import ProblemFile as ProblemFile
from impactopt.files.problem_file.reading import change_data as change_data
from impactopt.files.problem_file.reading import key_place as key_place
from impactopt.files.problem_file.reading import load_problem as load_problem
from impactopt.files.problem_file.reading import read_problem_file as read_problem_file
from impactopt.files.problem_file.sections import SolverSettings as SolverSettings
from impactopt.files.problem_file.writing import problem_data as problem_data
from impactopt.files.problem_file.writing import write_problem as write_problem
from impactopt.files.sections.reading import parse_settings as parse_settings
from impactopt.files.toml import read_toml as read_toml
from impactopt.files.toml import write_toml as write_toml
