"""From input-output data of a nonlinear system to a certified output-feedback controller:
`ssm_study.library`."""

from importlib import import_module
from typing import Any

from ssm_study import renamed

__version__ = "0.2.0"
__all__ = ["Design", "Model", "control", "fit", "load", "simulate", "study"]


def __getattr__(name: str) -> Any:
    """Importing the package loads nothing; its names load their room."""
    if name in __all__[:-1]:
        import_module("ssm_study.cli.main").limit_threads()
        return getattr(import_module("ssm_study.library"), name)
    if name == "study":  # both the room and, called, `library.study`
        return import_module("ssm_study.study")
    raise AttributeError(f"module 'ssm_study' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]


renamed.install()
