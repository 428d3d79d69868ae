"""Every command goes through one guard: damaged files and read-only folders end it in one sentence,
with status 2."""

import json
import os
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from ssm_study.certificates.certificate import certificate_digest
from ssm_study.cli.main import main
from ssm_study.cli.parser import ACTIONS
from ssm_study.engine.records import read_record, write_record
from ssm_study.engine.runs import write_run_manifest
from ssm_study.refusal import BadRequest
from ssm_study.study.verify import verify
from ssm_study.table.gather import gather

NEEDED_BY_EXCITE = ("to", "lower", "upper", "rest", "step-s", "settle-s")
NEEDED = {"export": ["--to", "out"], "gather": [], "show": [], "verify": [], "report": []}
# What libraries raise on files that nobody wrote so; none of them may reach the user as a
# traceback.
RAISED = (RuntimeError("a"), RecursionError(), struct.error("b"), yaml.YAMLError("c"),
          MemoryError(), EOFError(),
          np.linalg.LinAlgError("d"), NotImplementedError(), AssertionError())  # fmt: skip
DEEP = "[" * 100_000

# Each damage is one file of a copy of the same run.
pytestmark = pytest.mark.usefixtures("made_once")


@pytest.fixture
def study(smoke_study: Path, tmp_path: Path) -> Path:
    return shutil.copytree(
        smoke_study, tmp_path / "smoke", ignore=shutil.ignore_patterns("figures")
    )


def run_of(study: Path) -> Path:
    (lock,) = study.glob("*/.lock")
    return lock.parent


