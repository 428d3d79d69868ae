"""The terminal's offers: defaults, names by a part, questions, the page, progress."""

import io
import re
import sys
import webbrowser
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf.errors import ConfigKeyError
from report_runs import random_run, write_recordings
from rich.console import Console

from ssm_study import style
from ssm_study.cli import commands
from ssm_study.cli.browser import open_page, page_link
from ssm_study.cli.commands import confirm_overwriting, drawn_figures_text, export_warnings
from ssm_study.cli.hydra_errors import explain_hydra_error
from ssm_study.cli.main import DONE, WRONG_REQUEST, main
from ssm_study.cli.request import translate_arguments
from ssm_study.cli.run import print_activity, run
from ssm_study.cli.summary import print_run_summary
from ssm_study.durable import file_lock
from ssm_study.engine.records import LOCK, write_record
from ssm_study.engine.runs import Run
from ssm_study.engine.task import RunStages
from ssm_study.extensions import configuration_folder
from ssm_study.refusal import BadRequest
from ssm_study.report.figures import closed_loop_responses
from ssm_study.report.run_record import print_run
from ssm_study.report.study_folder import RunFolder
from ssm_study.table.folders import find_run_folder


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_help_marks_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--help"]) == DONE
    text = capsys.readouterr().out
    assert "dc_motor*, " in text
    assert "simulated*" in text
    assert "riccati*" not in text


def test_a_run_is_named_by_the_begin_or_the_end_of_its_name(tmp_path: Path) -> None:
    for name in ("order4-seed0-aaa", "order4-seed1-bbb", "order8-seed0-ccc"):
        (tmp_path / name).mkdir()
        record = {"status": "ok"}
        write_record(tmp_path / name, record)
    folder = find_run_folder(tmp_path / "order8")
    assert folder.name == "order8-seed0-ccc"
    folder = find_run_folder(tmp_path / "order4-seed1")
    assert folder.name == "order4-seed1-bbb"
    folder = find_run_folder(tmp_path / "aaa")
    assert folder.name == "order4-seed0-aaa"
    with pytest.raises(BadRequest, match="2 runs are there"):
        find_run_folder(tmp_path / "order4")
    with pytest.raises(BadRequest, match="no record"):
        find_run_folder(tmp_path / "seed0")


