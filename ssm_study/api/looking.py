"""Examine a log from Python. `look`: what is in a log, before anything is fitted to it."""

from ssm_study.data.look import LogLook, look

__all__ = ["LogLook", "look"]
