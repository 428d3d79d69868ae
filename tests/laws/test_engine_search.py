"""Search: total trials, nothing asked twice is computed twice, killed searches are taken up, two share one study."""

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from ssm_study.refusal import BadRequest

optuna = pytest.importorskip("optuna", reason="the extra `search` is not installed")

from optuna.trial import TrialState  # noqa: E402

from ssm_study.sweeps.search import FOLDER, JOURNAL, FlockedJournal, Search, objectives  # noqa: E402


def space(*words: str) -> dict[str, Override]:
    return {override.get_key_element(): override for override in OverridesParser.create().parse_overrides(list(words))}


SPACE = space("x=interval(-4,4)", "order=range(2,10,2)", "kind=a,b")


def search(folder: Path, trials: int, **changes: Any) -> Search:
    options = {"maximise": ("fit_test_percent",), "minimise": (), "seed": 0, "at_once": 2} | changes
    return Search(study=folder, trials=trials, **options)


def parabola(jobs: list[list[str]]) -> list[Mapping[str, Any] | None]:
    records: list[Mapping[str, Any] | None] = []
    for words in jobs:
        values = dict(word.split("=") for word in words)
        x, order = float(values["x"]), int(values["order"])
        assert order in (2, 4, 6, 8)
        bonus = 1.0 if values["kind"] == "b" else 0.0
        records.append({"fit_test_percent": -((x - 1) ** 2) + bonus, "settling_time_mean_s": abs(x) + order})
    return records


def test_trials_are_counted_in_total_and_the_best_is_found(tmp_path: Path) -> None:
    asked: list[list[str]] = []

    def answer(jobs: list[list[str]]) -> list[Mapping[str, Any] | None]:
        asked.extend(jobs)
        return parabola(jobs)

    search(tmp_path, 10).run(SPACE, ["seed=3"], answer)
    assert len(asked) == 10
    study = search(tmp_path, 40).run(SPACE, ["seed=3"], answer)
    assert len(asked) == len(study.trials) == 40
    search(tmp_path, 40).run(SPACE, ["seed=3"], answer)
    assert len(asked) == 40
    assert all("seed=3" in words for words in asked)
    assert study.best_value > 0.9, "forty trials of a parabola with a bonus of one"


def test_two_objectives_give_a_front(tmp_path: Path) -> None:
    study = search(tmp_path, 30, minimise=("settling_time_mean_s",)).run(SPACE, [], parabola)
    front = [trial.values for trial in study.best_trials]
    assert len(front) >= 2
    assert not any(a[0] > b[0] and a[1] < b[1] for a in front for b in front)


def test_failed_and_infeasible_runs_are_failed_trials(tmp_path: Path) -> None:
    study = search(tmp_path, 4).run(
        SPACE, [], lambda jobs: [{"status": "infeasible"} if i else None for i, _ in enumerate(jobs)]
    )
    assert {trial.state for trial in study.trials} == {TrialState.FAIL}
    assert objectives({"a": True}, ["a"]) is None
    assert objectives({"a": 1, "b": 2.0}, ["b", "a"]) == [2.0, 1.0]


def elsewhere(folder: Path, trials: int, seed: int = 0, dies_at: int = 0) -> "subprocess.Popen[bytes]":
    """The same search in a process of its own, which may die while its `dies_at`-th question is being answered."""
    program = (
        f"import sys, os; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from pathlib import Path\n"
        "from test_engine_search import SPACE, parabola, search\n"
        "count = 0\n"
        "def answer(jobs):\n"
        "    global count\n"
        "    count += 1\n"
        f"    if count == {dies_at}: os._exit(9)\n"
        "    return parabola(jobs)\n"
        f"search(Path({str(folder)!r}), {trials}, seed={seed}).run(SPACE, [], answer)\n"
    )
    return subprocess.Popen([sys.executable, "-c", program])


def test_a_killed_search_is_taken_up_where_it_was(tmp_path: Path) -> None:
    assert elsewhere(tmp_path, 12, dies_at=3).wait(timeout=120) == 9
    left = search(tmp_path, 12).open().get_trials(states=(TrialState.RUNNING,))
    assert len(left) == 2
    first: list[list[str]] = []

    def answer(jobs: list[list[str]]) -> list[Mapping[str, Any] | None]:
        first.extend(jobs)
        return parabola(jobs)

    study = search(tmp_path, 12).run(SPACE, [], answer)
    assert first[:2] == [trial.user_attrs["words"] for trial in left]
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 12


def test_two_searches_share_the_trials_of_one_study(tmp_path: Path) -> None:
    both = [elsewhere(tmp_path, 20, seed=number) for number in range(2)]
    assert [process.wait(timeout=120) for process in both] == [0, 0]
    trials = search(tmp_path, 20).open().trials
    assert 20 <= len(trials) <= 22  # both may ask for the last ones in the same moment
    assert {trial.state for trial in trials} == {TrialState.COMPLETE}


def test_a_torn_line_is_dropped(tmp_path: Path) -> None:
    search(tmp_path, 4).run(SPACE, [], parabola)
    journal = tmp_path / FOLDER / JOURNAL
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 4, "trial')
    assert len(list(FlockedJournal(journal).read_logs(0))) == whole.count(b"\n")
    assert len(search(tmp_path, 6).run(SPACE, [], parabola).trials) == 6
    assert all(json.loads(line) for line in journal.read_text().splitlines())


@pytest.mark.parametrize(
    "wrong", [{"trials": 0}, {"at_once": 0}, {"maximise": ()}, {"maximise": ("status",)}, {"minimise": ("nothing",)}]
)
def test_a_search_without_sense_is_refused(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(BadRequest, match=r"hydra\.sweeper"):
        search(tmp_path, **({"trials": 5} | wrong))