def one_sentence(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The sentence with which the command ends, with status 2."""
    assert main(words) == 2
    said = capsys.readouterr().err
    lines = said.splitlines()
    assert len(lines) == 1
    assert said.startswith("ssm-study: ")
    return said


@pytest.mark.parametrize("command", [*ACTIONS, "new", "excite", "run"])
def test_whatever_is_raised_is_one_sentence(
    command: str, study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    new = ["new", "x"]
    run = ["run", "seed=0"]
    needed = NEEDED.get(command, [])
    words = {"new": new, "run": run}.get(command, [command, str(study), *needed])
    if command == "excite":
        words = ["excite", *(word for name in NEEDED_BY_EXCITE for word in (f"--{name}", "1"))]
    for error in RAISED:

        def ends(*_: object, error: Exception = error) -> int:
            raise error

        if command in ACTIONS:
            monkeypatch.setitem(ACTIONS, command, ACTIONS[command]._replace(function=ends))
        else:
            named = {
                "new": "commands.write_new_study",
                "excite": "commands.write_excitation",
                "run": "run.run",
            }[command]
            monkeypatch.setattr(f"ssm_study.cli.{named}", ends)
        assert type(error).__name__ in one_sentence(words, capsys)
    monkeypatch.setenv("SSM_STUDY_TRACEBACK", "1")
    with pytest.raises(AssertionError):
        main(words)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def write_in_run(name: str, content: str) -> Callable[[Path], object]:
    """A damage: a file of the study's run with another content."""
    return lambda study: (run_of(study) / name).write_text(content)


def cut_in_run(name: str) -> Callable[[Path], object]:
    """A damage: half of a file of the study's run."""
    return lambda study: cut(run_of(study) / name)


def write_no_table(study: Path) -> None:
    """A damage: rows of different lengths, and a letter in no encoding."""
    path = run_of(study) / "comparison.csv"
    path.write_bytes(b'a,b\n1,2,3\n"\xff')


DAMAGES: dict[str, Callable[[Path], object]] = {
    "model nested": write_in_run("model.json", DEEP),
    "certificate nested": write_in_run("certificate.json", DEEP),
    "record cut": cut_in_run("record.json"),
    "manifest cut": cut_in_run("manifest.json"),
    "yaml": write_in_run(".hydra/config.yaml", "a: [b"),
    "closed loop": cut_in_run("closed_loop.mcap"),
    "validation": write_in_run("validation.mcap", ""),
    "comparison": write_no_table,
    "table": lambda study: cut(study / "runs.parquet"),
    "index": lambda study: (study / ".gathered.json").write_text(DEEP),
}
SPARSE: dict[str, Callable[[Path], object]] = {
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "a device": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    "20 GB": lambda path: os.truncate(path, 20 * 2**30),
}


@pytest.mark.parametrize(
    ("what", "name"),
    [
        *((what, "record.json") for what in SPARSE),
        ("20 GB", "certificate.json"),
        ("a pipe", ".hydra/config.yaml"),
    ],
)
def test_what_never_ends_is_not_read(what: str, name: str, study: Path) -> None:
    """A run's file that is none, or larger than any: the study is gathered, `verify` says what is
    wrong."""
    SPARSE[what](run_of(study) / name)
    (status,) = gather(study)["status"]
    expected = "corrupt" if name == "record.json" else "ok"
    assert status == expected
    with pytest.raises(BadRequest, match=r"do not hold|there is no record\.json"):
        verify(run_of(study)).require_valid("run", study)


# The table is made anew; what `verify` makes of each damage has tests of its own, and `export`
# refuses by it.
OF_THE_RUN = ("model nested", "comparison")


@pytest.mark.parametrize("command", ["gather", "show", "export"])
def test_damaged_files(
    command: str, smoke_study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exports = command == "export"
    for what in OF_THE_RUN if exports else DAMAGES:
        study = shutil.copytree(smoke_study, tmp_path / what)
        DAMAGES[what](study)
        if exports:
            out_path = str(study / "out")
            assert "claims do not hold" in one_sentence(
                [command, str(run_of(study)), "--to", out_path], capsys
            )
            assert not (study / "out").exists()
        else:
            assert main([command, str(study)]) == 0, what
            assert not capsys.readouterr().err


@pytest.mark.parametrize(
    "what", ["yaml", "closed loop", "validation", "comparison", "table", "certificate nested"]
)
def test_the_report_names_the_damaged_file(
    what: str, study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Files are read before it.
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    DAMAGES[what](study)
    names = {"closed loop": "closed_loop.mcap", "table": "runs.parquet", "yaml": "config.yaml"}
    said = one_sentence(["report", str(study)], capsys)
    assert names.get(what, what.split()[0]) in said


def test_a_certificate_that_lies_is_not_exported(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sealed anew, consistent in itself, and another gain than the one that was proved."""
    run = run_of(study)
    text = (run / "certificate.json").read_text()
    content = json.loads(text)
    part = content["state_feedback"]
    part["k"] = [[5 * number for number in row] for row in part["k"]]
    part["digest"] = certificate_digest(part)
    text = json.dumps(content)
    (run / "certificate.json").write_text(text)
    write_run_manifest(run)
    record = read_record(run) or {}
    write_record(run, record)
    out_path = str(study / "out")
    said = one_sentence(["export", str(run), "--to", out_path], capsys)
    assert "certificate.state_feedback" in said
    assert not (study / "out").exists()


@pytest.fixture
def read_only(study: Path) -> Iterator[Path]:
    (study / "runs.parquet").unlink()
    for words in (["--bind", str(study), str(study)], ["-o", "remount,bind,ro", str(study)]):
        returncode = subprocess.run(["mount", *words], capture_output=True).returncode
        if returncode != 0:
            pytest.skip("mounting a folder read-only needs more rights")
    yield study
    subprocess.run(["umount", "-l", str(study)], check=True)


def test_a_folder_that_may_only_be_read(
    read_only: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(read_only)
    out_path = str(read_only / "out")
    status = main(["show", str(read_only)])
    assert status == 0, "a table can be looked at without being written"
    capsys.readouterr()
    for words in (["gather"], ["report"], ["export", "--to", out_path]):
        of = run if words[0] == "export" else read_only
        assert (
            "ead-only" in one_sentence([words[0], str(of), *words[1:]], capsys)
            or words[0] == "report"
        )
