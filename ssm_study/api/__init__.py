"""Python interface of the package. The Python front door: from arrays to a certified controller,
without a command or a run folder.

`import ssm_study as st` offers these functions; they stand on the science alone and load no Hydra.
"""
