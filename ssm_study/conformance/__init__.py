"""Tests that every plant, static map, theorem, model and experiment must pass: `pytest --pyargs
ssm_study.conformance`.

They test every yaml of a group, of this package and of trusted packages (`ssm_study.extensions`);
`-k NAME` tests one.
"""

from functools import cache
from typing import Any

from ssm_study.extensions import configuration_folders


def list_choices(group: str) -> list[str]:
    """Names of all choices of a configuration group whose yaml file has no missing values
    (`???`)."""
    names = set()
    for folder in configuration_folders():
        for path in (folder / group).glob("*.yaml"):
            if ": ???" not in path.read_text(encoding="utf-8"):
                names.add(path.stem)
    return sorted(names)


@cache
def construct_choice(group: str, choice: str) -> Any:
    """Object that a study would construct for one choice of a configuration group, such as a
    plant."""
    from ssm_study.cli.from_python import compose_configuration
    from ssm_study.construction import construct_part
    from ssm_study.engine.settings import plain_settings

    config = compose_configuration([f"{group}={choice}"])
    return construct_part(group, plain_settings(config)[group])
