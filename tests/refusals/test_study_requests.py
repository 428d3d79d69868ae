"""A wrong request: one sentence with field, value and remedy, exit status 2, nothing computed and
no folder left."""

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf

from ssm_study.cli.from_python import compose_configuration
from ssm_study.cli.main import main
from ssm_study.engine.settings import plain_settings
from ssm_study.refusal import BadRequest
from ssm_study.study.line import STUDY
from ssm_study.study.specification import _read_refine_setting

RECORDED = ("experiment=paper", "data=recorded", "data.input=u", "data.output=y")


WRONG: dict[str, list[str]] = {}
WRONG["model.order"] = ["model.order=0"]
WRONG["data.samples"] = ["data.samples=many"]
WRONG["did you mean model.order?"] = ["model.ordr=4"]
WRONG["did you mean results_dir?"] = ["result_dir=/elsewhere"]  # a path is no choice of a file
WRONG["experiment/nope; choose among"] = ["experiment=nope"]
WRONG["did you mean plant=dc_motor?"] = ["plant=dc_moter"]
WRONG["did you mean experiment?"] = ["exp=paper"]
WRONG["did you mean reference@loop.reference=step?"] = ["synthesis=riccati", "reference=step"]
WRONG["did you mean scaffold@model.scaffold_in=mlp or scaffold@model.scaffold_out=mlp?"] = [
    "scaffold=mlp"
]
WRONG["did you mean +comparison@loop.comparison=peers?"] = ["comparison=peers"]
WRONG["data=recorded has it: add data=recorded"] = ["data.path=log.csv"]
WRONG["did you mean data.path?"] = ["data=recorded", "data.pth=log.csv"]
WRONG["add -m to sweep"] = ["model.order=4,8"]
WRONG["write model.order=VALUE"] = ["--model.order", "4"]
WRONG["write seed=VALUE"] = ["--seed=4"]
WRONG["use `ssm-study reproduce RUN`"] = ["--experimental-rerun", "config.pickle"]
WRONG["--experimental-r=config.pickle"] = ["--experimental-r=config.pickle"]
WRONG["study"] = ["study=../elsewhere"]
WRONG["data.input"] = ["data=recorded", "data.path=somewhere.csv"]
WRONG["no such file"] = [*RECORDED, "data.path=/nowhere/log.csv"]
WRONG["unrecognized arguments"] = ["--nonsense"]
WRONG["training.optimiser.nonsense"] = ["+training.optimiser.nonsense=1"]
WRONG["plant._target_"] = ["plant._target_=os.system"]
WRONG["retry_failed"] = ["experiment=smoke", "--retry-failed"]
WRONG["excitation.path"] = ["excitation=file"]
WRONG["synthesis.rate_controller = nan: is not a finite number"] = [
    "synthesis=riccati",
    "synthesis.rate_controller=nan",
]
WRONG["excitation.amplitude = -inf: is not a finite number"] = ["excitation.amplitude=-inf"]
WRONG["synthesis.rate = nan: is not a finite number; leave"] = ["-m", "synthesis.rate=0.1,nan"]
WRONG["loop.input_lower.1 = inf: is not a finite number"] = [
    "-m",
    "loop.input_lower=[-1,inf],[-1,-1]",
]
WRONG["training.optimiser = sgd: is not a part of the configuration"] = ["training.optimiser=sgd"]
WRONG["seed=0,,1 cannot be read"] = ["-m", "seed=0,,1"]
WRONG["model.order cannot be read"] = ["model.order"]
WRONG["study='x cannot be read"] = ["study='x"]
WRONG["a group takes the name of one of its choices"] = ["plant=null"]
WRONG["--dryrun: there is no such option; did you mean --dry-run?"] = ["--dryrun"]
WRONG["training.accelerator = none: not available on this machine"] = ["training.accelerator=none"]
WRONG["to run again"] = ["-m", "experiment=smoke", "seed=0,1", "--retry-failed"]

