"""One line that each command prints of its work, which others do."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ssm_study.cli import commands
from ssm_study.cli.parser import build_parser

PARTS = SimpleNamespace


def run_command(words: str, function: Any) -> None:
    """Run the function of a command with its parsed options."""
    options = build_parser().parse_args(words.split())
    function(options)


def test_gathering_reads_all_runs_anew_and_warns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gathered: list[tuple[Path, bool]] = []

    def gather(study: Path, anew: bool) -> list[int]:
        gathered.append((study, anew))
        return [1, 2, 3]

    monkeypatch.setattr("ssm_study.table.gather.gather", gather)
    monkeypatch.setattr("ssm_study.table.doubts.row_count_warnings", lambda *_: ["one is missing"])
    run_command("gather s", commands.gather_study_table)
    assert gathered == [(Path("s"), True)]
    assert capsys.readouterr().out == "3 runs in s/runs.parquet\none is missing\n"


def test_what_was_written_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        commands, "write_study_template", lambda folder: [folder / "a", folder / "b"]
    )
    run_command("new f", commands.write_new_study)
    monkeypatch.setattr(
        "ssm_study.table.one_recording.export_closed_loop_recordings", lambda study: study / "c"
    )
    run_command("export-mcap s", commands.export_recordings)
    monkeypatch.setattr("ssm_study.table.mlflow.export_mlflow", lambda *_: 4)
    run_command("export-mlflow s", commands.export_to_mlflow)
    assert capsys.readouterr().out == "f/a\nf/b\ns/c\n4 runs written\n"


class Server:
    """Server that serves once and notes it."""

    def __init__(self) -> None:
        self.events: list[str] = []

    def __enter__(self) -> "Server":
        return self

    def __exit__(self, *_: object) -> None:
        self.events.append("closed")

    def serve_forever(self) -> None:
        self.events.append("served")


def test_a_watched_page_is_served_at_the_printed_address(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    server = Server()

    def start_server(study: Path, port: int, announce: Any) -> Server:
        announce(f"{study} at {port}")
        return server

    monkeypatch.setattr("ssm_study.report.page.live.start_server", start_server)
    run_command("watch s --port 0", commands.serve_study_page)
    assert capsys.readouterr().out == "s at 0\n"
    assert server.events == ["served", "closed"]


@pytest.mark.parametrize(("is_terminal", "words"), [(True, "drawing the figures"), (False, "")])
def test_drawing_is_announced_on_a_terminal(
    is_terminal: bool, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []
    stream = PARTS(isatty=lambda: is_terminal, write=written.append, flush=lambda: None)
    monkeypatch.setattr("sys.stderr", stream)
    commands.announce_drawing()
    text = "".join(written)
    assert text.startswith(words)
    assert bool(text) is is_terminal


HEADERS: list[tuple[str, str, list[str]]] = []
HEADERS.append(("No set points: a map couples channels.", '{"stable_count": 3}', ["No set points"]))
HEADERS.append(("To set points r:", '{"stable_count": 0}', []))
HEADERS.append(("To set points r:", "{}", ["Not tried"]))


@pytest.mark.parametrize(("header", "record", "beginnings"), HEADERS)
def test_an_export_warns_of_what_it_lacks(
    header: str, record: str, beginnings: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "motor.h"
    path.write_text(header)
    (tmp_path / "record.json").write_text(record)
    warnings = commands.export_warnings(tmp_path, path)
    assert len(warnings) == len(beginnings)
    assert all(map(str.startswith, warnings, beginnings))
    (tmp_path / "record.json").unlink()
    without_record = commands.export_warnings(tmp_path, path)
    assert not any(warning.startswith("Not tried") for warning in without_record)
