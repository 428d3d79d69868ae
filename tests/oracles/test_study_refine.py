"""`refine`: a loop that oscillates tells what its records hid, and the choice made again
settles."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig, open_dict

import ssm_study as st
from benchmarks.adversarial.plants.peaking_gain import PeakingGain
from ssm_study.cli.from_python import compose_configuration
from ssm_study.cli.main import main
from ssm_study.engine.records import read_record
from ssm_study.engine.runs import write_run_manifest
from ssm_study.refusal import BadRequest
from ssm_study.study import allow_list
from ssm_study.study.line import STUDY
from ssm_study.study.refine import _measure_trial, refine_controller
from ssm_study.study.run_files import RunFiles
from ssm_study.study.trials import TRIED, refined_run_name
from ssm_study.study.verify import verify

pytestmark = pytest.mark.usefixtures("made_once", "without_baselines")

# At full amplitude the gain is one nearly all the time; at rest it is eleven, and no record is
# taken there.
PEAK = {"first_s": 0.1, "second_s": 0.4, "peak": 10.0, "width": 0.01}
TINY = [
    "model.order=2",
    "model.hidden_width=4",
    "training.max_epochs=8",
    "loop.initial_conditions=3",
    "progress=false",
]
TINY += [
    "+synthesis.input_weights=[0.001,0.1,10.0,100.0]",
    "+synthesis.output_noises=[0.01,0.1,1.0]",
]  # fewer candidates
HIDDEN = [
    "data.trajectories=2",
    "data.samples=400",
    "data.validation_samples=600",
    "data.test_samples=400",
]
LOG = ["data=recorded", "model=ssm", "data.input=input", "data.output=output", "data.step_s=0.05"]


def failing(run: Path) -> set[str]:
    return {finding.claim for finding in verify(run) if not finding.holds}


@pytest.fixture(scope="module", autouse=True)
def _benchmarks_trusted():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            allow_list,
            "trusted_packages",
            lambda: {"benchmarks": Path(__file__).parents[2] / "benchmarks"},
        )
        yield


@pytest.fixture(scope="module")
def hidden(tmp_path_factory) -> DictConfig:
    folder = tmp_path_factory.mktemp("refine")
    config = compose_configuration(
        ["study=peak", "seed=1", f"results_dir={folder}", "+data.trials=false", *HIDDEN, *TINY]
    )
    with open_dict(config):
        config.plant = {"_target_": f"{PeakingGain.__module__}.PeakingGain", **PEAK}
    return config


@pytest.fixture(scope="module")
def first(hidden: DictConfig) -> Path:
    return STUDY.run_job(hidden).folder


@pytest.fixture(scope="module")
def steps(first: Path) -> list:
    return list(refine_controller(first))


@pytest.fixture(scope="module")
def second(first: Path, steps: list) -> Path:  # noqa: ARG001 - made by the steps
    paths = first.parent.glob("*/record.json")
    (run,) = (path.parent for path in paths if path.parent != first)
    return run


def test_a_wrong_prediction_is_mended_by_the_loop_itself(first, second, steps):
    before = read_record(first)
    after = read_record(second)
    assert before["predicted_stable"]
    assert before["stable_count"] == 0
    assert after["predicted_stable"]
    assert after["stable_count"] == after["initial_conditions"] == 3
    assert before["certified_tolerance"] < after["mismatch_in_loop"] <= after["certified_tolerance"]
    assert after["mismatch_seen"] >= after["mismatch_in_loop"]
    assert "comes to rest" in steps[-1].said
    assert "mismatch_in_loop" not in before


def test_a_refined_run_names_its_parent_and_trains_nothing(first, second):
    before = read_record(first)
    after = read_record(second)
    assert after["parent_run"] == first.name
    assert after["refinements"] == 1
    assert "parent_run" not in before
    for stage in ("dataset", "model", "bounds"):
        assert after[f"stage_{stage}_key"] == before[f"stage_{stage}_key"]
    assert after["stage_model_reused"]


def test_a_refined_run_is_verified_from_its_files(second, tmp_path):
    assert failing(second) == set()
    unchecked = verify(second).unchecked
    assert "chosen is not" in unchecked[TRIED]
    run = shutil.copytree(second, tmp_path / second.name)
    text = (run / TRIED).read_text()
    tried = json.loads(text)
    tried[0]["state_feedback"]["k"][0][0] *= 0.9
    text = json.dumps(tried)
    (run / TRIED).write_text(text)
    write_run_manifest(run)
    assert failing(run) == {"trials.mcap records"}


def test_a_sweep_over_iterations_finds_the_same_run(hidden, second):
    config = hidden.copy()
    config.refine = 1
    assert config.run == second.name
    outcome = STUDY.run_job(config)
    assert outcome.did == "found"
    assert outcome.folder == second


def test_where_the_loop_rests_nothing_is_chosen_again(second, smoke_run):
    for run in (second, smoke_run):
        paths = run.parent.glob("*/record.json")
        before = sorted(paths)
        (step,) = refine_controller(run)
        assert step.config is None
        assert "comes to rest" in step.said
        paths = sorted(run.parent.glob("*/record.json"))
        assert paths == before


def test_a_loop_within_the_proof_needs_no_other_choice(first, second):
    """The run's own proof, with the trial of its loop among the records that it must cover."""
    files = RunFiles(path=first, record=read_record(first))
    swings = _measure_trial(files, None)
    assert swings.gain > 0
    assert not swings.is_refinement_complete
    changed_swings = replace(swings, coverage=1.234)
    assert changed_swings.is_refinement_complete
    changed_swings = replace(swings, coverage=1.234)
    end_sentence = changed_swings.end_sentence
    assert "1.23 times" in end_sentence
    changed_swings = replace(swings, coverage=0.999)
    assert not changed_swings.is_refinement_complete
    files = RunFiles(path=second, record=read_record(second))
    rests = _measure_trial(files, None)
    assert rests.is_refinement_complete
    assert "comes to rest" in rests.end_sentence