# Values that the parts of a study refuse when they are built: one sentence is made of each as of
# the first of WRONG.
VALUES: dict[str, list[str]] = {}
VALUES["model.order = -2"] = ["model.order=-2"]
VALUES["model.order = 2.5"] = ["model.order=2.5"]
VALUES["model.real_modes = 2: "] = ["model.start=ring", "model.order=5", "model.real_modes=2"]
VALUES["model.hidden_width"] = ["model.hidden_width=0"]
VALUES["model.slope_lower, model.slope_upper"] = ["model.slope_lower=0.5", "model.slope_upper=0.2"]
VALUES["model.slope_lower"] = ["model.slope_lower=0"]
VALUES["synthesis.rate_controller"] = ["synthesis=riccati", "synthesis.rate_controller=1.5"]
VALUES["synthesis.rate_observer"] = ["synthesis=lmi", "synthesis.rate_observer=0"]
VALUES["loop.measurement_noise_variance"] = ["loop.measurement_noise_variance=-1"]
VALUES["data.noise_variance"] = ["data.noise_variance=-0.1"]
VALUES["seed"] = ["seed=-1"]
VALUES["loop_seed"] = ["loop_seed=-1"]
VALUES["model.feedthrough = True: the loop samples"] = ["model.feedthrough=true"]
VALUES["model.hidden_width = 10000000"] = ["model.hidden_width=10000000"]
VALUES["model.order = 1000000"] = ["model.order=1000000"]
VALUES["data.trajectories = 1000000000"] = ["data.trajectories=1000000000"]
VALUES["data.samples = 1000000000"] = ["data.samples=1000000000"]
VALUES["data.trajectories * samples = 200000000"] = [
    "data.trajectories=20000",
    "data.samples=10000",
]
VALUES["loop.initial_conditions * horizon_s / step_s"] = ["loop.horizon_s=1e12"]
VALUES["reduction.truncate_to = 99: the model has 4"] = ["reduction.truncate_to=99"]
VALUES["synthesis.rate_observer = 0.9999999999999999"] = [
    "synthesis.rate_observer=0.9999999999999999"
]
VALUES["synthesis.rate_controller = 0.9999999999999999"] = [
    "synthesis=riccati",
    "synthesis.rate_controller=0.9999999999999999",
]
VALUES["loop.input_lower, loop.input_upper = (3.0, -3.0)"] = [
    "loop.input_lower=3",
    "loop.input_upper=-3",
]
VALUES["the plant rests at the input 0; choose limits around it"] = [
    "loop.input_lower=1",
    "loop.input_upper=3",
]
VALUES["the plant has 1 input"] = ["loop.input_lower=[-1.0,-2.0]", "loop.input_upper=[1.0,2.0]"]


def refused(overrides: list[str], results: Path, capfd: pytest.CaptureFixture[str]) -> str:
    try:
        status = main(["run", f"results_dir={results}", *overrides])
    except SystemExit as end:  # of the parser of arguments
        status = int(str(end.code))
    assert status == 2
    err = capfd.readouterr().err
    said = err.strip()
    assert "Traceback" not in said
    paths = results.rglob("*")
    assert not [path for path in paths if path.is_file()]
    return said


