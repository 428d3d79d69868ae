"""A temporary folder that is deleted when the program ends."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path


@cache
def scratch_folder() -> Path:
    """The program's temporary folder, deleted when the program ends."""
    folder = Path(tempfile.mkdtemp(prefix="ssm-study-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def new_folder() -> Path:
    """A fresh folder in the scratch folder."""
    return Path(tempfile.mkdtemp(dir=scratch_folder()))
