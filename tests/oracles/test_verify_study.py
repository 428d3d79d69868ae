"""`verify STUDY`: a line for each run, one for the gathered tables, a summary and exit status."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from ssm_study.cli.main import main
from ssm_study.engine.records import read_record, write_record
from ssm_study.engine.runs import write_failure
from ssm_study.engine.store import MANIFEST
from ssm_study.refusal import BadRequest
from ssm_study.study.verify import verify
from ssm_study.table.gather import CSV, PARQUET, gather, table_file_defects

FAILED_RUN = "failed-run-0"
pytestmark = pytest.mark.usefixtures("made_once")


@pytest.fixture
def study(smoke_run: Path, tmp_path: Path) -> Path:
    """A gathered study of one finished run and one that failed."""
    folder = tmp_path / "smoke"
    shutil.copytree(smoke_run, folder / smoke_run.name)
    failed = folder / FAILED_RUN
    failed.mkdir()
    write_record(failed, {"status": "failed", "error_message": "RuntimeError: no memory"})
    gather(folder)
    return folder


def output_lines(study: Path, capsys: pytest.CaptureFixture[str], status: int) -> list[str]:
    """Lines that the command prints about a study; checks its exit status."""
    assert main(["verify", str(study)]) == status
    return capsys.readouterr().out.splitlines()


def test_each_run_has_a_line_and_the_summary_counts(
    study: Path, smoke_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    failed, finished, tables, summary = output_lines(study, capsys, status=0)
    assert failed.startswith(f"nothing  {FAILED_RUN}: the run failed and claims nothing; see ")
    assert finished.startswith(f"holds    {smoke_run.name}: ")
    assert "claims hold" in finished
    assert tables == f"holds  {PARQUET}, {CSV}: as the records of the runs say"
    assert summary == f"2 runs: 1 holds, 1 claims nothing ({FAILED_RUN})"


def test_a_claim_that_does_not_hold_is_named_with_its_run(
    study: Path, smoke_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = study / smoke_run.name / "model.json"
    model.write_text(model.read_text() + "\n")
    _, finished, cause, _, summary = output_lines(study, capsys, status=1)
    assert finished.startswith(f"FAILS    {smoke_run.name}: ")
    assert cause == "  FAILS  files: changed since: model.json"
    assert f"1 does not ({smoke_run.name})" in summary


@pytest.mark.parametrize("status", ["failed", "running"])
def test_a_finished_run_that_is_called_failed_or_unfinished_is_named(
    status: str, study: Path, smoke_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The duration tells it, also where the seal was taken away."""
    run = study / smoke_run.name
    record = (read_record(run) or {}) | {"status": status, "error_message": "no memory"}
    write_record(run, record)
    (run / MANIFEST).unlink()
    _, finished, cause, _, summary = output_lines(study, capsys, status=1)
    assert finished == f"FAILS    {run.name}: 0 of 1 claims hold; 0 not checked"
    word = "lost" if status == "running" else status
    assert (
        cause == f"  FAILS  status: stored {word}, yet record.json gives the duration of a "
        "finished run"
    )
    assert f"1 does not ({run.name})" in summary


def test_a_failed_run_with_the_seal_of_a_finished_one_is_named(study: Path) -> None:
    failed = study / FAILED_RUN
    (failed / MANIFEST).write_text("{}")
    (finding,) = verify(failed)
    assert str(finding) == (
        "FAILS  status: stored failed, yet manifest.json seals the files of a finished run"
    )
    write_failure(failed, {}, {"error_message": "no space"}, text="")
    with pytest.raises(BadRequest, match="the run failed and claims nothing"):
        verify(failed)


def test_json_gives_each_run(
    study: Path, smoke_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(study), "--json"]) == 0
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["holds"] is True
    assert verdict["runs"][smoke_run.name]["holds"] is True
    assert verdict["runs"][FAILED_RUN]["holds"] is None
    assert verdict["tables"]["holds"] is True


def test_a_study_without_results_is_refused(
    study: Path, smoke_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(study / smoke_run.name)
    shutil.copytree(study / FAILED_RUN, study / "failed-run-1")
    assert main(["verify", str(study)]) == 2
    assert "none of its 2 runs has results" in capsys.readouterr().err


def test_an_edited_table_is_named(study: Path, smoke_run: Path) -> None:
    table = pd.read_parquet(study / PARQUET, dtype_backend="numpy_nullable")
    table.loc[table["run"] == smoke_run.name, "fit_test_percent"] = 99.9
    table.to_parquet(study / PARQUET, index=False)
    differs, csv = table_file_defects(study)
    assert differs == f"{PARQUET} differs from the record of {smoke_run.name}"
    assert csv == f"{CSV} differs from {PARQUET}"
    gather(study, anew=True)
    assert table_file_defects(study) == []
    (study / CSV).write_text((study / CSV).read_text().replace("failed", "ok"))
    assert table_file_defects(study) == [f"{CSV} differs from {PARQUET}"]
    (study / PARQUET).write_bytes(b"no table")
    (problem,) = table_file_defects(study)
    assert problem.startswith(f"{PARQUET} cannot be read")


def test_a_removed_run_is_named_by_its_row(study: Path, smoke_run: Path) -> None:
    shutil.rmtree(study / smoke_run.name)
    assert table_file_defects(study) == [f"{PARQUET} differs from the record of {smoke_run.name}"]
