"""Plants, excitations and data specifications from their yaml files, for tests that run over all of
them."""

from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

CONF = Path(__file__).resolve().parents[1] / "conf"


def choices(group: str) -> list[str]:
    """Every yaml of the group that is complete: those asking for a file (`???`) have tests of their
    own."""
    paths = (CONF / group).glob("*.yaml")
    return sorted(path.stem for path in paths if ": ???" not in path.read_text())


@cache
def from_yaml(group: str, choice: str, *overrides: str) -> Any:
    """The object a study would get for `group=choice`."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(
            f"{group}/{choice}", overrides=[f"{group}.{override}" for override in overrides]
        )
    return instantiate(config[group], _convert_="all")
