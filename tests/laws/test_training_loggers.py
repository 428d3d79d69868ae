"""Each logger, by its yaml alone, keeps one row per epoch of the record's own curve; a missing
package is said."""

import csv
from pathlib import Path
from typing import Any

import pytest
from models_cases import data_set
from test_models_yaml import read
from test_training_identify import spec

from ssm_study.refusal import BadRequest

NAME = "fit_validation_percent"


def logged(choice: str, folder: Path, *overrides: str) -> list[float]:
    """The validation fits of the record's own curve, after a training with that logger."""
    training = read(
        "training", "default", "training.max_epochs=3", f"training/logger={choice}", *overrides
    )
    rows = training.identify(spec(), data_set(samples=100), 0, folder).curve
    return [row[NAME] for row in rows]


def test_csv(tmp_path: Path) -> None:
    curve = logged("csv", tmp_path)
    with (tmp_path / "csv" / "metrics.csv").open(newline="") as file:
        rows = csv.DictReader(file)
        seen = [float(row[NAME]) for row in rows]
    assert seen == pytest.approx(curve, rel=1e-5)


def test_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    curve = logged("tensorboard", tmp_path)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    scalars = events.Scalars(NAME)
    assert [event.value for event in scalars] == pytest.approx(curve, rel=1e-5)


@pytest.mark.parametrize(("choice", "kind"), [("tensorboard", "TensorBoardLogger")])
def test_a_missing_package_says_what_to_install(
    choice: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(*_: Any, **__: Any) -> Any:
        raise ModuleNotFoundError(choice)

    monkeypatch.setattr(f"lightning.pytorch.loggers.{kind}", absent)
    with pytest.raises(BadRequest, match=rf"pip install 'ssm-study\[{choice}\]'"):
        logged(choice, tmp_path)
