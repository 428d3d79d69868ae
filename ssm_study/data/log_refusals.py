"""Extension of errors about a log by the command that shows what the log contains."""

from pathlib import Path

from ssm_study.data.arrays import ARRAYS
from ssm_study.data.readers.reader import FOREIGN
from ssm_study.refusal import BadRequest

LOOK = "`ssm-study look {}` shows what is in the file"


def refusal_with_look_command(error: BadRequest, path: Path) -> BadRequest:
    """Error about a log file, extended by the command that shows the contents of the file."""
    remedy = error.remedy.rstrip(".")
    is_foreign = path.suffix.lower() in FOREIGN  # look does not read it either
    is_of_arrays = path.parent.name == ARRAYS and path.suffix == ".parquet"
    if "look" in remedy or is_foreign or is_of_arrays or not path.is_file():
        return error
    return BadRequest(error.field, error.value, error.problem, f"{remedy}; {LOOK.format(path)}")