@pytest.mark.parametrize(("names", "overrides"), WRONG.items(), ids=list(WRONG))
def test_one_sentence(
    names: str, overrides: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    small = (
        []
        if any(word.startswith(("experiment=", "exp=")) for word in overrides)
        else ["experiment=smoke"]
    )
    said = refused([*small, *overrides], tmp_path / "results", capfd)
    assert names in said
    if "--nonsense" not in overrides:
        lines = said.splitlines()
        assert len(lines) == 1


@cache
def composed(choices: tuple[str, ...]) -> DictConfig:
    """The smoke configuration with other choices of its parts."""
    return compose_configuration(["experiment=smoke", *choices])


@pytest.mark.parametrize(("sentence", "words"), VALUES.items(), ids=list(VALUES))
def test_a_part_refuses_a_value(sentence: str, words: list[str]) -> None:
    choices = [word for word in words if word.startswith("synthesis=")]
    values = [word for word in words if word not in choices]
    config = composed(tuple(choices)).copy()
    OmegaConf.set_struct(config, False)  # some fields stand in no yaml
    config.merge_with_dotlist(values)
    settings = plain_settings(config)
    with pytest.raises(BadRequest) as refusal:
        STUDY.build_request(settings)
    assert sentence in str(refusal.value)


def log(path: Path, columns: dict[str, np.ndarray]) -> Path:
    header = ",".join(columns)
    signals = list(columns.values())
    values = np.column_stack(signals)
    np.savetxt(path, values, delimiter=",", header=header, comments="")
    return path


TIME = np.arange(400) * 0.01


EXCITED = np.sign(np.sin(37.0 * TIME)) * (1 + np.cos(5 * TIME))


ANSWER = np.cumsum(EXCITED) * 0.01


MALFORMED = {
    "log.csv (column) = u": {"time": TIME, "voltage": EXCITED, "speed": ANSWER},
    "u = 1.0: constant": {"time": TIME, "u": np.ones(400), "y": ANSWER},
    "column u (largest) = 1.99": {"time": TIME, "u": 1e300 * EXCITED, "y": ANSWER},
    "column y (largest) = 3.77": {"time": TIME, "u": EXCITED, "y": 1e-300 * ANSWER},
}


@pytest.mark.parametrize("what", MALFORMED)
def test_malformed_recordings(what: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = log(tmp_path / "log.csv", MALFORMED[what])
    said = refused([*RECORDED, f"data.path={path}", "data.time=time"], tmp_path / "results", capfd)
    assert what in said
    lines = said.splitlines()
    assert len(lines) == 1
    assert ";" in said


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (
            ["loop.input_lower=3"],
            "loop.input_lower, loop.input_upper = (3.0, inf): the log rests at the input 0.5;",
        ),
        (["loop.input_lower=[-9.0,-9.0]", "loop.input_upper=[9.0,9.0]"], "the log has 1 input"),
        (
            ["loop.input_lower=3", "reference@loop.reference=step", "loop.reference.at_s=1"],
            "choose limits around it",
        ),
    ],
)
def test_limits_beyond_the_rest_of_a_log(
    limits: list[str], words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = log(tmp_path / "log.csv", {"time": TIME, "u": EXCITED, "y": ANSWER})
    known = [*RECORDED, "data.time=time", f"data.path={path}", "+data.input_equilibrium=[0.5]"]
    assert words in refused([*known, *limits], tmp_path / "results", capfd)
    from_a_set_point = [
        *known,
        "loop.input_lower=3",
        "reference@loop.reference=step",
        "dry_run=true",
    ]
    assert main(["run", f"results_dir={tmp_path / 'results'}", *from_a_set_point]) == 0


def test_unequal_lengths(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "log.csv"
    text = "".join(f"{t},{t % 3},{t}\n" for t in range(50))
    path.write_text("time,u,y\n" + text + "50,1\n")
    said = refused([*RECORDED, f"data.path={path}", "data.time=time"], tmp_path / "results", capfd)
    assert "Row #52: Expected 3 columns, got 2" in said


@pytest.mark.parametrize("asked", ["4096", "0", "many"])
def test_more_threads_than_cores(
    asked: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A single run and Hydra's basic launcher work in this process: its threads are the whole
    budget."""
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert f"OMP_NUM_THREADS = {asked}" in refused(
        ["experiment=smoke"], tmp_path / "results", capfd
    )


def test_one_thread_unless_asked(tmp_path: Path) -> None:
    """Torch reads the number when it is imported: after it is set, and before any work.

    That torch takes it is seen in the jobs of a sweep (tests/laws/test_engine_launcher.py).
    """
    program = (
        "import os, sys; from ssm_study.cli.main import main\n"
        "status = main(['run', 'experiment=smoke', 'model.order=-1', *sys.argv[1:]])\n"
        "print(status, os.environ['OMP_NUM_THREADS'], 'torch' in sys.modules)"
    )
    clean = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    words = ["-m", "hydra/launcher=basic", "seed=0,1"]
    command = [sys.executable, "-c", program, f"results_dir={tmp_path}", *words]
    said = subprocess.run(command, env=clean, capture_output=True, text=True, check=True).stdout
    assert said.split() == ["2", "1", "False"]


def test_a_finished_run_says_that_its_data_have_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    log = tmp_path / "log.csv"

    def write(scale: float) -> None:
        u = np.repeat(rng.uniform(-3, 3, 50), 8)
        y = np.zeros(401)
        for k in range(400):
            y[k + 1] = 0.9 * y[k] + 0.2 * scale * u[k]
        table = np.column_stack([u, y[:400]])
        np.savetxt(log, table, delimiter=",", header="u,y", comments="")

    words = [
        "data=recorded",
        f"data.path={log}",
        "data.input=u",
        "data.output=y",
        "data.step_s=0.1",
        "model.slope_lower=0.5",
    ]
    words += [
        "model=ssm",
        "model.order=2",
        "training.max_epochs=2",
        "synthesis=riccati",
        "loop.initial_conditions=2",
        "loop.horizon_s=1",
        "study=log",
    ]
    words += ["synthesis.rate_controller=0.5", "synthesis.rate_observer=0.6"]
    write(1.0)
    assert main(["run", *words, f"results_dir={tmp_path / 'r'}", "progress=false"]) == 0
    assert main(["run", *words, f"results_dir={tmp_path / 'r'}", "progress=false"]) == 0
    write(2.0)
    assert main(["run", *words, f"results_dir={tmp_path / 'r'}", "progress=false"]) == 2
    assert (
        "log.csv changed since this run was done; give study a new name" in capsys.readouterr().err
    )


def test_a_name_or_a_folder_that_cannot_be_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A name of 255 letters was called no plain name, one that is too long a full disk."""
    words = ["run", "experiment=smoke", "--dry-run"]
    assert main([*words, f"results_dir={tmp_path}", f"study={'x' * 255}"]) == 2
    assert "use letters, digits, '.', '_' and '-', at most 200 of them." in capsys.readouterr().err
    assert main([*words, f"results_dir={tmp_path / ('x' * 256)}"]) == 2
    assert "File name too long; choose shorter names." in capsys.readouterr().err
    log = tmp_path / "log.h5"
    log.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(300))
    data = [f"data.path={log}", "data.input=u", "data.output=y", "data.step_s=0.1"]
    assert main(["run", "data=recorded", f"results_dir={tmp_path}", *data, "--dry-run"]) == 2
    refusal = capsys.readouterr().err
    assert refusal.endswith(
        "export the columns as Parquet or CSV.\n"
    )  # look does not read it either


REFUSED_TRIALS = [
    (["nowhere.csv"], "no such file"),
    ([], "there is no plant"),
    (2, "there is no plant"),
]


@pytest.mark.parametrize(("requested", "says"), REFUSED_TRIALS)
def test_beside_a_log_only_files_of_trials_refine(requested: object, says: str) -> None:
    with pytest.raises(BadRequest, match=says):
        _read_refine_setting(requested, is_recorded=True)


REFUSED_COUNTS = [0, -1, 1.5, True, "trial.csv"]


@pytest.mark.parametrize("requested", REFUSED_COUNTS)
def test_beside_a_plant_only_a_number_of_iterations_refines(requested: object) -> None:
    with pytest.raises(BadRequest, match="is no number of iterations"):
        _read_refine_setting(requested, is_recorded=False)


def test_a_refinement_that_can_run_is_taken(tmp_path: Path) -> None:
    trial = tmp_path / "trial.csv"
    trial.touch()
    logs = [str(trial)]
    assert _read_refine_setting(str(trial), is_recorded=True) == logs
    assert _read_refine_setting(logs, is_recorded=True) == logs
    assert _read_refine_setting(3, is_recorded=False) == 3
    assert _read_refine_setting(None, is_recorded=True) is None
