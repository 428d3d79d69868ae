"""Options of every command, and what each command hands on and prints; nothing is computed."""

import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ssm_study.cli import commands, main
from ssm_study.cli.exit_status import DONE, SOME_FAILED, error_as_bad_request
from ssm_study.cli.parser import ACTIONS, FIGURES, SUBJECTS, build_parser
from ssm_study.refusal import BadRequest

PARTS = SimpleNamespace
DEFAULTS: dict[str, dict[str, Any]] = {}
DEFAULTS["gather s"] = {}
DEFAULTS["show s"] = {"by": None, "where": None, "columns": False, "cost": False}
DEFAULTS["verify r"] = {"json": False, "verbose": False}
DEFAULTS["refine r"] = {"record": None, "times": 4}
DEFAULTS["reproduce r"] = {}
DEFAULTS["export r --to d"] = {"real": "double", "yes": False, "prefix": "controller"}
DEFAULTS["report s"] = {"others": [], "only": None, "open": False, "width": None, "verbose": False}
DEFAULTS["watch s"] = {"port": 8420}
DEFAULTS["export-mcap s"] = {}
DEFAULTS["export-mlflow s"] = {"store": None}
GIVEN: dict[str, dict[str, Any]] = {}
GIVEN["show s --columns --cost --by a"] = {"columns": True, "cost": True, "by": "a"}
GIVEN["verify r --json -v"] = {"json": True, "verbose": True}
GIVEN["export r --to d --yes --real float"] = {"yes": True, "real": "float", "to": Path("d")}
GIVEN["report s t u --only a --only b --open -v"] = {
    "others": [Path("t"), Path("u")],
    "only": ["a", "b"],
    "open": True,
    "verbose": True,
}
GIVEN["look f --header false"] = {"header": "false", "file": Path("f")}
GIVEN["excite --to f --step-s 0.1"] = {"step_s": 0.1, "seed": 0, "after": None, "lower": None}


@pytest.mark.parametrize(("words", "expected"), (DEFAULTS | GIVEN).items())
def test_options_have_their_defaults_and_values(words: str, expected: dict[str, Any]) -> None:
    options = vars(build_parser().parse_args(words.split()))
    chosen = {name: options[name] for name in expected}
    assert chosen == expected


def test_every_action_has_its_defaults_listed_and_a_subject() -> None:
    listed = {words.split()[0] for words in DEFAULTS}
    assert set(ACTIONS) == listed
    expected = set(SUBJECTS)
    actual = {action.subject for action in ACTIONS.values()}
    assert actual == expected
    assert sorted(FIGURES) == FIGURES
    assert not [name for name in FIGURES if name.startswith("_")]


