"""Command line: one file a command, registered in `app.py`; `options.py` has shared options."""