def write(path: Path, u: np.ndarray, y: np.ndarray, head: str = "input,output") -> Path:
    np.savetxt(path, np.column_stack([u, y]), delimiter=",", header=head, comments="", fmt="%.12g")
    return path


@pytest.fixture(scope="module")
def logged(tmp_path_factory) -> Path:
    """A run from a log of the same plant, which is then nobody's to simulate."""
    folder = tmp_path_factory.mktemp("logged")
    rng = np.random.default_rng(0)
    plant = PeakingGain(**PEAK)
    u = np.repeat(rng.uniform(-1, 1, 200), rng.integers(2, 20, 200))[:1600, None]
    response = plant.simulate(u[None])
    white_noise = rng.standard_normal(u.shape)
    y = response[1][0] + 0.01 * white_noise
    log = write(folder / "log.csv", u, y)
    assert main(["run", *LOG, f"data.path={log}", "study=log", f"results_dir={folder}", *TINY]) == 0
    (record,) = folder.glob("log/*/record.json")
    return record.parent


def trial(run: Path, to: Path, peak: float) -> Path:
    """The run's controller on a plant, from one start; the sensor's noise is the plant's."""
    plant = PeakingGain(**PEAK | {"peak": peak})
    frame = st.simulate(st.load(run), [0.5], "study=s", "loop.horizon_s=20", plant=plant)
    rng = np.random.default_rng(1)
    white_noise = rng.standard_normal(len(frame))
    noise = 0.01 * white_noise
    return write(to, frame["input"], frame["output"] + noise)


def test_the_log_of_a_trial_that_oscillates_changes_the_choice(logged, tmp_path, capsys):
    log = trial(logged, tmp_path / "trial.csv", PEAK["peak"])
    before = read_record(logged)
    assert main(["refine", str(logged), "--record", str(log)]) == 0
    told = capsys.readouterr().out
    assert "refine with its log" in told
    paths = logged.parent.glob("*/record.json")
    (run,) = (path.parent for path in paths if path.parent != logged)
    after = read_record(run)
    assert after["parent_run"] == logged.name
    assert after["refinements"] == 1
    assert after["stage_model_key"] == before["stage_model_key"]
    assert before["certified_tolerance"] < after["mismatch_in_loop"]
    assert after["controller_gain_norm"] < before["controller_gain_norm"]
    assert failing(run) == set()
    text = log.read_text()
    log.write_text(text + "0,0\n")
    with pytest.raises(BadRequest, match=r"trial\.csv changed since this run was done"):
        STUDY.run_job(next(step.config for step in refine_controller(logged, log)))


def test_the_log_of_a_trial_that_rests_changes_nothing(logged, tmp_path):
    log = trial(logged, tmp_path / "rests.csv", 0.0)
    (step,) = refine_controller(logged, log)
    assert "comes to rest" in step.said


def test_a_run_that_cannot_be_refined_is_refused(logged, first, tmp_path):
    moving = np.sin(np.arange(200) / 5)
    good = write(tmp_path / "good.csv", moving, moving)
    refused = {
        "is no run folder": (tmp_path, None),
        "there is no plant to close the loop on; give the log of a trial": (logged, None),
        "the run has a plant of its own": (first, good),
        "no such file": (logged, tmp_path / "absent.csv"),
        "the header has voltage, speed": (
            logged,
            write(tmp_path / "other.csv", moving, 2 * moving, "voltage,speed"),
        ),
        "the input never moves": (logged, write(tmp_path / "still.csv", 0 * moving, moving)),
        "log a longer trial": (logged, write(tmp_path / "short.csv", moving[:20], 2 * moving[:20])),
    }
    for said, (run, log) in refused.items():
        with pytest.raises(BadRequest, match=said):
            list(refine_controller(run, log))


def test_a_log_at_another_sampling_time_is_refused(logged, tmp_path):
    run = shutil.copytree(logged, tmp_path / "log" / logged.name)
    config_path = run / ".hydra" / "config.yaml"
    text = config_path.read_text()
    config = text.replace("time: null", "time: t")
    config_path = run / ".hydra" / "config.yaml"
    config_path.write_text(config.replace("step_s: 0.05", "step_s: null"))
    t = np.arange(200)
    sine = np.sin(t)
    cosine = np.cos(t)
    np.savetxt(
        tmp_path / "slow.csv",
        np.column_stack([0.1 * t, sine, cosine]),
        delimiter=",",
        header="t,input,output",
        comments="",
    )
    with pytest.raises(BadRequest, match=r"sampling time is 0\.05 s"):
        list(refine_controller(run, tmp_path / "slow.csv"))


@pytest.mark.parametrize("asked", [0, -1, True, 1.5, "log.csv", ["log.csv"]])
def test_iterations_that_are_no_count_are_refused(asked, hidden):
    config = hidden.copy()
    with open_dict(config):
        config.refine = asked
    with pytest.raises(BadRequest, match="refine"):
        STUDY.run_job(config)


def test_the_parent_keeps_what_stands_before_the_hash(hidden):
    settings = STUDY.settings(hidden)
    assert refined_run_name(settings, None) == hidden.run
    assert refined_run_name(settings, 1).startswith("order2-width4-seed1-")
