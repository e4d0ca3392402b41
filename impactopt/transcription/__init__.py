"""Transcription of a problem to a nonlinear program (NLP), and of its solution to a `Plan`.

* transcription.py, strike.py       the NLPs of a whole motion and of the impact alone, composed of parts
* motion_phase.py, contact_set.py   parts; each gets a builder (builder.py)
* layout.py                         variables and constraints, which parts add
* blocks.py, contact_blocks.py      the nonlinear functions
* structured.py                     the assembled NLP, which a solver gets
* plan.py                           the plan

A new term or objective needs no change here (`problem/`); a new contact model does.
"""
