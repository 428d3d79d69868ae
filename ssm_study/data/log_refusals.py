"""Error messages on a log, with its missing values or with the command that shows its contents."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.data.arrays import ARRAYS
from ssm_study.data.readers.reader import FOREIGN
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel

LOOK = "`ssm-study look {}` shows what is in the file"


def add_look_command_to_error(error: BadRequest, path: Path) -> BadRequest:
    """Error about a log file, extended by the command `ssm-study look`, which shows what the file
    contains."""
    remedy = error.remedy.rstrip(".")
    is_foreign = path.suffix.lower() in FOREIGN  # look does not read it either
    is_of_arrays = path.parent.name == ARRAYS and path.suffix == ".parquet"
    if "look" in remedy or is_foreign or is_of_arrays or not path.is_file():
        return error
    return BadRequest(error.field, error.value, error.problem, f"{remedy}; {LOOK.format(path)}")


def missing_values_error(
    path: Path, values: Float[np.ndarray, "T c"], channels: Sequence[Channel]
) -> BadRequest:
    """Error that names the columns with missing values in a log where no three successive rows are
    complete."""
    missing = np.isnan(values).mean(axis=0)
    shares = [
        f"{channel.name} {share:.0%}" for channel, share in zip(channels, missing, strict=True)
    ]
    problem = f"no three successive rows have all their values; missing: {', '.join(shares)}"
    remedy = "fill in what is held between its changes, or name other columns"
    return BadRequest(path.name, "missing values", problem, remedy)
