"""Theorems that a certificate can claim, one file each. One theorem a file, in one form:
problem, hypotheses, statement, when not to use it, reference, example."""
