"""Transcribes a problem to a nonlinear program, and its solution back to a `Plan`.

* transcription.py, strike.py    the programs of a whole motion and of the blow alone: which parts they have
* motion_phase.py, contact_set.py   parts; builder.py: what each of them takes
* layout.py                      the variables and constraints that parts add
* blocks.py, contact_blocks.py   the nonlinear functions
* structured.py                  the program that a solver gets
* plan.py                        the plan

A new term or objective needs no change here (`problem/`). A part that all programs share, such as another
model of the contact, begins here.
"""
