"""A log is read once for a run, and again where its content or the way it is read has changed."""

from pathlib import Path

import numpy as np
import pytest

from ssm_study.cli.from_python import compose_configuration
from ssm_study.data.recorded import RecordedData
from ssm_study.study import read_once
from ssm_study.study.line import STUDY
from ssm_study.study.read_once import read_data_set
from ssm_study.study.stages.dataset import compute_dataset, read_dataset


def write_log(path: Path, gain: float) -> None:
    """A first-order lag under random levels."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 60).repeat(5)
    y = np.zeros(300)
    for k in range(299):
        y[k + 1] = 0.8 * y[k] + gain * u[k]
    np.savetxt(path, np.column_stack([u, y]), delimiter=",", header="u,y", comments="")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    write_log(path, 0.2)
    return path


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Paths of the logs that are read from here on, nothing remembered before."""
    build = RecordedData.build
    paths: list[str] = []

    def noted(self: RecordedData, seed: int):  # type: ignore[no-untyped-def]
        path = str(self.path)
        paths.append(path)
        return build(self, seed)

    monkeypatch.setattr(RecordedData, "build", noted)
    read_once._DATA_SETS.clear()
    return paths


def source(path: Path, **changed: object) -> RecordedData:
    settings = {"path": str(path), "input": "u", "output": "y", "step_s": 0.1} | changed
    return RecordedData(**settings)  # type: ignore[arg-type]


def test_the_check_of_a_run_and_its_first_stage_read_its_log_once(
    log: Path, builds: list[str], tmp_path: Path
) -> None:
    words = [
        "data=recorded",
        f"data.path={log}",
        "data.input=u",
        "data.output=y",
        "data.step_s=0.1",
        f"results_dir={tmp_path / 'results'}",
    ]
    request = STUDY.request(compose_configuration(words))
    folder = tmp_path / "stage"
    folder.mkdir()
    compute_dataset(folder, data=request.data, seed=request.seed)
    assert builds == [str(log)]
    stored = read_dataset(folder)
    again = request.data.build(request.seed)
    actual = stored.training[0].y
    expected = again.training[0].y
    np.testing.assert_array_equal(actual, expected)


def test_a_log_that_has_changed_is_read_again(log: Path, builds: list[str]) -> None:
    before = read_data_set(source(log), 0)
    data_set = read_data_set(source(log), 0)
    assert data_set is before
    write_log(log, 0.4)
    after = read_data_set(source(log), 0)
    assert len(builds) == 2
    training_y = before.training[0].y
    assert not np.array_equal(training_y, after.training[0].y)


def test_another_way_to_read_it_reads_it_again(log: Path, builds: list[str]) -> None:
    whole = read_data_set(source(log), 0)
    recorded_data = source(log, fold=1)
    fold = read_data_set(recorded_data, 0)
    assert len(builds) == 2
    training_u = whole.training[0].u
    assert not np.array_equal(training_u, fold.training[0].u)


def test_few_data_sets_are_remembered(log: Path, builds: list[str]) -> None:
    for seed in range(read_once.MOST + 1):
        read_data_set(source(log), seed)
    assert len(read_once._DATA_SETS) == read_once.MOST
    read_data_set(source(log), 0)
    expected = read_once.MOST + 2
    assert len(builds) == expected
