"""Files: problem files, results and their schema, replays, verification, exports, drafts."""
