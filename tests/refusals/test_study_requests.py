"""A wrong request: one sentence with field, value and remedy, exit status 2, nothing computed and
no folder left."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ssm_study.cli.from_python import composed
from ssm_study.cli.hydra_errors import suggest_for_key
from ssm_study.cli.main import INTERRUPTED, main
from ssm_study.cli.run import _warning_text, configuration_folder
from ssm_study.data.metrics import SlopesNotIdentifiable
from ssm_study.engine.records import write_record
from ssm_study.refusal import BadRequest
from ssm_study.study.line import STUDY
from ssm_study.table.folders import run_folder, study_folder

RECORDED = ("experiment=paper", "data=recorded", "data.input=u", "data.output=y")
WRONG = {
    "model.order": ["model.order=0"],
    "model.order = -2": ["model.order=-2"],
    "model.order = 2.5": ["model.order=2.5"],
    "model.real_modes": ["model.start=ring", "model.order=5", "model.real_modes=2"],
    "model.hidden_width": ["model.hidden_width=0"],
    "model.slope_lower, model.slope_upper": ["model.slope_lower=0.5", "model.slope_upper=0.2"],
    "model.slope_lower": ["model.slope_lower=0"],
    "synthesis.rate_controller": ["synthesis=riccati", "synthesis.rate_controller=1.5"],
    "synthesis.rate_observer": ["synthesis=lmi", "synthesis.rate_observer=0"],
    "loop.measurement_noise_variance": ["loop.measurement_noise_variance=-1"],
    "data.noise_variance": ["data.noise_variance=-0.1"],
    "data.samples": ["data.samples=many"],
    "did you mean model.order?": ["model.ordr=4"],
    "did you mean results_dir?": ["result_dir=/elsewhere"],  # a path is no choice of a file
    "experiment/nope; choose among": ["experiment=nope"],
    "did you mean plant=dc_motor?": ["plant=dc_moter"],
    "did you mean experiment?": ["exp=paper"],
    "did you mean reference@loop.reference=step?": ["synthesis=riccati", "reference=step"],
    "did you mean scaffold@model.scaffold_in=mlp or scaffold@model.scaffold_out=mlp?": [
        "scaffold=mlp"
    ],
    "did you mean +comparison@loop.comparison=peers?": ["comparison=peers"],
    "data=recorded has it: add data=recorded": ["data.path=log.csv"],
    "did you mean data.path?": ["data=recorded", "data.pth=log.csv"],
    "add -m to sweep": ["model.order=4,8"],
    "write model.order=VALUE": ["--model.order", "4"],
    "write seed=VALUE": ["--seed=4"],
    "use `ssm-study reproduce RUN`": ["--experimental-rerun", "config.pickle"],
    "--experimental-r=config.pickle": ["--experimental-r=config.pickle"],
    "seed": ["seed=-1"],
    "loop_seed": ["loop_seed=-1"],
    "model.feedthrough = True: the loop samples": ["model.feedthrough=true"],
    "study": ["study=../elsewhere"],
    "data.input": ["data=recorded", "data.path=somewhere.csv"],
    "no such file": [*RECORDED, "data.path=/nowhere/log.csv"],
    "unrecognized arguments": ["--nonsense"],
    "training.optimiser.nonsense": ["+training.optimiser.nonsense=1"],
    "plant._target_": ["plant._target_=os.system"],
    "retry_failed": ["experiment=smoke", "--retry-failed"],
    "model.hidden_width = 10000000": ["model.hidden_width=10000000"],
    "model.order = 1000000": ["model.order=1000000"],
    "data.trajectories = 1000000000": ["data.trajectories=1000000000"],
    "data.samples = 1000000000": ["data.samples=1000000000"],
    "data.trajectories * samples = 200000000": ["data.trajectories=20000", "data.samples=10000"],
    "loop.initial_conditions * horizon_s / step_s": ["loop.horizon_s=1e12"],
    "reduction.truncate_to = 99: the model has 4": ["reduction.truncate_to=99"],
    "synthesis.rate_observer = 0.9999999999999999": ["synthesis.rate_observer=0.9999999999999999"],
    "synthesis.rate_controller = 0.9999999999999999": [
        "synthesis=riccati",
        "synthesis.rate_controller=0.9999999999999999",
    ],
    "excitation.path": ["excitation=file"],
    "synthesis.rate_controller = nan: is not a finite number": [
        "synthesis=riccati",
        "synthesis.rate_controller=nan",
    ],
    "excitation.amplitude = -inf: is not a finite number": ["excitation.amplitude=-inf"],
    "synthesis.rate = nan: is not a finite number; leave": ["-m", "synthesis.rate=0.1,nan"],
    "loop.input_lower.1 = inf: is not a finite number": ["-m", "loop.input_lower=[-1,inf],[-1,-1]"],
    "training.optimiser = sgd: is not a part of the configuration": ["training.optimiser=sgd"],
    "seed=0,,1 cannot be read": ["-m", "seed=0,,1"],
    "model.order cannot be read": ["model.order"],
    "study='x cannot be read": ["study='x"],
    "a group takes the name of one of its choices": ["plant=null"],
    "--dryrun: there is no such option; did you mean --dry-run?": ["--dryrun"],
    "loop.input_lower, loop.input_upper = (3.0, -3.0)": [
        "loop.input_lower=3",
        "loop.input_upper=-3",
    ],
    "the plant rests at the input 0; choose limits around it": [
        "loop.input_lower=1",
        "loop.input_upper=3",
    ],
    "the plant's inputs number 1": ["loop.input_lower=[-1.0,-2.0]", "loop.input_upper=[1.0,2.0]"],
    "training.accelerator = none: not available on this machine": ["training.accelerator=none"],
    "to run again": ["-m", "experiment=smoke", "seed=0,1", "--retry-failed"],
}


def refused(overrides: list[str], results: Path, capfd: pytest.CaptureFixture[str]) -> str:
    try:
        status = main(["run", f"results_dir={results}", *overrides])
    except SystemExit as end:  # of the parser of arguments
        status = int(str(end.code))
    assert status == 2
    said = capfd.readouterr().err.strip()
    assert "Traceback" not in said
    assert not [path for path in results.rglob("*") if path.is_file()]
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
        assert len(said.splitlines()) == 1


def log(path: Path, columns: dict[str, np.ndarray]) -> Path:
    header = ",".join(columns)
    values = np.column_stack(list(columns.values()))
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
    assert len(said.splitlines()) == 1
    assert ";" in said


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (
            ["loop.input_lower=3"],
            "loop.input_lower, loop.input_upper = (3.0, inf): the log rests at the input 0.5;",
        ),
        (
            ["loop.input_lower=[-9.0,-9.0]", "loop.input_upper=[9.0,9.0]"],
            "the log's inputs number 1",
        ),
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
    path.write_text("time,u,y\n" + "".join(f"{t},{t % 3},{t}\n" for t in range(50)) + "50,1\n")
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
    """The number of threads that torch itself reports in a fresh process, after a request that is
    refused before any work."""
    program = (
        "import sys; from ssm_study.cli.main import main\n"
        "status = main(['run', 'experiment=smoke', 'model.order=-1', *sys.argv[1:]])\n"
        "import torch, numpy\n"
        "print(status, torch.get_num_threads())"
    )
    clean = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    words = ["-m", "hydra/launcher=basic", "seed=0,1"]
    command = [sys.executable, "-c", program, f"results_dir={tmp_path}", *words]
    said = subprocess.run(command, env=clean, capture_output=True, text=True, check=True).stdout
    assert said.split() == ["2", "1"]


@pytest.mark.skipif(
    os.geteuid() == 0 and not Path("/proc").is_dir(), reason="needs a folder nobody can write to"
)
def test_unwritable_results_folder(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "experiment=smoke", "results_dir=/proc/results"]) == 2
    assert "results_dir = /proc/results" in capfd.readouterr().err


def test_a_refused_study_leaves_nothing_where_it_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Also of a sweep, which Hydra would begin by writing its configuration into the folder."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for word in ("study=..", "study=../..", "results_dir="):
        assert main(["run", "-m", "experiment=smoke", "results_dir=r", word, "seed=0,1"]) == 2
        assert word.split("=")[0] in capfd.readouterr().err
    assert list(tmp_path.rglob("*")) == [tmp_path / "here"]


def test_what_was_meant_is_found_beside_a_swept_choice() -> None:
    assert suggest_for_key(
        "synthesis.rate_controler", ["synthesis=lmi,riccati"], configuration_folder()
    ).endswith("controller?")


def test_the_folder_that_was_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    study = Path("results/paper")
    for name in ("order8-width32-seed0-0a1b2c3d4e", "order4-width32-seed0-5f6a7b8c9d"):
        (study / name).mkdir(parents=True)
        write_record(study / name, {"run": name, "status": "ok"})
    assert run_folder(study / "0a1b2c3d4e") == study / "order8-width32-seed0-0a1b2c3d4e"
    assert run_folder(study / "order4-width32-seed0-5f6a7b8c9d").name.startswith("order4")
    with pytest.raises(
        BadRequest, match="2 runs are there; name one: order4-width32-seed0-5f6a7b8c9d, order8"
    ):
        run_folder(study)
    with pytest.raises(
        BadRequest, match=r"there is no record\.json; name one of its study: order4"
    ):
        run_folder(study / "nothing")
    assert study_folder(study) == study
    for wrong in ("paper", "results/papr"):
        with pytest.raises(BadRequest, match=r"did you mean results/paper\?$"):
            study_folder(Path(wrong))
    (study / "runs.parquet").touch()
    with pytest.raises(BadRequest, match="name one: paper"):
        study_folder(Path("results"))
    with pytest.raises(BadRequest, match="give the folder of one run"):
        run_folder(Path("elsewhere"))


def test_a_study_stands_for_its_only_run(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    write_record(tmp_path / "a", {"run": "a", "status": "ok"})
    assert run_folder(tmp_path) == tmp_path / "a"


def test_an_interrupt_is_one_sentence_and_still_an_interrupt() -> None:
    """No traceback, yet the process ends by the signal, so that the loop of a script around it ends
    too."""
    program = (
        "import sys, ssm_study.cli.main as cli\n"
        "def interrupted(_): raise KeyboardInterrupt\n"
        "cli.pop_extension_option = interrupted\n"
        "sys.exit(cli.main(['run']))"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == -signal.SIGINT
    assert ended.stderr == f"ssm-study: {INTERRUPTED}\n"


def test_our_own_warning_is_a_sentence() -> None:
    told = _warning_text(
        SlopesNotIdentifiable("two levels only"), SlopesNotIdentifiable, "facts.py", 28
    )
    assert told == "ssm-study: two levels only\n"
    assert "facts.py:28" in _warning_text("of a library", UserWarning, "facts.py", 28)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("results_dir=null", "results_dir = None: is no name"),
        ("study=null", "study = None: is no name"),
        ("+foo=1", "foo = 1: is no part of a study"),
        ("hydra.output_subdir=../../../x", "hydra.output_subdir"),
        ("hydra.sweep.subdir=same", "hydra.sweep.subdir"),
    ],
)
@pytest.mark.parametrize("many", [[], ["-m"]])
def test_what_was_silently_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], word: str, said: str, many: list[str]
) -> None:
    words = ["experiment=smoke", f"results_dir={tmp_path / 'r'}", word, *many]
    assert main(["run", *words]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_single_dry_run_computes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "experiment=smoke",
        f"results_dir={tmp_path / 'r'}",
        "dry_run=true",
        "training.accelerator=none",
    ]
    assert main(["run", *words]) == 0
    said = capsys.readouterr().out
    assert "1 runs: 0 finished, 1 to do" in said
    assert not list(tmp_path.rglob("*.json"))


@pytest.mark.parametrize(
    "launcher", ["ssm_study_slurm.SlurmLauncher", "hydra_ray_launcher.ray_launcher.RayLauncher"]
)
def test_a_cluster_may_have_what_this_machine_lacks(
    launcher: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = OmegaConf.create({"hydra": {"launcher": {"_target_": f"hydra_plugins.{launcher}"}}})
    config = composed(["experiment=smoke", "training.accelerator=none"])
    monkeypatch.setattr(HydraConfig.instance(), "cfg", there)
    assert STUDY.check(STUDY.settings(config)).training.accelerator == "none"


def test_a_finished_run_says_that_its_data_have_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    log = tmp_path / "log.csv"

    def write(scale: float) -> None:
        u = np.repeat(rng.uniform(-3, 3, 100), 8)
        y = np.zeros(801)
        for k in range(800):
            y[k + 1] = 0.9 * y[k] + 0.2 * scale * u[k]
        log.write_text(
            "u,y\n"
            + "\n".join(f"{a!r},{b!r}" for a, b in zip(u.tolist(), y[:800].tolist(), strict=True))
        )

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
        "training.max_epochs=3",
        "synthesis=riccati",
        "loop.initial_conditions=2",
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


def test_a_broken_pipe_that_is_not_our_output_is_no_good_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(_: list[str]) -> int:
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr("ssm_study.cli.run.run", broken)
    monkeypatch.setattr("ssm_study.cli.main._reader_is_gone", lambda: False)
    assert main(["run"]) == 2


@pytest.mark.parametrize("module", ["plants.sensor", "plants.wrapper"])
def test_a_part_that_is_gone_is_refused_with_what_stands_in_its_place(
    module: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = f"plant._target_=ssm_study.{module}.QuantisedOutput"
    words = ["run", "experiment=smoke", f"results_dir={tmp_path}", target, "--dry-run"]
    assert main(words) == 2
    refusal = capsys.readouterr().err
    assert "withdrawn in 0.2; the sensor's noise is loop.measurement_noise_variance" in refusal


@pytest.mark.parametrize("word", ["retry_failed=3", "dry_run=0", "progress=[[1]]", "strict=-1"])
def test_a_flag_is_true_or_false(
    word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "experiment=smoke", f"results_dir={tmp_path}", word]) == 2
    assert "is neither true nor false; write true or false." in capsys.readouterr().err


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
