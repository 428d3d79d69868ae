"""Facts on a run that are read from its other files because `record.json` lacks them."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from ssm_study.certificates.theorem import FOLDER
from ssm_study.signals import Channel
from ssm_study.study.recordings import RecordedCases

# Part of `certificate.json` with the certificate of each side.
CERTIFICATE_PARTS = {"controller": "state_feedback", "observer": "observer"}


@dataclass(frozen=True, kw_only=True)
class RunFacts:
    """Sampling time, units and set points of a run, for the text on its outcome.

    `no_set_points_reason` is why the exported code follows no set points, empty if it does. A unit
    begins with a space; it is empty for several channels, and where no unit is stated.
    `own_theorems` has, by side, the name of a theorem that comes from an extension package.
    """

    step_s: float | None = None
    no_set_points_reason: str = ""
    input_unit: str = ""
    output_unit: str = ""
    own_theorems: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_run_folder(cls, run: Path) -> "RunFacts":
        """Read sampling time, units and set points from a run folder."""
        from ssm_study.export.set_points import missing_set_points_reason

        step_s = None
        with suppress(OSError, ValueError, KeyError):
            text = (run / "model.json").read_text(encoding="utf-8")
            step_s = float(json.loads(text)["step_s"])
        units = {"input": "", "measured": ""}
        with suppress(OSError, ValueError, IndexError):
            recording = RecordedCases.from_file(run / "test.mcap")
            units = {name: unit_suffix(recording.signals(name)[0].channels) for name in units}
        return cls(
            step_s=step_s,
            no_set_points_reason=missing_set_points_reason(run),
            input_unit=units["input"],
            output_unit=units["measured"],
            own_theorems=read_extension_theorems(run),
        )


def read_extension_theorems(run: Path) -> dict[str, str]:
    """Names of the theorems from extension packages by which a run's certificates are proved."""
    own_theorems = {}
    with suppress(OSError, ValueError, AttributeError):  # a damaged file names none
        parts = json.loads((run / "certificate.json").read_text(encoding="utf-8"))
        for side, part in CERTIFICATE_PARTS.items():
            name = str(parts.get(part, {}).get("theorem", part))
            if name.isidentifier() and find_spec(f"{FOLDER}.{name}") is None:
                own_theorems[side] = name
    return own_theorems


def unit_suffix(channels: Sequence[Channel]) -> str:
    """Unit of a signal with one channel as text after a space; otherwise empty."""
    unit = channels[0].unit if len(channels) == 1 else ""
    return f" {unit}" if unit else ""
