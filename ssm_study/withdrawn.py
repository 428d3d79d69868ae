"""Settings, choices, classes, theorems and columns of earlier versions that were removed.

To withdraw something, add a line to the table of its kind, with the version and the remedy;
`renamed` refuses what is withdrawn with that sentence.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Withdrawal:
    """Notice about a removed setting or class: the version that removed it, and what to use
    instead. `neutral` is a value of a setting that changed nothing; a stored configuration with it
    is read without it."""

    since: str
    remedy: str
    neutral: Any = None

    @property
    def sentence(self) -> str:
        """Text that names the version in which the setting or class was removed."""
        return f"withdrawn in {self.since}"


# Settings by their dotted path, in which `*` stands for any part.
WITHDRAWN_SETTINGS: Mapping[str, Withdrawal] = {
    "training.hankel_weight": Withdrawal(
        since="0.2", remedy="leave it out; reduction=balanced removes redundant states", neutral=0.0
    ),
    "training.windows.washout": Withdrawal(
        since="0.2", remedy="leave it out; windows are multiple shooting", neutral=0
    ),
    "training.windows.stride": Withdrawal(
        since="0.2", remedy="leave it out; windows follow each other", neutral=None
    ),
    "synthesis.invert_input": Withdrawal(
        since="0.2",
        remedy="leave it out; only designs without it have a coverage and can be exported",
        neutral=False,
    ),
}

# Choices as a command writes them, `model=dynonet`; of a list every member counts.
WITHDRAWN_CHOICES: Mapping[str, Withdrawal] = {
    "model=dynonet": Withdrawal(since="0.2", remedy="use model=gru, lstm, narx or structured"),
    "model=deep_ssm": Withdrawal(since="0.2", remedy="use model=structured"),
}

_OF_THE_SENSOR = Withdrawal(
    since="0.2",
    remedy="the sensor's noise is loop.measurement_noise_variance and loop.noise_factor now; "
    "a converter is a wrapper of your own (docs/howto_plant.md)",
)
# Classes of `_target_`, below `ssm_study`, that there are no more.
WITHDRAWN_TARGETS: Mapping[str, Withdrawal] = {
    "plants.sensor.QuantisedOutput": _OF_THE_SENSOR,
    "plants.sensor.NoisyOutput": _OF_THE_SENSOR,
    "plants.wrapper.QuantisedOutput": _OF_THE_SENSOR,
    "plants.wrapper.Disturbed": Withdrawal(
        since="0.2", remedy="disturbances are loop.disturbance now"
    ),
}

_OF_INVERTED_INPUT = Withdrawal(since="0.2", remedy="run again without synthesis.invert_input")
# Parts of `certificate.json` by the name of their theorem: read past, and not checked. A design
# whose state feedback is of one is refused.
WITHDRAWN_THEOREMS: Mapping[str, Withdrawal] = {
    "noise_gain": Withdrawal(
        since="0.2", remedy="read the column noise_gain_model, which is no claim"
    ),
    "tolerance": Withdrawal(since="0.2", remedy="run again: measured_discs proves the same gain"),
    "structured_tolerance": Withdrawal(
        since="0.2", remedy="run again: measured_discs_structured proves the same gain"
    ),
    "inverted_input": _OF_INVERTED_INPUT,
    "structured_inverted_input": _OF_INVERTED_INPUT,
}

# Columns that records of an earlier version hold: not checked.
WITHDRAWN_COLUMNS: Mapping[str, Withdrawal] = {
    "noise_gain": Withdrawal(since="0.2", remedy="read noise_gain_model, which is no claim"),
    "certified_tolerance_resolved": Withdrawal(since="0.2", remedy="read certified_tolerance"),
}
