"""Export of all closed loops of a study into one MCAP file.

For players that open one file at a time, as Foxglove does.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.engine.records import RECORD
from ssm_study.refusal import require

LOOP = "closed_loop.mcap"
MOST = 200  # runs: a player lists every topic, and each run has ten cases


def export_closed_loop_recordings(study: Path) -> Path:
    """Write the recordings of all runs of a study into one file, `closed_loops.mcap`.

    The topics of a run lie below `/run_` and the run's digits: those after the last dash of its
    name, or the whole name where two runs share them; the metadata says which name they stand for.
    Raises `BadRequest` for a study without a closed loop, with more than `MOST`, or with a damaged
    recording.
    """
    paths = sorted(study.glob(f"*/{LOOP}"))
    recordings = [path for path in paths if _belongs_to_run(path)]
    by_name = {f"run_{path.parent.name.rpartition('-')[2]}": path for path in recordings}
    if len(by_name) < len(recordings):
        by_name = {f"run_{path.parent.name}": path for path in recordings}
    count = len(by_name)
    require(count > 0, "study", study, "no run closed a loop", "name a study whose runs did")
    problem = f"{count} runs are more than {MOST}"
    require(count <= MOST, "study", study, problem, "open their own recordings")
    groups = []
    for name, path in by_name.items():
        for group in read_mcap(path)[0]:
            renamed_group = replace(group, topic=f"/{name}{group.topic}")
            groups.append(renamed_group)
    names = {name: path.parent.name for name, path in by_name.items()}
    file = study / "closed_loops.mcap"
    with TemporaryDirectory(dir=study, prefix=".export-") as folder:
        temporary_file = Path(folder) / file.name
        write_mcap(temporary_file, tuple(groups), names)
        temporary_file.replace(
            file
        )  # whatever stood there: a link of a stranger is replaced, not followed
    return file


def _belongs_to_run(recording: Path) -> bool:
    """Whether a recording lies in the folder of a run that has left a record."""
    return (recording.parent / RECORD).is_file()
