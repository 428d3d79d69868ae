"""Words of the command line: what was meant is suggested, what cannot be is refused."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ssm_study.cli.from_python import compose_configuration
from ssm_study.cli.hydra_errors import suggest_key
from ssm_study.cli.main import INTERRUPTED, main
from ssm_study.cli.run import _warning_text
from ssm_study.data.metrics import UnidentifiableSlopesWarning
from ssm_study.engine.records import write_record
from ssm_study.extensions import configuration_folder
from ssm_study.refusal import BadRequest
from ssm_study.study.line import STUDY
from ssm_study.table.folders import check_study_folder, find_run_folder


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
        err = capfd.readouterr().err
        assert word.split("=")[0] in err
    paths = list(tmp_path.rglob("*"))
    assert paths == [tmp_path / "here"]


def test_what_was_meant_is_found_beside_a_swept_choice() -> None:
    assert suggest_key(
        "synthesis.rate_controler", ["synthesis=lmi,riccati"], configuration_folder()
    ).endswith("controller?")


def test_the_folder_that_was_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    study = Path("results/paper")
    for name in ("order8-width32-seed0-0a1b2c3d4e", "order4-width32-seed0-5f6a7b8c9d"):
        (study / name).mkdir(parents=True)
        record = {"run": name, "status": "ok"}
        write_record(study / name, record)
    folder = find_run_folder(study / "0a1b2c3d4e")
    assert folder == study / "order8-width32-seed0-0a1b2c3d4e"
    folder = find_run_folder(study / "order4-width32-seed0-5f6a7b8c9d")
    assert folder.name.startswith("order4")
    with pytest.raises(
        BadRequest, match="2 runs are there; name one: order4-width32-seed0-5f6a7b8c9d, order8"
    ):
        find_run_folder(study)
    with pytest.raises(
        BadRequest, match=r"there is no record\.json; name one of its study: order4"
    ):
        find_run_folder(study / "nothing")
    assert check_study_folder(study) == study
    for wrong in ("paper", "results/papr"):
        with pytest.raises(BadRequest, match=r"did you mean results/paper\?$"):
            check_study_folder(Path(wrong))
    (study / "runs.parquet").touch()
    with pytest.raises(BadRequest, match="name one: paper"):
        check_study_folder(Path("results"))
    with pytest.raises(BadRequest, match="give the folder of one run"):
        find_run_folder(Path("elsewhere"))


def test_a_study_stands_for_its_only_run(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    record = {"run": "a", "status": "ok"}
    write_record(tmp_path / "a", record)
    assert find_run_folder(tmp_path) == tmp_path / "a"


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
        UnidentifiableSlopesWarning("two levels only"), UnidentifiableSlopesWarning, "facts.py", 28
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
    paths = list(tmp_path.iterdir())
    assert paths == []


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
    paths = tmp_path.rglob("*.json")
    assert not list(paths)


@pytest.mark.parametrize(
    "launcher", ["ssm_study_slurm.SlurmLauncher", "hydra_ray_launcher.ray_launcher.RayLauncher"]
)
def test_a_cluster_may_have_what_this_machine_lacks(
    launcher: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hydra = {"launcher": {"_target_": f"hydra_plugins.{launcher}"}}
    there = OmegaConf.create({"hydra": hydra})
    config = compose_configuration(["experiment=smoke", "training.accelerator=none"])
    hydra_config = HydraConfig.instance()
    monkeypatch.setattr(hydra_config, "cfg", there)
    study = STUDY.build_request(STUDY.settings(config))
    training = study.training
    accelerator = training.accelerator
    assert accelerator == "none"


def test_a_broken_pipe_that_is_not_our_output_is_no_good_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(_: list[str]) -> int:
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr("ssm_study.cli.run.run", broken)
    monkeypatch.setattr("ssm_study.cli.main._is_output_closed", lambda: False)
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
