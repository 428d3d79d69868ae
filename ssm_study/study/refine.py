"""Refinement of a run: trial in closed loop, new measurement of the model error, new design. Each
trial closes the loop, measures the mismatch from it, and designs again.

Each iteration is a run of the study: the configuration of the one before with one trial more
(`study.trials`).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

from ssm_study.engine.records import FAILED, INFEASIBLE, OK, read_record
from ssm_study.engine.runs import Outcome
from ssm_study.refusal import require
from ssm_study.robustness.coverage import measure_error_spectra
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.study.line import STUDY
from ssm_study.study.loop_recordings import read_loop_recordings
from ssm_study.study.run_files import CONFIGURATION, RunFiles
from ssm_study.study.trials import read_trial_logs, records_from_loops, refined_run_name
from ssm_study.synthesis.measured_discs_run import coverage_columns

# iterations at most: of the designs that failed on plants whose record hid something, two mended
# most
TIMES = 4


@dataclass(frozen=True, kw_only=True)
class RefinementStep:
    """Result of one step of a controller's refinement: a sentence on it, and the configuration of
    the next run, or None at the end."""

    said: str
    config: DictConfig | None = None


def refine_controller(
    run: Path, log: Path | None = None, iterations: int = TIMES
) -> Iterator[RefinementStep]:
    """Improve the controller of a run repeatedly by closed-loop trials, and yield a sentence on
    each new run and on the end.

    `log` is the record of a trial of the run's controller: one iteration. Without it the trials are
    the closed loops on the run's own plant. Raises `BadRequest` for a run that is not ok, has no
    controller or no plant, or for its log.
    """
    files = _open_refinable_run(run, log)
    for _ in range(1 if log else iterations):
        trial = _measure_trial(files, log)
        if trial.is_refinement_complete:
            yield RefinementStep(said=trial.end_sentence)
            return
        config = _next_configuration(files, log)
        outcome: Outcome = STUDY.run_job(config)
        child = RunFiles(path=outcome.folder, record=read_record(outcome.folder) or {})
        sentence = _outcome_sentence(child, trial, outcome)
        yield RefinementStep(said=sentence, config=config)
        if outcome.status == FAILED:
            return
        if _has_same_gains(files, child):
            reason = "the choice no longer changes, although the proof does not cover the loop"
            yield RefinementStep(said=f"Stopped: {reason}.")
            return
        files = child
    if log:
        yield RefinementStep(said="Try the new design and refine with its log.")
    else:
        yield RefinementStep(said=f"Stopped after {iterations} iterations.")


def _has_same_gains(files: RunFiles, child: RunFiles) -> bool:
    """Whether two runs have exactly the same controller and observer gains."""
    before = files.design.gains
    after = child.design.gains
    if before.keys() != after.keys():
        return False
    return all(np.array_equal(before[name], after[name]) for name in before)


def _open_refinable_run(run: Path, log: Path | None) -> RunFiles:
    """Open the files of a run, after a check that its controller can be refined by closed-loop
    trials. Raises `BadRequest` for any other run."""
    files = RunFiles(path=run, record=read_record(run) or {})
    status = files.record.get("status")
    remedy = "give the folder of a run in its study"
    is_run = (run / CONFIGURATION).is_file() and bool(status)
    require(is_run, "run", run, "is no run folder", remedy)
    problem = "is infeasible, so there is no loop"
    require(status != INFEASIBLE, "run", run, problem, "give a run with a controller")
    require(status == OK, "run", run, f"its status is {status}", "give a run that is ok")
    name = files.record.get("run")
    require(name == run.name, "run", run, f"was renamed: it was made as {name}", "rename it back")
    problem = "is the run of a baseline, which has no controller"
    require(files.has_certifiable_model, "run", run, problem, "use model=ssm")
    if log is None:
        has_plant = files.record.get("loop_on") == "plant"
        remedy = "give the log of a trial: --record log.csv"
        require(
            has_plant,
            "run",
            run,
            "its data are a log, so there is no plant to close the loop on",
            remedy,
        )
    else:
        has_no_plant = files.specification.plant is None
        problem = "the run has a plant of its own, and refine closes the loop on that plant"
        require(has_no_plant, "--record", log, problem, "leave it out")
        require(log.is_file(), "--record", log, "no such file", "check the spelling")
    return files


@dataclass(frozen=True, kw_only=True)
class TrialMismatch:
    """Largest gain from input to model error in a closed-loop trial, and the coverage of that error
    by the run's proof. The gain is zero if the loop comes to rest; the coverage of records and
    trial together is None without a proof."""

    gain: float
    coverage: float | None

    @property
    def is_refinement_complete(self) -> bool:
        """Whether the refinement of a controller ends: the loop comes to rest, or the stability
        proof covers the trial's model error."""
        return self.gain == 0 or (self.coverage is not None and self.coverage >= 1)

    @property
    def end_sentence(self) -> str:
        """Sentence that says why the refinement of a controller ends."""
        if self.gain and self.coverage is not None:
            times = math.floor(100 * self.coverage) / 100
            return (
                f"Stopped: the proof covers a model error {times:.2f} times as large as the "
                "records and the loop show."
            )
        reason = "the loop comes to rest, so it shows nothing that makes it swing"
        return f"Stopped: {reason}; the choice stays as it is."