REFUSED = ["", "export r", "excite", "new", "show", "report s --width wide", "look f --header 1"]


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_needed_is_not_left_out(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args(words.split())
    assert ended.value.code == 2
    assert "usage: ssm-study" in capsys.readouterr().err


def test_the_help_of_run_is_not_the_parser_s() -> None:
    """`run --help` belongs to Hydra, so its parser takes no option."""
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args(["run", "--help"])
    assert ended.value.code == 2


# What a command hands on.

Calls = list[tuple[Any, ...]]


def note_calls(monkeypatch: pytest.MonkeyPatch, place: str, result: Any = None) -> Calls:
    """Replace a function by one that notes its arguments and returns the result."""
    calls: Calls = []

    def noted(*values: Any, **named: Any) -> Any:
        calls.append((*values, named) if named else values)
        return result

    monkeypatch.setattr(place, noted)
    return calls


def options_of(words: str) -> Namespace:
    """Parsed options of a command."""
    return build_parser().parse_args(words.split())


VERDICTS = [(True, "", DONE), (False, "", SOME_FAILED), (True, "-v", DONE), (True, "--json", DONE)]


@pytest.mark.parametrize(("holds", "option", "status"), VERDICTS)
def test_the_verdict_is_printed_with_its_hint_and_status(
    holds: bool,
    option: str,
    status: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def lines(every_claim: bool) -> list[str]:
        return ["claim", "verdict"] if every_claim else ["verdict"]

    verified = PARTS(holds=holds, lines=lines, to_json=lambda: "{}")
    note_calls(monkeypatch, "ssm_study.study.verify.verify", verified)
    options = options_of(f"verify r {option}")
    assert commands.verify_run(options.study_or_run, options) == status
    expected = {"": "verdict (-v lists every claim)\n", "-v": "claim\nverdict\n", "--json": "{}\n"}
    expected = expected[option]
    actual = capsys.readouterr().out
    assert actual == expected


@pytest.mark.parametrize(("agrees", "status"), [(True, DONE), (False, SOME_FAILED)])
def test_a_repeated_run_that_differs_ends_with_one(
    agrees: bool, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = (["a", "b"], agrees)
    note_calls(monkeypatch, "ssm_study.study.reproduce.reproduce", result)
    options = options_of("reproduce r")
    actual = commands.reproduce_run(options)
    assert actual == status
    assert capsys.readouterr().out == "a\nb\n"


CONFIGURATIONS = [([None], False, DONE), (["c", None], True, SOME_FAILED), (["c"], False, DONE)]


@pytest.mark.parametrize(("configurations", "failed", "status"), CONFIGURATIONS)
def test_the_last_refined_run_is_summarised(
    configurations: list[Any], failed: bool, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = [PARTS(said="step", config=config) for config in configurations]
    refined = note_calls(monkeypatch, "ssm_study.study.refine.refine_controller", steps)
    summarised = note_calls(monkeypatch, "ssm_study.cli.summary.print_run_summary", failed)
    options = options_of("refine r --times 1 --record log")
    assert commands.refine_run(options) == status
    expected = [(Path("r"), Path("log"), 1)]
    assert refined == expected
    expected = [(config,) for config in configurations if config]
    assert summarised == expected


@pytest.mark.parametrize("words", ["--by a", "--where a", "--columns", "--cost"])
def test_options_of_a_table_are_refused_for_one_run(words: str) -> None:
    options = options_of(f"show r {words}")
    with pytest.raises(BadRequest, match="is for a study, not for one run"):
        commands.show_run(options)


def test_a_run_and_a_study_are_shown_in_their_own_ways(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = note_calls(monkeypatch, "ssm_study.table.show.show_table")
    records = note_calls(monkeypatch, "ssm_study.report.run_record.print_run")
    options = options_of(f"show {tmp_path} --by a --where b --cost")
    commands.show_study_or_run(options)
    settings = {"by": "a", "where": "b", "cost": True, "columns": False}
    assert tables == [(tmp_path, settings)]
    (tmp_path / "record.json").touch()
    options = options_of(f"show {tmp_path}")
    commands.show_study_or_run(options)
    assert len(records) == 1
    assert len(tables) == 1


HEADERS = [("", None), ("--header true", True), ("--header false", False)]


@pytest.mark.parametrize(("option", "header"), HEADERS)
def test_a_log_is_drawn_if_it_has_records(
    option: str,
    header: bool | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    saved: list[tuple[Path, int]] = []
    figure = PARTS(savefig=lambda path, dpi: saved.append((path, dpi)))
    log = PARTS(records=())
    looked = note_calls(monkeypatch, "ssm_study.data.look.look", log)
    drawn = note_calls(monkeypatch, "ssm_study.report.figure_of_a_log.draw_log", figure)
    options = options_of(f"look a/log.csv {option}")
    commands.describe_log(options)
    settings = looked[0][1]["settings"]
    assert settings.header is header
    assert drawn == []
    log.records = (1,)
    commands.describe_log(options)
    expected = [(Path("log_look.png"), 150)]
    assert saved == expected
    assert capsys.readouterr().out.endswith("log_look.png\n")
    options = options_of("look a/log.csv --picture p.png")
    commands.describe_log(options)
    last = saved[-1][0]
    assert last == Path("p.png")


def test_a_signal_needs_what_no_earlier_run_gives() -> None:
    complete = "excite --to f --lower 0 --upper 1 --rest 0 --step-s 0.1"
    options = options_of(complete)
    with pytest.raises(BadRequest, match="--settle-s = not given: it is needed when no earlier"):
        commands.write_excitation(options)


def test_an_earlier_run_s_settings_give_way_to_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = PARTS(next_excitation_settings={"lower": -2.0, "upper": 2.0}, sine_frequencies=(0.1,))
    note_calls(monkeypatch, "ssm_study.study.run_files.RunFiles", run)
    note_calls(monkeypatch, "ssm_study.table.folders.find_run_folder", tmp_path)
    options = options_of("excite --to f --after r --lower -1")
    settings = commands.excitation_settings(options)
    assert settings["lower"] == -1.0
    assert settings["upper"] == 2.0
    assert settings["sines"] == (0.1,)
    options = options_of("excite --to f --lower -1")
    alone = commands.excitation_settings(options)
    assert "sines" not in alone
    assert "upper" not in alone


def test_a_folder_of_a_saved_design_is_taken_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = note_calls(monkeypatch, "ssm_study.table.folders.find_run_folder", tmp_path / "found")
    (tmp_path / commands.DESIGN_CHANNELS).touch()
    given: list[Path] = []

    def action(options: Namespace) -> int:
        given.append(options.run)
        return DONE

    options = Namespace(run=tmp_path)
    commands.run_command_on_folder(action, "run", options)
    monkeypatch.setattr(commands, "OF_A_DESIGN", (action,))
    commands.run_command_on_folder(action, "run", Namespace(run=tmp_path))
    commands.run_command_on_folder(action, "run", Namespace(run=tmp_path / "other"))
    expected = [tmp_path / "found", tmp_path, tmp_path / "found"]
    assert given == expected
    assert len(found) == 2


def test_an_export_says_what_it_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    verified = PARTS(require_valid=lambda *_: None)
    note_calls(monkeypatch, "ssm_study.study.verify.verify", verified)
    written = note_calls(monkeypatch, "ssm_study.export.targets.write_controller", ["one", "two"])
    note_calls(monkeypatch, "ssm_study.cli.commands.export_warnings", ["careful"])
    design = note_calls(monkeypatch, "ssm_study.cli.commands.export_rest_design", ["rest.h"])
    words = f"export {tmp_path} --to {tmp_path / 'to'} --prefix motor"
    options = options_of(words)
    commands.export_controller(options)
    assert capsys.readouterr().out == "one\ntwo\ncareful\n"
    names = {"real": "double", "prefix": "motor"}
    expected = [(tmp_path, tmp_path / "to", names)]
    assert written == expected
    assert design == []
    (tmp_path / commands.DESIGN_CHANNELS).touch()
    options = options_of(words)
    commands.export_controller(options)
    assert capsys.readouterr().out == "rest.h\ncareful\n"


def test_more_than_four_earlier_files_are_abbreviated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("builtins.input", lambda text: asked.append(text) or " YES ")
    monkeypatch.setattr(sys, "stdin", PARTS(isatty=lambda: True))
    (tmp_path / "notes.txt").touch()
    assert commands.confirm_overwriting(tmp_path)
    assert asked == []
    for name in "abcd":
        (tmp_path / f"{name}.h").touch()
    assert commands.confirm_overwriting(tmp_path)
    assert asked[0].endswith("holds a.h, b.h, c.h, d.h: overwrite? [y/N] ")
    (tmp_path / "e.onnx").touch()
    commands.confirm_overwriting(tmp_path)
    assert asked[1].endswith("holds a.h, b.h, c.h, d.h ...: overwrite? [y/N] ")


def test_a_page_is_opened_and_figures_drawn_where_they_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pages = note_calls(monkeypatch, "ssm_study.report.page.writing.write_page", tmp_path / "p")
    drawn = note_calls(monkeypatch, "ssm_study.report.figures.draw_figures", [])
    opened = note_calls(monkeypatch, "ssm_study.cli.commands.open_page")
    options = options_of(f"report {tmp_path} --open")
    commands.write_study_report(options)
    expected = [(tmp_path / "p",)]
    assert opened == expected
    first = drawn[0]
    assert first[0] is None
    expected = {"width": "page"}
    assert first[-1] == expected
    options = options_of(f"report {tmp_path} other --width column")
    commands.write_study_report(options)
    expected = (tmp_path, (Path("other"),))
    assert pages[-1] == expected
    assert len(drawn) == 1, "of several studies there are no figures"
    assert len(opened) == 1
    options = options_of(f"report {tmp_path} --width column")
    commands.write_study_report(options)
    second = drawn[1]
    assert second[0] == commands.PAPER_FIGURES
    expected = {"width": "column"}
    assert second[-1] == expected
    options = options_of(f"report {tmp_path} --only closed_loop")
    commands.write_study_report(options)
    assert len(pages) == 3
    third = drawn[2]
    assert third[0] == ["closed_loop"]
    assert "drawing the figures" not in capsys.readouterr().err


LEFT_OUT = {
    0: "2 figures in figures; -v lists them",
    3: "2 figures in figures, 3 not drawn (they need other runs or settings); -v lists them",
}


@pytest.mark.parametrize(("left_out", "line"), LEFT_OUT.items())
def test_a_figure_in_two_formats_counts_once(left_out: int, line: str) -> None:
    names = ("one.png", "one.pdf", "two.png")
    paths = [Path("figures", name) for name in names]
    actual = commands.drawn_figures_text(paths, left_out)
    assert actual == line
    actual = commands.drawn_figures_text([], left_out)
    assert actual == "no figure drawn; -v says why"


def test_a_command_that_returns_nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    def ends_with(status: int | None) -> Callable[[], Any]:
        options = PARTS(command=lambda _: status)
        return lambda: PARTS(parse_args=lambda _: options)

    for status, expected in ((None, DONE), (SOME_FAILED, SOME_FAILED)):
        parser = ends_with(status)
        monkeypatch.setattr(main, "build_parser", parser)
        actual = main.main(["show", "s"])
        assert actual == expected


def raise_error(error: BaseException) -> Callable[[], Any]:
    """Parser whose command raises an error."""

    def command(_: Any) -> None:
        raise error

    return lambda: PARTS(parse_args=lambda _: PARTS(command=command))


def test_a_traceback_is_shown_of_a_defect_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSM_STUDY_TRACEBACK", "1")
    for error in (OSError("full"), BadRequest("a", 1, "b", "c")):
        parser = raise_error(error)
        monkeypatch.setattr(main, "build_parser", parser)
        expected = main.WRONG_REQUEST
        actual = main.main(["show", "s"])
        assert actual == expected
    parser = raise_error(KeyError("x"))
    monkeypatch.setattr(main, "build_parser", parser)
    with pytest.raises(KeyError):
        main.main(["show", "s"])
    monkeypatch.delenv("SSM_STUDY_TRACEBACK")
    expected = main.WRONG_REQUEST
    actual = main.main(["show", "s"])
    assert actual == expected


def test_an_error_of_a_file_names_it_and_a_defect_is_cut() -> None:
    lost = error_as_bad_request(FileNotFoundError(2, "gone", "a.csv"), ["show", "s"])
    expected = ("file", "a.csv", "gone")
    actual = (lost.field, lost.value, lost.problem)
    assert actual == expected
    full = error_as_bad_request(OSError(28, "no space"), ["show", "s"])
    expected = ("command", "show s")
    actual = (full.field, full.value)
    assert actual == expected
    request = BadRequest("a", 1, "b", "c")
    assert error_as_bad_request(request, []) is request
    defect = error_as_bad_request(KeyError("z" * 400), ["show", "s"])
    count = defect.problem.count("z")
    assert count == 299
