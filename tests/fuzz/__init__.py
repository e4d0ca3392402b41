"""Fuzzers: seeded attacks on files, URDFs, commands, calls, collisions and replays (`make attack`).

* attack.py      all of them, as the bench `attack`; attack_cases.py: what a case is, and its verdict
* attack_files.py, attack_urdfs.py and the others    one kind of attack a file
"""
