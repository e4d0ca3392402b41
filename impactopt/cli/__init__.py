"""Command line: one file a command, registered in `app.py`; `command.py` has what all share."""
