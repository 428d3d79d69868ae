"""Every choice of a swappable part runs the whole line, without being listed here: a new yaml is a new test case."""

import json
import os
from pathlib import Path

import pytest

from ssm_study.cli import configuration_folder, main
from ssm_study.results.verify import verify

TINY = ["experiment=smoke", "progress=false", "data.samples=300", "data.test_samples=300", "training.max_epochs=2"]
QUICK = "synthesis=riccati"  # without the search over rates: the case is another part


def choices(group: str, *more: str, option: str = "") -> list[tuple[str, ...]]:
    found = sorted(path.stem for path in (configuration_folder() / group).glob("*.yaml"))
    return [(*more, f"{option or group}={name}") for name in found]


EVERY = [
    *choices("plant", QUICK),
    *choices("scaffold", QUICK, option="scaffold@model.scaffold_in"),
    *choices("reduction", QUICK),
    *choices("synthesis"),
]


@pytest.fixture(scope="session")
def shared_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One store for all cases and workers: what two of them share is computed once."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "every"


@pytest.mark.parametrize("choice", EVERY, ids=lambda choice: choice[-1])
def test_the_whole_line(choice: tuple[str, ...], shared_results: Path) -> None:
    study = "".join(letter if letter.isalnum() else "_" for letter in choice[-1])
    assert main(["run", *TINY, *choice, f"results_dir={shared_results}", f"study={study}"]) == 0
    (path,) = (shared_results / study).glob("*/record.json")
    record = json.loads(path.read_text())
    assert record["status"] in ("ok", "infeasible")
    if record["status"] == "infeasible":
        assert record["infeasible_reason"]
    assert [finding for finding in verify(path.parent) if not finding.holds] == []