def _measure_trial(files: RunFiles, log: Path | None) -> TrialMismatch:
    """Measure the model error in a closed-loop trial, with the noise estimated from the run's
    records."""
    if log is None:
        closed, _ = read_loop_recordings(files.path)
        trial = records_from_loops(closed.controlled)
    else:
        data: Any = files.specification.data
        trial = read_trial_logs([str(log)], data, files.model.step_s)
    validation = files.model_run.validation
    open_loop = tuple(record for record in files.mismatch_records if not record.closed_loop)
    measured = (validation.records, validation.start_up_samples, open_loop + trial)
    mismatch = measure_model_error(files.model, *measured)
    if mismatch.loop is None:
        return TrialMismatch(gain=0.0, coverage=None)
    records, start_up_samples, trials = measured
    spectra = measure_error_spectra(files.model, records, mismatch, start_up_samples, trials)
    facts = coverage_columns(files.design, files.model, spectra)
    return TrialMismatch(gain=mismatch.loop.gain, coverage=facts.get("coverage"))


def _next_configuration(files: RunFiles, log: Path | None) -> DictConfig:
    """Configuration of the next run of a refinement, with one more simulated or recorded trial."""
    config = files.config.copy()
    before = files.specification.refine
    logs = before if isinstance(before, list) else []
    count = before if isinstance(before, int) else 0
    refine: Any = count + 1 if log is None else [*logs, str(log)]
    study = files.path.parent
    config.update(results_dir=str(study.parent), study=study.name, retry_failed=False)
    config["run"] = refined_run_name(STUDY.settings(config), refine)
    config["refine"] = refine
    return config


def _outcome_sentence(child: RunFiles, trial: TrialMismatch, outcome: Outcome) -> str:
    """Sentence on one iteration of a controller's refinement: its reason and its result."""
    name = child.path.name
    if outcome.status == FAILED:
        return f"{name}: failed: {outcome.message}"
    record = child.record
    predictions = {
        True: "predicted to be stable",
        False: "not predicted to be stable",
        None: "not judged",
    }
    settled_words = ""
    if "stable_count" in record:
        stable = record.get("stable_count")
        cases = record.get("initial_conditions")
        settled_words = f", {stable:.0f} of {cases:.0f} settle"
    prediction = predictions[record["predicted_stable"]]
    cause = f"the loop showed a mismatch of {trial.gain:.3g}, which the proof does not cover"
    return f"{name}: {cause}; chosen again: {prediction}{settled_words}"
