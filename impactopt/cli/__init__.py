"""The command line: one file a command, registered in `app.py`; `options.py` has what several take."""
