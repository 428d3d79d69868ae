"""A temporary folder that is deleted when the program ends."""

import atexit
import re
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


def copy_temporary_logs(override: str, folder: Path) -> str:
    """Copy those log files of an override that are deleted when the program ends into a folder, and
    name the copies instead."""
    scratch = re.escape(str(scratch_folder()))
    for temporary in re.findall(rf"{scratch}/[^',\]]+\.parquet", override):
        folder.mkdir(parents=True, exist_ok=True)
        copied = Path(shutil.copy(temporary, folder))
        override = override.replace(temporary, str(copied.resolve()))
    return override
