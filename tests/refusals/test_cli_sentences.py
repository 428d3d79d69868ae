"""Requests that were accepted, or answered with a traceback, are answered with one sentence."""

import errno
import sys
import tomllib
from datetime import timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ssm_study as st
from ssm_study.api.fitting import convert_to_seconds
from ssm_study.api.linearisation import import_python_control
from ssm_study.api.parts import format_setting_value
from ssm_study.cli.main import WRONG_REQUEST, main
from ssm_study.cli.run import run
from ssm_study.data.arrays import index_period_s
from ssm_study.data.plain_names import plain_name
from ssm_study.refusal import BadRequest

WRONG = {
    "a seed of 5,000 digits": (["seed=" + "1" * 5000], "thousands of digits"),
    "a list for progress": (["progress=[[1]]"], "progress = [[1]]: is neither true nor false"),
    "a number for strict": (["strict=-1"], "strict = -1: is neither true nor false"),
    "a number for dry_run": (["dry_run=0"], "dry_run = 0: is neither true nor false"),
    "nothing for a plant": (["plant={}"], "plant = {}: has no effect"),
    "a list for a number": (["plant.step_s=[]"], " = []: is not a number"),
    "numbers for a group": (["loop=[1,[2,[3]]]"], "is no name of a choice"),
    "a choice of a sweep beside a key that is not there": (
        ["data=choice(1,2)", "seed.x=1"],
        "seed.x",
    ),
    "a pattern beside a key that is not there": (
        ["training/optimiser=glob(*)", "seed.x=1"],
        "seed.x",
    ),
    "the last word of two settings": (
        ["rate=0.1"],
        "did you mean synthesis.rate_controller or synthesis.rate_observer?",
    ),
    "a misspelt setting": (["model.ordr=2"], "did you mean model.order?"),
    "nothing for a part of one": (["model.scaffold_in={}"], "has no effect"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("many", [False, True])
def test_a_request_that_means_nothing_is_refused(
    case: str, many: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, sentence = WRONG[case]
    results = tmp_path / "results"
    place = ["experiment=smoke", f"results_dir={results}"]
    assert main(["run", *words, *place, *(["-m"] if many else [])]) == WRONG_REQUEST
    answer = capsys.readouterr().err
    assert answer.count("\n") == 1
    assert sentence in answer
    assert not results.exists()


def test_a_column_that_is_named_twice_is_refused_before_any_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was a failed run."""
    log = tmp_path / "log.csv"
    rng = np.random.default_rng(0)
    columns = ["u", "y"]
    table = pd.DataFrame(rng.normal(size=(400, 2)), columns=columns)
    table.to_csv(log, index=False)
    words = ["data=recorded", f"data.path={log}", "data.output=y", "data.step_s=0.1"]
    results = tmp_path / "results"
    assert main(["run", *words, "data.input=[u,u]", f"results_dir={results}"]) == WRONG_REQUEST
    assert "the same column twice" in capsys.readouterr().err
    assert not results.exists()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None, "often", 0.0, -1.0, [0.1]])
def test_what_is_no_sampling_time_is_refused(value: object) -> None:
    with pytest.raises(BadRequest, match="step_s"):
        convert_to_seconds(value)


def test_a_fit_without_a_sampling_time_takes_that_of_the_index_or_refuses() -> None:
    """It was Python's own TypeError; the estimator took one second."""
    for fit in (st.fit, st.Estimator().fit):
        with pytest.raises(BadRequest, match=r"step_s = None: is not given, and u has no index"):
            fit(np.ones(100), np.ones(100))
    index = pd.timedelta_range("0s", periods=100, freq="100ms")
    u = pd.Series(np.sin(np.arange(100)), index)
    assert index_period_s(u) == 0.1
    assert index_period_s([u, u]) == 0.1
    assert index_period_s(u.reset_index(drop=True)) is None


@pytest.mark.parametrize(
    "value", [0.1, np.float64(0.1), pd.Timedelta("100ms"), timedelta(milliseconds=100)]
)
def test_a_time_difference_is_a_sampling_time(value: object) -> None:
    assert convert_to_seconds(value) == 0.1


TEXTS = ["a\\b", "a\\", "it's", "a\\'b", "\\\\server\\share", "a b", "", "[x]", "\\\\'", "'\\"]


def test_texts_from_python_arrive_as_they_are() -> None:
    """Every backslash was doubled: a folder of another name was made."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parser = OverridesParser.create()
    override = parser.parse_override(f"key={format_setting_value(TEXTS)}")
    assert override.value() == TEXTS


NAMES = {
    "Motor voltage (V)": "Motor_voltage_V",
    "ω [°/s]": "omega_deg_s",
    "φ": "phi",
    "Ω": "Omega",
    "ς": "sigma",
    "ü": "u",
    "Außen": "Aussen",
    "!": "signal",
}


@pytest.mark.parametrize("column", NAMES)
def test_greek_names_stay_apart(column: str) -> None:
    """All were folded to one: `ω [°/s]` became `s`."""
    assert plain_name(column) == NAMES[column]


def test_python_control_is_asked_for_by_the_name_of_its_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """`to_control` ended in an ImportError."""
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(BadRequest, match=r"pip install 'ssm-study\[export\]'"):
        import_python_control("to_control")


def test_an_error_that_nobody_foresaw_asks_for_a_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: list[str]) -> int:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("ssm_study.cli.run.run", broken)
    assert main(["run"]) == WRONG_REQUEST
    answer = capsys.readouterr().err
    assert "Unexpected error (a bug in ssm-study, please report it): ZeroDivisionError" in answer
    assert answer.count("\n") == 1


def test_a_disk_that_fills_during_a_run_is_blamed_on_the_results_folder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fill(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("ssm_study.cli.run.execute_request", fill)
    with pytest.raises(BadRequest, match="results_dir = full: No space left on device"):
        run(["experiment=smoke", "results_dir=full"])


def test_the_systems_that_it_runs_on_are_named_alike_everywhere() -> None:
    parents = Path(__file__).resolve().parents
    root = parents[2]
    text = (root / "pyproject.toml").read_text()
    content = tomllib.loads(text)
    project = content["project"]
    classifiers = project["classifiers"]
    systems = {
        name.rpartition(" :: ")[2] for name in classifiers if name.startswith("Operating System")
    }
    assert systems == {"Linux", "MacOS"}
    text = (root / "README.md").read_text()
    assert "Linux, macOS, and WSL on Windows" in text
