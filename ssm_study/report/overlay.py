"""Free-run simulations by the models of several runs, on the test record that the runs share."""

from collections.abc import Sequence
from itertools import compress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ssm_study.api.comparing import ModelComparison, compare_simulations
from ssm_study.refusal import require
from ssm_study.report.study_folder import RunFolder
from ssm_study.study.recordings import RecordedCases

FEWEST = 2


def compare_free_runs(folders: Sequence[Path]) -> ModelComparison:
    """Compare how well the models of several runs simulate the test record, the best fit first.

    Raises `BadRequest` for fewer than two runs, a run without a test record, and a test record that
    is not that of the first run.
    """
    several = len({folder.resolve() for folder in folders})
    enough = several >= FEWEST
    require(enough, "run", several, "is no comparison", "name two different runs or more")
    unlike = several == len(folders)
    require(unlike, "run", "one run twice", "a run cannot be compared with itself", "name it once")
    names = distinguishing_run_names([folder.resolve() for folder in folders])
    recordings = [_read_test_free_run(folder) for folder in folders]
    first = recordings[0]
    for folder, recording in zip(folders[1:], recordings[1:], strict=True):
        _require_same_record(folders[0], first, folder, recording)
    simulated = {}
    for name, recording in zip(names, recordings, strict=True):
        simulated[name] = _signal_values(recording, "simulated")
    runs = [RunFolder(path=folder) for folder in folders]
    states = {}
    for name, run in zip(names, runs, strict=True):
        model = run.any_model
        states[name] = None if model is None else model.order
    disturbances = [run.record.get("disturbances") or "none" for run in runs]
    measured = _signal_values(first, "measured")
    start_up_samples = max(run.start_up_samples for run in runs)
    comparison = compare_simulations(
        measured,
        simulated,
        output_names=first.labels("measured"),
        step_s=first.step_s("measured"),
        states=states,
        start_up_samples=start_up_samples,
    )
    if len(set(disturbances)) > 1:
        by_run = dict(zip(names, disturbances, strict=True))
        comparison.table["measured disturbances"] = [
            by_run[name] for name in comparison.table.index
        ]
    return comparison


def baseline_line(folders: Sequence[Path]) -> str:
    """Text line with the best simple baseline model that the runs fitted to the same data; empty if
    none did."""
    records = [RunFolder(path=folder).record for folder in folders]
    fitted = [record for record in records if record.get("fit_baseline_percent") is not None]
    if not fitted:
        return ""
    best = max(fitted, key=lambda record: float(record["fit_baseline_percent"]))
    fit = float(best["fit_baseline_percent"])
    return f"best baseline on this record: {fit:.1f} %, {best.get('baseline')} (not drawn)"


def distinguishing_run_names(folders: Sequence[Path]) -> list[str]:
    """Names of several runs, shortened by the parts that all the names have in common. Names that
    are still equal are whole."""
    parts = [folder.name.split("-") for folder in folders]
    counts = set(map(len, parts))
    if len(counts) == 1:
        columns = zip(*parts, strict=True)
        differs = [len(set(column)) > 1 for column in columns]
        parts = [list(compress(own, differs)) for own in parts]
    names = ["-".join(own) for own in parts]
    if len({folder.parent for folder in folders}) > 1:
        pairs = zip(folders, names, strict=True)
        names = [f"{folder.parent.name}/{name or folder.name}" for folder, name in pairs]
    if len(set(names)) == len(names):
        return names
    return [f"{folder.parent.name}/{folder.name}" for folder in folders]


def _read_test_free_run(folder: Path) -> RecordedCases:
    """Free-run simulation of the model on the test records, read from a run's folder."""
    path = folder / "test.mcap"
    remedy = "choose runs that identified a model"
    require(path.is_file(), "run", folder, "it left no test record", remedy)
    return RecordedCases.from_file(path)


def _signal_values(recording: RecordedCases, name: str) -> list[Float[np.ndarray, "T c"]]:
    """Values of one signal in each recorded simulation or measurement."""
    return [case.values for case in recording.signals(name)]


def _require_same_record(
    first_folder: Path, first_recording: RecordedCases, folder: Path, other_recording: RecordedCases
) -> None:
    """Raise `BadRequest` for a run whose test record differs from that of the first compared
    run."""
    remedy = "name runs of the same data and the same test part"
    for name in ("input", "measured"):
        ours = _signal_values(first_recording, name)
        theirs = _signal_values(other_recording, name)
        alike = len(ours) == len(theirs) and all(map(np.array_equal, ours, theirs))
        problem = f"its test record is not that of {first_folder} ({name} differs)"
        require(alike, "run", folder, problem, remedy)
