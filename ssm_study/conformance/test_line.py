"""Test that a study with any choice of any configuration group runs from data to a finished result.
A new yaml is tried without being listed."""

import json
import os
from itertools import zip_longest
from pathlib import Path

import jaxtyping
import pytest

from ssm_study.cli.main import main
from ssm_study.conformance import list_choices
from ssm_study.extensions import (
    configuration_folders,
    extension_configuration_folders,
    extension_modules,
)
from ssm_study.report import figures
from ssm_study.study.verify import verify

TINY = [
    "experiment=smoke",
    "progress=false",
    "data.trajectories=2",
    "data.samples=200",
    "data.validation_samples=200",
    "data.test_samples=200",
    "data.fresh_sets=0",
    "training.max_epochs=2",
    "loop.initial_conditions=2",
]
# Records for the mismatch alone: a search over rates chooses by them.
NO_TRIALS = "+data.trials=false"
# Without the search over rates, and without trials: the case is another part.
QUICK = ("synthesis=riccati", NO_TRIALS)


# Grids of one or two points each for a search over rates and weights: judged is the line from data
# to record, not how many designs are tried on the way.
SEARCH = "ssm_study.synthesis.auto.Auto"
SMALL_GRIDS = (
    "+synthesis.stretch_shares=[0.3]",
    "+synthesis.observer_rates=[0.2]",
    "+synthesis.input_weights=[0.01,1.0]",
    "+synthesis.output_noises=[0.01,1.0]",
)
SMALL_INTEGRAL_GRID = "synthesis.integral_weights=[0.001]"
OPTIONS = {"plant": "plant", "scaffold": "scaffold@model.scaffold_in", "reduction": "reduction"}


def commands_of_all_choices() -> list[tuple[str, ...]]:
    """Command-line words of runs in which each choice of the configuration groups occurs.

    Our own plants, scaffolds and reductions share their runs: the first plant runs with the first
    scaffold and the first reduction. Each synthesis, and each choice and experiment of an extension
    package, has a run of its own.
    """
    columns = []
    for group, option in OPTIONS.items():
        columns.append([f"{option}={name}" for name in own_choices(group)])
    words: list[tuple[str, ...]] = []
    for row in zip_longest(*columns):
        words.append((*QUICK, *filter(None, row)))
    words += [synthesis_words(name) for name in own_choices("synthesis")]
    for group, option in OPTIONS.items():
        words += [(*QUICK, f"{option}={name}") for name in foreign_choices(group)]
    words += [synthesis_words(name) for name in foreign_choices("synthesis")]
    for folder in extension_configuration_folders():
        words += [(f"experiment={path.stem}",) for path in folder.glob("experiment/*.yaml")]
    return words


def own_choices(group: str) -> list[str]:
    """Names of the choices of a configuration group that this package brings itself."""
    ours = configuration_folders()[0]
    return [name for name in list_choices(group) if (ours / group / f"{name}.yaml").is_file()]


def foreign_choices(group: str) -> list[str]:
    """Names of the choices of a configuration group that extension packages bring."""
    ours = own_choices(group)
    return [name for name in list_choices(group) if name not in ours]


def synthesis_words(name: str) -> tuple[str, ...]:
    """Command-line words of a quick run with one choice of `synthesis/`."""
    return (*quick_synthesis_overrides(name), f"synthesis={name}")


def name_run(words: tuple[str, ...]) -> str:
    """Name of a run: the choices that it makes."""
    return " ".join(word for word in words if not word.startswith(("+", "synthesis.")))


def quick_synthesis_overrides(synthesis: str) -> tuple[str, ...]:
    """Command-line words that make a choice of `synthesis/` quick: small search grids, or no
    closed-loop trials."""
    texts = []
    for folder in configuration_folders():
        path = folder / "synthesis" / f"{synthesis}.yaml"
        if path.is_file():
            texts.append(path.read_text())
    text = texts[0]
    if SEARCH not in text:
        return (NO_TRIALS,)
    if "integral_weights" not in text:
        return SMALL_GRIDS
    return (*SMALL_GRIDS, SMALL_INTEGRAL_GRID)


@pytest.fixture(autouse=True)
def _switch_off_checks_and_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Switch off the checks of array shapes and the figures, because whole runs are tested here.

    It is no generator, because in a module that jaxtyping checks pytest would mistake one for a
    function that returns.
    """
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    # Each draws the same two figures, for a third of its time.
    monkeypatch.setattr("ssm_study.cli.summary.RUN_FIGURES", ())


@pytest.fixture(scope="session")
def shared_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder that all tests share, so that equal computations run only once."""
    base = tmp_path_factory.getbasetemp()
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    return (base.parent if is_worker else base) / "every"


@pytest.mark.parametrize("choices", commands_of_all_choices(), ids=name_run)
def test_every_choice_runs_to_a_results_table(
    choices: tuple[str, ...], shared_results: Path
) -> None:
    """Every choice of a configuration group runs from data to a finished table of results."""
    name = name_run(choices)
    study = "".join(letter if letter.isalnum() else "_" for letter in name)
    tiny = TINY[name.startswith("experiment=") :]
    place = [f"results_dir={shared_results}", f"study={study}"]
    assert main(["run", *tiny, *choices, *place]) == 0
    (path,) = (shared_results / study).glob("*/record.json")
    record = json.loads(path.read_text())
    assert record["status"] in ("ok", "infeasible")
    if record["status"] == "infeasible":
        assert record["infeasible_reason"]
    assert [finding for finding in verify(path.parent) if not finding.holds] == []
    for name in extension_modules("figures"):
        assert figures.figure_caption(name)
        for picture in figures.draw_figures([name], shared_results / study):
            assert picture.stat().st_size > 0


def test_extension_packages_replace_no_choice() -> None:
    """No extension package has a yaml file or figure of the same name as one in this package."""
    ours, *others = configuration_folders()
    our_files = configuration_files(ours)
    for theirs in others:
        assert not configuration_files(theirs) & our_files
    our_figures = {path.stem for path in Path(figures.__file__).parent.glob("*.py")}
    assert not set(extension_modules("figures")) & our_figures


def configuration_files(folder: Path) -> set[Path]:
    """Group and name of every yaml file in a configuration folder."""
    return {path.relative_to(folder) for path in folder.glob("*/*.yaml")}
