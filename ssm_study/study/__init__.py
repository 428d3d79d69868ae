"""Stages of a study from data to record, and the checks of finished runs. Called as a function, the
module runs a study (`cli.from_python.study`)."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _CallablePackage(ModuleType):
    """Module type whose instances can be called like a function, so that `st.study(...)` works
    although `st.study` is a package."""

    def __call__(self, *overrides: str) -> Any:
        """Run a study with given command-line overrides, as `cli.from_python.study` does."""
        return import_module("ssm_study.cli.from_python").study(*overrides)


sys.modules[__name__].__class__ = _CallablePackage
