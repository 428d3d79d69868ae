"""A temporary folder that is deleted when the program ends."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path


@cache
def scratch_folder() -> Path:
    """Temporary folder of the program, deleted when the program ends."""
    folder = Path(tempfile.mkdtemp(prefix="ssm-study-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def make_scratch_folder() -> Path:
    """Make a new folder in the program's temporary folder."""
    return Path(tempfile.mkdtemp(dir=scratch_folder()))
