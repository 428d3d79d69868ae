"""Damaged files, a full disk and a forged certificate end every command of the report in one
sentence."""

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from ssm_study.certificates.certificate import certificate_digest
from ssm_study.cli.main import main
from ssm_study.export.targets import describe_origin
from ssm_study.table import gather


@pytest.fixture
def study(smoke_study: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke_study, tmp_path / "smoke")


def run_of(study: Path) -> Path:
    (record,) = study.glob("*/record.json")
    return record.parent


def forged(study: Path) -> None:
    """A certificate with another gain that still says certified, its digest made anew."""
    path = run_of(study) / "certificate.json"
    text = path.read_text()
    content = json.loads(text)
    content["state_feedback"]["k"][0][0] *= 1.5
    content["state_feedback"]["digest"] = certificate_digest(content["state_feedback"])
    text = json.dumps(content)
    path.write_text(text)


def damage_table(study: Path) -> None:
    (study / "runs.parquet").write_bytes(b"PAR1")


def damage_model(study: Path) -> None:
    (run_of(study) / "model.json").write_text("{")


def damage_configuration(study: Path) -> None:
    (run_of(study) / ".hydra/config.yaml").write_text("a: [b")


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "table": (damage_table, "the table is damaged"),
    "model": (damage_model, "the file is damaged"),
    "yaml": (damage_configuration, "run the study again"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_damage_is_one_sentence(what: str, study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damage, message = DAMAGES[what]
    damage(study)
    arguments = ["report", str(study), "--only", "learned_dead_zone"]
    status = main(arguments)
    assert status == 2
    error = capsys.readouterr().err
    assert message in error
    lines = error.splitlines()
    assert len(lines) == 1


def test_a_forged_certificate_is_not_exported_as_one(study: Path) -> None:
    assert "certified for its model" in describe_origin(run_of(study))
    forged(study)
    assert "NOT certified" in describe_origin(run_of(study))


def test_a_full_disk_is_one_sentence(
    study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    def nameless(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    (study / "runs.csv").unlink()
    monkeypatch.setattr(gather, "write_atomically", full)
    arguments = ["gather", str(study)]
    status = main(arguments)
    assert status == 2
    assert "No space left on device" in capsys.readouterr().err
    show_arguments = ["show", str(study)]
    status_of_show = main(show_arguments)
    assert status_of_show == 0, "a table can be looked at without being written"
    assert "1 run: 1 ok" in capsys.readouterr().out
    monkeypatch.setattr(gather, "write_atomically", nameless)
    status_again = main(arguments)
    assert status_again == 2
    assert f"command = gather {str(study)[:40]}" in capsys.readouterr().err
