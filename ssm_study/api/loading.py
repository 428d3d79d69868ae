"""Load a design from a folder."""

from pathlib import Path

from ssm_study.api.design import Design


def load(folder: str | Path) -> Design:
    """Load a saved design, or the controller of any run folder.

    Raises `BadRequest` where there is no controller.
    """
    return Design.load(Path(folder))
