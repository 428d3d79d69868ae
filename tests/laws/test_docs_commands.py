"""Every command that README and docs show is executed, made short by the one rule in
`docs_commands.py`."""

import json
import runpy
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from docs_commands import (
    ELSEWHERE,
    FEW,
    ONE_FIGURE,
    ROOT,
    composed,
    every_command,
    files_to_write,
    maker,
    place,
    small,
    small_benchmark,
)
from docs_numbers import NEAR, table_on_page
from filelock import FileLock

import ssm_study.plants
import ssm_study.synthesis
from ssm_study import extensions
from ssm_study.cli import main as cli
from ssm_study.cli.parser import ACTIONS
from ssm_study.loop.peers import designs
from ssm_study.report import figures
from ssm_study.synthesis.auto import Auto

# Simple models beside that of a log are fitted in tests/oracles/test_models_narx.py.
pytestmark = pytest.mark.usefixtures("without_baselines")
COMMANDS = every_command()
ROOMS = {
    "ssm_study/plants": ssm_study.plants,
    "ssm_study/synthesis": ssm_study.synthesis,
    "ssm_study/report/figures": figures,
}


@pytest.fixture(scope="session")
def clone(shared_folder: Path, smoke_study: Path) -> Path:
    """One place with one store for all commands and workers: what two of them share is computed
    once."""
    folder = shared_folder / "clone"
    with FileLock(f"{folder}.lock"):
        if not (folder / "log.csv").exists():
            shutil.rmtree(folder, ignore_errors=True)
            place(folder)
            (folder / "results" / ".store").symlink_to(smoke_study.parent / ".store")
            log().to_csv(folder / "log.csv", index=False)
            trial().to_csv(folder / "first_trial.csv", index=False)
    return folder


def log() -> pd.DataFrame:
    """A record with the columns that the pages name."""
    rng = np.random.default_rng(0)
    power = np.repeat(rng.uniform(-3, 3, 60), 8)
    return heated(power, gain=0.0, start=0.0)


def trial() -> pd.DataFrame:
    """The same plant under a gain so high that the loop swings for ever."""
    power = np.zeros(480)
    return heated(power, gain=5.0, start=1.0)


def heated(power: np.ndarray, gain: float, start: float) -> pd.DataFrame:
    """A lag whose input saturates softly; `gain` feeds its measured output back."""
    temperature = np.zeros(len(power))
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(len(power))
    noise = 0.02 * white_noise
    temperature[0] = start
    for k in range(len(power)):
        difference = power[k] - gain * (temperature[k] + noise[k])
        power[k] = np.clip(difference, -3, 3)
        if k + 1 < len(power):
            temperature[k + 1] = 0.93 * temperature[k] + 0.4 * (power[k] + 0.5 * np.tanh(power[k]))
    noisy = temperature + noise
    return pd.DataFrame({"power": power, "temperature": noisy, "voltage": power, "speed": noisy})


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(designs, "Auto", partial(Auto, **FEW))  # of the peers as of a run
    monkeypatch.setattr(
        time, "perf_counter", time.perf_counter
    )  # one benchmark puts its own clock there
    path = list(sys.path)
    monkeypatch.setattr(sys, "path", path)
    monkeypatch.setenv(extensions.FOLDER, "")
    extensions.trusted_packages.cache_clear()
    yield
    monkeypatch.undo()
    extensions.trusted_packages.cache_clear()  # what a command trusted by `--with`


def test_there_are_commands_of_every_kind() -> None:
    assert len(COMMANDS) > 50
    for beginning in (
        "ssm-study run -m",
        "ssm-study report",
        "ssm-study export",
        "python benchmarks/",
        "make ",
    ):
        assert any(command.startswith(beginning) for command in COMMANDS), beginning


@pytest.mark.filterwarnings(
    "ignore::ssm_study.data.metrics.UnidentifiableSlopesWarning"
)  # one page shows it
@pytest.mark.parametrize(
    "command", COMMANDS, ids=lambda command: f"{COMMANDS[command]}: {command[:70]}"
)
def test_it_runs(
    command: str,
    clone: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    tmp_path: Path,
) -> None:
    for word, reason in ELSEWHERE.items():
        if word in command:
            pytest.skip(reason)
    measured = ("experiment=benchmark", "results/benchmark", "data=cascaded_tanks")
    if any(word in command for word in measured):
        monkeypatch.setenv("SSM_STUDY_DATA", str(request.getfixturevalue("benchmark_data")))
    monkeypatch.chdir(clone)
    written = files_to_write(ROOT / "docs" / COMMANDS[command]) if "my_" in command else {}
    for path, text in written.items():
        parent = (tmp_path / path).parent
        parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    for folder, package in ROOMS.items():
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path / folder)])
    if command.startswith("ssm-study report") and "--only" not in command:
        # Each figure is rendered where a page shows it alone; here they are drawn.
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", leave_empty_picture)
    conf = tmp_path / "conf"
    with FileLock(clone.parent / f"{lock_of(command)}.lock"):
        executed(command, clone, conf if conf.is_dir() else None)


