"""All closed loops of a study in one MCAP file, for players that open one file at a time, as
Foxglove does."""

from dataclasses import replace
from pathlib import Path

from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.engine.records import RECORD
from ssm_study.refusal import require

LOOP = "closed_loop.mcap"
MOST = 200  # runs: a player lists every topic, and each run has ten cases


def export_mcap(study: Path) -> Path:
    """Write `closed_loops.mcap` into the study: each run's recording, its topics below `/run_` and
    the run's digits.

    A run's own digits are those after the last dash of its name, or the whole name where two runs
    share them; the
    metadata says which name they stand for. Raises `BadRequest` for a study without a closed loop,
    with more than
    `MOST`, or with a damaged recording.
    """
    found = [path for path in sorted(study.glob(f"*/{LOOP}")) if (path.parent / RECORD).is_file()]
    kept = {f"run_{path.parent.name.rpartition('-')[2]}": path for path in found}
    if len(kept) < len(found):
        kept = {f"run_{path.parent.name}": path for path in found}
    require(len(kept) > 0, "study", study, "no run closed a loop", "name a study whose runs did")
    require(
        len(kept) <= MOST,
        "study",
        study,
        f"{len(kept)} runs are more than {MOST}",
        "open their own recordings",
    )
    groups = [
        replace(group, topic=f"/{digits}{group.topic}")
        for digits, path in kept.items()
        for group in read_mcap(path)[0]
    ]
    write_mcap(
        study / "closed_loops.mcap",
        tuple(groups),
        {digits: path.parent.name for digits, path in kept.items()},
    )
    return study / "closed_loops.mcap"
