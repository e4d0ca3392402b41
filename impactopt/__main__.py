"""`python -m impactopt`: the command line."""

from impactopt.cli import main

main()