def test_every_figure_that_a_page_draws_of_any_study_is_there() -> None:
    drawn = [name for command in COMMANDS for name in ONE_FIGURE.findall(command)]
    assert len(drawn) > 10
    assert set(drawn) <= set(figures.figure_names())


def test_the_tutorial_makes_the_log_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "tutorial.md"
    exec(files_to_write(page)["make_log.py"], {})
    written = pd.read_csv("log.csv")
    columns = list(written.columns)
    assert columns == ["power", "temperature"]
    assert len(written) == 2400


@pytest.mark.parametrize(
    ("commands", "swept", "column"),
    [
        (
            [
                "ssm-study run experiment=smoke",
                "ssm-study run experiment=smoke model.slope_lower=0.2",
            ],
            "slope_lower",
            "mu",
        ),
        (
            [
                "ssm-study run -m experiment=smoke study=first_sweep synthesis=riccati "
                "synthesis.rate_controller=0.1,0.3,0.7"
            ],
            "rate_controller",
            "r ctl",
        ),
    ],
)
def test_the_tutorials_tables_hold(
    commands: list[str], swept: str, column: str, clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The numbers of commands above, which share one place: step 4 printed a margin of 1.821 where
    3.259 comes out."""
    assert set(commands) <= set(COMMANDS)
    monkeypatch.chdir(clone)
    words = commands[0].split()
    named = dict(word.split("=") for word in words if "=" in word)
    study = named.get("study", named["experiment"])
    with FileLock(clone.parent / f"{lock_of(commands[0])}.lock"):
        for command in commands:
            executed(command, clone)
        paths = sorted(Path(f"results/{study}").glob("*/record.json"))
        records = [json.loads(path.read_text()) for path in paths]
    for _, row in table_on_page("tutorial.md", column).iterrows():
        same_setting = [record for record in records if record[swept] == float(row[column])]
        assert any(agrees(record, row) for record in same_setting), row.to_dict()


def agrees(record: dict[str, Any], row: "pd.Series[Any]") -> bool:
    """Whether a run has the status, fit and margin of a row of a printed table."""
    numbers = {"fit_test_percent": "fit %", "resolved_margin": "margin"}
    printed = {name: row[head] for name, head in numbers.items() if row[head] != "-"}
    near = [record[name] == pytest.approx(float(v), rel=NEAR) for name, v in printed.items()]
    return record["status"] == row["status"] and all(near)


def leave_empty_picture(figure: Any, path: Any, **_: Any) -> None:
    """Stand for the rendering of a figure, which is most of a report's time."""
    del figure
    if isinstance(path, (str, Path)):
        Path(path).touch()


def lock_of(command: str) -> str:
    """Commands on one study, or of one benchmark, one after the other."""
    words = command.replace("STUDY", "results/paper").split()
    named = [word.split("=")[1] for word in words if word.startswith(("study=", "experiment="))]
    read = [word.split("/")[1] for word in words if word.startswith("results/")]
    script = [Path(word).stem for word in words if word.endswith(".py")]
    return (read + script + named + ["none"])[0]


def executed(command: str, clone: Path, written: Path | None = None) -> None:
    words = [
        word for word in shlex.split(command) if "=" not in word or not word.split("=")[0].isupper()
    ]
    program, *arguments = words
    arguments = extensions.pop_extension_option(arguments)
    if "--retry-failed" in arguments:  # of a study that is there
        executed(command.replace(" --retry-failed", ""), clone, written)
    if program == "ssm-study" and arguments[0] == "run":
        more = [] if written is None else ["--config-dir", str(written)]
        assert status(["run", *more, *small(arguments[1:], written)]) == cli.DONE
    elif program == "ssm-study":
        arguments = reading(arguments, clone)
        assert status(arguments) == cli.DONE
        if arguments[0] == "report" and "--help" not in arguments:
            left = f"figures/{arguments[3]}.pdf" if "--only" in arguments else "report.html"
            assert (clone / arguments[1] / left).is_file()
    elif program == "python":
        benchmark(arguments, clone)
    elif (
        program == "make"
    ):  # what its recipe installs needs a network; what else it does is in this suite
        subprocess.run(
            ["make", "--dry-run", *arguments], cwd=ROOT, check=True, stdout=subprocess.PIPE
        )
    else:
        assert program in (".", "source"), f"no rule for {program}"
        if not (ROOT / arguments[0]).exists():
            pytest.skip(f"{arguments[0]} was not made here (`make study` makes it)")
        subprocess.run(
            ["bash", "-c", f"{command} && ssm-study --help"],
            cwd=ROOT,
            check=True,
            stdout=subprocess.PIPE,
        )


def status(arguments: list[str]) -> int:
    """The exit status of `ssm-study`, as in a process of its own."""
    try:
        return cli.main(arguments)
    except SystemExit as end:
        return int(end.code or 0)


def reading(arguments: list[str], clone: Path) -> list[str]:
    """A command on a study: made first by the command that the pages give for it; RUN is one of its
    runs.

    STUDY stands for any: here for the paper's.
    """
    if (
        arguments[0] == "look" and len(arguments) > 1
    ):  # of the log that lies in the clone, not of a study
        return [word.replace("FILE", "log.csv") for word in arguments]
    if arguments[1:] in ([], ["--help"]):
        return [arguments[0], "--help"]  # a page speaks of the command, not of a study
    arguments = [word.replace("STUDY", "results/paper") for word in arguments]
    study = arguments[1].split("/")[1]
    runs_path = clone / "results" / study / "runs.parquet"
    if not (runs_path).exists():
        found = maker(study)
        assert found is not None, f"no page says how to make the study {study}"
        executed(found, clone)
    paths = (clone / "results" / study).glob("*/record.json")
    records = sorted(paths)
    runs = [
        path.parent.name for path in records if json.loads(path.read_text()).get("status") == "ok"
    ]
    run = (runs or [records[0].parent.name])[0]
    subject = ACTIONS[arguments[0]].subject
    if subject == "run" and arguments[1].count("/") == 1:  # other pages' commands add runs to it
        arguments[1] += "/RUN"
    return [word.replace("/RUN", f"/{run}") for word in arguments]


def benchmark(arguments: list[str], clone: Path) -> None:
    """Run `python benchmarks/x.py` without a new interpreter; what it reads of others is made
    first."""
    for word in arguments:
        if word.startswith("results/") and "reference" not in word:
            reading(["show", word], clone)
        if word.endswith(".csv") and "pool" in arguments and not (clone / word).exists():
            if not (clone / "dc_motor.csv").exists():
                benchmark(
                    [arguments[0], "run", "--plant", "dc_motor", "--to", "dc_motor.csv"], clone
                )
            table = pd.read_csv(
                clone / "dc_motor.csv"
            )  # as if it were the other plant's: pooling is what runs here
            plant = word.removesuffix(".csv")
            table.assign(plant=plant).to_csv(clone / word, index=False)
    for name in [name for name, module in sys.modules.items() if is_benchmark(module)]:
        del sys.modules[name]
    benchmarks_path = str(clone / "benchmarks")
    sys.path.insert(0, benchmarks_path)
    sys.argv = small_benchmark(arguments)
    try:
        runpy.run_path(arguments[0], run_name="__main__")
    except SystemExit as end:
        if end.code:
            raise


def is_benchmark(module: object) -> bool:
    parent = Path(getattr(module, "__file__", None) or "/").parent
    name = parent.name
    return (name) == "benchmarks"


@pytest.mark.parametrize(
    "wrong", ["modle.order=4", "model.ordre=4", "synthesis=ricati", "experiment=papr"]
)
def test_a_misspelt_request_does_not_pass(wrong: str) -> None:
    with pytest.raises(Exception, match=r"Could not|not in|In 'study'"):
        composed([wrong])
    assert status(["run", wrong]) == cli.WRONG_REQUEST


def test_the_rule_shortens_and_changes_nothing_else() -> None:
    asked = ["-m", "experiment=paper", "study=seeds", "seed=0,1,2"]
    short = small(asked)
    expected = ["experiment=paper", "study=seeds", "seed=0"]
    assert short[:3] == expected
    words = short[3:]
    parts = {word.split("=")[0].split(".")[0].removeprefix("+") for word in words}
    upper_limit = {"data", "training", "synthesis", "loop", "hydra", "progress"}
    assert parts <= upper_limit
    arguments = ["-m", "experiment=smoke", "seed=1,2"]
    expected = ["-m", "experiment=smoke", "seed=1,2"]
    assert small(arguments) == expected
    arguments = ["-m", "experiment=smoke", "seed=1,2", "model.order=2,3,4"]
    many = small(arguments)
    expected = ["-m", "experiment=smoke", "seed=1", "model.order=2"]
    assert many == expected
