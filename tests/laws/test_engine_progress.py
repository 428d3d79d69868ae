"""One line says how far a sweep is, whoever runs it."""

import sys
from pathlib import Path

import pytest

from ssm_study.engine.progress import Progress, ProgressWatcher
from ssm_study.engine.records import write_record


def test_the_line_counts_and_foresees(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(total=10) as progress:
        assert progress.seconds_left() is None
        for status, reused in (
            ("ok", True),
            ("ok", False),
            ("infeasible", False),
            ("failed", False),
        ):
            progress.count_outcome(status, reused)
        progress.update_running_jobs(running=2)
        progress.started -= 30.0  # three fresh runs in half a minute, six to go
        assert progress.seconds_left() == pytest.approx(60, abs=1)
        assert (
            progress.progress_line()
            == "4/10 runs: 2 ok, 1 infeasible, 1 failed; 1 there before; 2 running; 1:00 left"
        )
    assert "4/10 runs" in capsys.readouterr().err


@pytest.mark.parametrize("is_terminal", [True, False])
def test_one_line_changes_on_a_terminal_alone(
    monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    changing_line = Progress(total=1).live
    assert (changing_line is not None) is is_terminal


def test_a_watch_reads_the_run_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [tmp_path / name for name in "abcd"]
    for folder in folders[:2]:
        folder.mkdir()
    record = {"status": "ok"}
    write_record(folders[0], record)
    record = {"status": "running"}
    write_record(folders[1], record)
    with ProgressWatcher([*folders, folders[0]], every_s=0.01) as watch:
        record = {"status": "failed"}
        write_record(folders[1], record)
    assert not watch.is_alive()
    assert "2/4 runs: 1 ok, 0 infeasible, 1 failed; 1 there before" in capsys.readouterr().err
