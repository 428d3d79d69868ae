"""Examine a log of measured inputs and outputs before a model is fitted to it."""

from ssm_study.data.look import LogLook, look

__all__ = ["LogLook", "look"]
