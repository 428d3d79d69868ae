"""A temporary folder that is deleted when the program ends."""

import atexit
import re
import shutil
import tempfile
from functools import cache
from pathlib import Path


@cache
def program_scratch_folder() -> Path:
    """Temporary folder of the program, deleted when the program ends."""
    folder_name = tempfile.mkdtemp(prefix="ssm-study-")
    folder = Path(folder_name)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def make_scratch_folder() -> Path:
    """Make a new folder in the program's temporary folder."""
    folder_name = tempfile.mkdtemp(dir=program_scratch_folder())
    return Path(folder_name)


def copy_temporary_logs(override: str, folder: Path) -> str:
    """Copy the temporary log files that a command-line override names into a folder, and return the
    override with the new paths. The temporary files are deleted when the program ends."""
    scratch_name = str(program_scratch_folder())
    scratch = re.escape(scratch_name)
    for temporary in re.findall(rf"{scratch}/[^',\]]+\.parquet", override):
        folder.mkdir(parents=True, exist_ok=True)
        copied_name = shutil.copy(temporary, folder)
        copied = Path(copied_name)
        whole_path = copied.resolve()
        override = override.replace(temporary, str(whole_path))
    return override
