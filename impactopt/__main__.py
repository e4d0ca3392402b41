"""`python -m impactopt`: the command line."""

from impactopt.cli.app import main

main()
