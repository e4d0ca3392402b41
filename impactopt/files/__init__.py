"""Files that people read and write: problem files, results and their schema, replays."""
