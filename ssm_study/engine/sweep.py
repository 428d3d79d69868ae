"""Settings that the last sweep of a study varied, read from Hydra's files in the study's folder."""

from contextlib import suppress
from pathlib import Path

import yaml  # type: ignore[import-untyped]

from ssm_study.durable import read_limited_bytes

SWEEP = "multirun.yaml"
LARGEST = 2**18  # bytes of that file: a real one has 10,000


def swept_numbers(study: Path) -> dict[str, list[int | float]]:
    """Numbers that the last sweep of a study varied, keyed by setting; empty without a readable
    sweep."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import OverrideParseException

    swept: dict[str, list[int | float]] = {}
    damage = (OSError, ValueError, KeyError, TypeError, yaml.YAMLError, OverrideParseException)
    with suppress(*damage):
        text = read_limited_bytes(study / SWEEP, LARGEST).decode()
        content = yaml.load(text, yaml.CSafeLoader)
        words = list(content["hydra"]["overrides"]["task"])
        for override in OverridesParser.create().parse_overrides(words):
            if not override.is_sweep_override():
                continue
            values = list(override.sweep_iterator())
            numbers = [value for value in values if isinstance(value, int | float)]
            if len(numbers) == len(values):
                swept[override.key_or_group.lstrip("+")] = numbers
    return swept
