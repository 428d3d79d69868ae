"""The line from data to record, and what is checked of its runs afterwards; called, it is
`cli.from_python.study`."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _Room(ModuleType):
    """`import ssm_study as st; st.study(...)` must work although the room that does it has the same
    name."""

    def __call__(self, *overrides: str) -> Any:
        return import_module("ssm_study.cli.from_python").study(*overrides)


sys.modules[__name__].__class__ = _Room