def test_a_run_of_another_process_is_not_said_to_have_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its lock decides: once the process is gone, the run is lost and not running."""
    folder = tmp_path / "mine" / "order4"
    folder.mkdir(parents=True)
    write_record(folder, {"status": "running", "run": "order4", "study": "mine"})
    names = {"results_dir": str(tmp_path), "study": "mine", "run": "order4", "strict": False}
    config: Any = SimpleNamespace(**names)
    console = Console(width=200)
    with file_lock(folder / LOCK) as is_held:
        assert is_held
        assert print_run_summary(config)
        print_run(folder, console)
    printed = capsys.readouterr().out
    assert printed.startswith("mine/order4: another process is at this run")
    assert "running: a process is at this run" in printed
    assert "failed" not in printed
    print_run(folder, console)
    assert "lost: the run was stopped before its end" in capsys.readouterr().out


@pytest.mark.parametrize(("answer", "expected"), [("y", True), ("yes", True), ("", False)])
def test_an_export_asks_before_it_overwrites(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, expected: bool
) -> None:
    questions: list[str] = []
    monkeypatch.setattr("builtins.input", lambda text: questions.append(text) or answer)
    assert confirm_overwriting(tmp_path / "new")
    (tmp_path / "controller.h").touch()
    assert confirm_overwriting(tmp_path), "without a terminal nobody can be asked"
    monkeypatch.setattr(sys, "stdin", Terminal())
    assert confirm_overwriting(tmp_path) is expected
    assert len(questions) == 1
    assert "controller.h" in questions[0]


def test_show_prints_one_run_by_its_first_digits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("order4-seed0-1a2b3c4d5e", "order4-seed1-9f8e7d6c5b"):
        record = {"status": "ok", "run": name, "resolved_margin": 0.99996, "pid": 7}
        (tmp_path / name).mkdir()
        write_record(tmp_path / name, record | {"fit_test_percent": None})
    assert main(["show", str(tmp_path / "1a2b")]) == DONE
    printed = capsys.readouterr().out
    assert "order4-seed0-1a2b3c4d5e" in printed
    assert re.search(r"Stability margin \(–\) +0.99996", printed), "not rounded across one"
    assert "Fit on test record" not in printed
    assert main(["show", str(tmp_path / "1a2b"), "--by", "seed"]) == WRONG_REQUEST
    assert "is for a study, not for one run" in capsys.readouterr().err


def test_what_is_not_confirmed_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "study" / "run"
    run = random_run(folder, kind="linear", channels=1, seed=0)
    record = {"status": "ok"}
    write_record(run, record)
    monkeypatch.setattr(
        "ssm_study.study.verify.verify", lambda _: type("V", (), {"require_valid": print})
    )
    monkeypatch.setattr(commands, "confirm_overwriting", lambda _: False)
    to_path = str(tmp_path / "to")
    assert main(["export", str(run), "--to", to_path]) == DONE
    assert "nothing written" in capsys.readouterr().out
    assert not (tmp_path / "to").exists()
    to_path = str(tmp_path / "to")
    assert main(["export", str(run), "--to", to_path, "--yes"]) == DONE
    controller_path = tmp_path / "to" / "controller.h"
    assert (controller_path).is_file()


def test_the_page_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr(webbrowser, "open", shown.append)
    open_page(tmp_path / "report.html")
    expected = [(tmp_path / "report.html").as_uri()]
    assert shown == expected
    arguments = ["seed=1", "--open"]
    assert translate_arguments(arguments) == ["seed=1"]


@pytest.mark.parametrize("words", [[], ["--open"]])
def test_the_page_of_a_run_is_opened_where_it_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    config = SimpleNamespace(dry_run=False)
    request = SimpleNamespace(execute=lambda _: None, config=config)
    opened: list[object] = []
    replaced: dict[str, Any] = {
        "compose_request": lambda *_: request,
        "check_jobs_before_start": lambda _: nullcontext(),
        "_task_function": lambda: None,
        "print_study_summary": lambda _: 0,
        "write_and_open_page": opened.append,
    }
    for name, function in replaced.items():
        monkeypatch.setattr(f"ssm_study.cli.run.{name}", function)
    assert run(["seed=3", *words]) == DONE
    assert opened == [request] * len(words)


def test_progress_is_a_line_a_stage_on_a_terminal_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    print_activity("reading the request")
    for announces in (True, False):
        root = tmp_path / f"{announces}"
        run = Run(path=root)
        stages = RunStages(root / ".store", run, announces)
        for _ in range(2):  # what is there already is not announced
            stages.stage_result("model", "a" * 64, {}, lambda folder: (folder / "x").touch())
        assert terminal.getvalue().count("model ...") == 1
    string_io = io.StringIO()
    monkeypatch.setattr(sys, "stderr", string_io)
    print_activity("reading the request")
    assert sys.stderr.getvalue() == ""  # type: ignore[attr-defined]


@pytest.mark.parametrize("word", ["synthesis=[[1]]", "plant=3", "model=true"])
def test_a_group_takes_the_name_of_a_choice(
    word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", word, f"results_dir={tmp_path / 'r'}"]) == WRONG_REQUEST
    answer = capsys.readouterr().err
    assert answer.count("\n") == 1
    assert "Unexpected" not in answer


def test_a_page_is_a_link_on_a_terminal_and_a_path_in_a_pipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "report.html"
    string_io = io.StringIO()
    monkeypatch.setattr(sys, "stdout", string_io)
    assert page_link(page) == str(page)
    monkeypatch.setattr(sys, "stdout", Terminal())
    assert page.as_uri() in page_link(page)
    assert page_link(page).count(str(page)) == 2, "as the address, and to be read"


def test_figures_are_counted_unless_they_are_asked_for(tmp_path: Path) -> None:
    kinds = ("png", "pdf")
    paths = [tmp_path / "figures" / f"nyquist.{kind}" for kind in kinds]
    line = drawn_figures_text(paths, left_out=2)
    why = "they need other runs or settings"
    assert line == f"1 figures in {tmp_path / 'figures'}, 2 not drawn ({why}); -v lists them"
    assert drawn_figures_text([], left_out=3) == "no figure drawn; -v says why"


def test_a_run_without_a_setting_says_what_it_does(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ssm_study.cli.run.compose_request", refuse_anything)
    for words, is_told in (([], True), (["seed=3"], False)):
        assert main(["run", *words]) == WRONG_REQUEST
        err = capsys.readouterr().err
        assert ("this is the paper's motor" in err) is is_told


def refuse_anything(*_: object) -> None:
    raise BadRequest("request", "none", "is not run in this test", "ask for nothing")


def test_in_a_column_panels_stand_one_below_the_other(tmp_path: Path) -> None:
    folder = tmp_path / "study" / "a"
    run = write_recordings(random_run(folder, kind="mlp", channels=1, seed=1))
    loop = RunFolder(path=run).closed_loop
    study = SimpleNamespace(read_from_best=lambda *_, **__: (loop,))
    widths = {}
    for width in ("page", "column"):
        with style.paper_style(width):
            size_inches = closed_loop_responses.draw(study).get_size_inches()
            widths[width] = size_inches[0]
    expected = {"page": style.PAGE_IN, "column": style.COLUMN_IN}
    assert widths == expected


def test_an_export_warns_of_what_its_run_has_not_tried(tmp_path: Path) -> None:
    header_path = tmp_path / "controller.h"
    header_path.write_text(" * Within limits, to rest. No set points: a map couples channels.\n")
    record_path = tmp_path / "record.json"
    record_path.write_text('{"stable_count": null}')
    warnings = export_warnings(tmp_path, header_path)
    assert warnings[0] == "No set points: a map couples channels."
    assert warnings[1].startswith("Not tried")
    header_path.write_text(" * Within limits, to set points r:\n")
    record_path.write_text('{"stable_count": 10}')
    assert export_warnings(tmp_path, header_path) == []


def test_a_key_that_is_not_there_is_named_with_its_place() -> None:
    """OmegaConf says the last name alone, and in a line of its own the whole key."""
    answer = "Key 'ordr' is not in struct"
    words = ["model.ordr=1,2"]
    alone = explain_hydra_error(ConfigKeyError(answer), words, configuration_folder())
    assert "Could not override 'ordr'" in str(alone)
    error = ConfigKeyError(f"{answer}\n    full_key: model.ordr\n    object_type=dict")
    placed = explain_hydra_error(error, words, configuration_folder())
    assert "Could not override 'model.ordr'" in str(placed)
    assert "did you mean model.order?" in str(placed)


def test_a_run_is_refined_once_or_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"status": "ok", "run": "a"}
    (tmp_path / "a").mkdir()
    write_record(tmp_path / "a", record)
    steps = [SimpleNamespace(said="refined", config=None)]
    monkeypatch.setattr("ssm_study.study.refine.refine_controller", lambda *_: iter(steps))
    words = ["refine", str(tmp_path / "a"), "--times"]
    assert main([*words, "1"]) == DONE
    assert capsys.readouterr().out == "refined\n"
    assert main([*words, "0"]) == WRONG_REQUEST
    assert "must be at least 1" in capsys.readouterr().err


REPORTS = [
    ([], False),
    (["-v"], True),
    (["--only", "closed_loop"], True),
    (["--width", "column"], True),
]


@pytest.mark.parametrize(("options", "is_listed"), REPORTS)
def test_figures_are_listed_where_they_were_asked_for(
    options: list[str],
    is_listed: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    record = {"status": "ok", "run": "a"}
    (tmp_path / "a").mkdir()
    write_record(tmp_path / "a", record)
    drawn = [tmp_path / "figures" / "one.png"]
    page = tmp_path / "report.html"
    monkeypatch.setattr("ssm_study.report.figures.draw_figures", lambda *_, **__: drawn)
    monkeypatch.setattr("ssm_study.report.page.writing.write_page", lambda *_: page)
    assert main(["report", str(tmp_path), *options]) == DONE
    lines = capsys.readouterr().out.splitlines()
    assert (lines[-1] == str(drawn[0])) is is_listed
    assert (lines[-1] == drawn_figures_text(drawn, 0)) is not is_listed
