"""Checks that the folder and name of a run agree with its settings and with the hash of all
settings."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssm_study.engine.settings import (
    NOT_IDENTITY,
    plain_settings,
    run_name,
    run_name_part,
    walk_nodes,
)
from ssm_study.study.findings import CheckedClaim
from ssm_study.study.run_files import RunFiles
from ssm_study.table.gather import PARQUET

SHOWN = re.compile(r"([A-Za-z_]+)(_?[0-9].*)")


def expected_run_name(run: RunFiles) -> str:
    """Name that a run should have by its settings: the values of some settings, then a hash of all
    settings.

    Which settings a name shows is the user's choice, so a word that is no setting stays.
    """
    name = str(run.config.run)
    hashed = run_name(run.config)
    shown, _, stored_hash = name.rpartition("-")
    if stored_hash != hashed and not name.endswith(hashed):
        return f"...-{hashed}"
    settings = plain_settings(run.config, NOT_IDENTITY)
    parts = shown.split("-") if shown else []
    words = [expected_name_part(part, settings) for part in parts]
    return "-".join([*words, stored_hash])


def expected_name_part(part: str, settings: Mapping[str, Any]) -> str:
    """Part of a run's name as the run's settings require it: `seed3` for the part `seed0` if the
    seed is 3. A part without a setting is returned as it is. `width` may be that of the model or a
    plant's."""
    match = SHOWN.fullmatch(part)
    if match is None:
        return part
    word = match[1].strip("_")
    values = [settings[word]] if word in settings else []  # `seed` is the study's, no loop's
    for _, key, value in () if values else walk_nodes(settings):
        is_called_so = str(key) == word or str(key).endswith(f"_{word}")
        if is_called_so and isinstance(value, int | float | str):
            values.append(value)
    expected = [run_name_part(word, value) for value in values]
    return part if part in expected or not expected else expected[0]


def check_folder_name(folder: Path, name: str) -> CheckedClaim:
    """Check that a run's folder is named as the run's record states, so that each run counts once
    in its study."""
    study = folder.parent
    is_in_a_study = (study / PARQUET).exists() or (study / name).exists()
    if folder.name == name or not is_in_a_study:
        return CheckedClaim(claim="folder", holds=True, found=f"{folder.name} stands once")
    problem = f"counts as one more run of its study: delete it, or name it {name}"
    return CheckedClaim(claim="folder", holds=False, found=f"{folder.name} {problem}")
