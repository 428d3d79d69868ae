"""Examine a log of measured inputs and outputs before a model is fitted to it."""

from ssm_study.data.look import LogOverview, look

__all__ = ["LogOverview", "look"]
