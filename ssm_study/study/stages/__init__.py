"""Stages of a run, one file for each: what it computes, stores and measures.

To add a stage: a file with its three functions, as `engine.stages.Stage` says, and the `Stage` made
of them; then take it in `study/line.py` with the parts of the configuration that it depends on, and
list it in `catalogue`. Its columns are declared in the `metrics` module of their room.

A stage is computed again when code that it uses changes, so each file imports the names it uses and
no whole module. What only computing takes is imported inside the functions: a run that reuses a
stage then never loads it.
"""
