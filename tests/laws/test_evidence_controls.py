"""Negative controls, each from a log to the printed words: no log that cannot bear it gets a word
of comfort."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from docs_commands import FEW

from ssm_study.cli.main import main

pytestmark = pytest.mark.usefixtures("without_baselines")

SAMPLES = 900


def multilevel(samples: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, samples), rng.integers(2, 25, samples))[:samples]


def answer(
    u: np.ndarray, slow: float = 0.9, fast: float = 0.6, seed: int = 1, noise: float = 0.01
) -> np.ndarray:
    """Two lags behind a saturating input, and a little sensor noise."""
    y = np.zeros(len(u))
    lag = 0.0
    out = 0.0
    for k, level in enumerate(np.tanh(1.5 * u)):
        y[k] = out
        out = slow * out + (1 - slow) * lag
        lag = fast * lag + (1 - fast) * level
    rng = np.random.default_rng(seed)
    white_noise = rng.standard_normal(len(u))
    return y + noise * white_noise


def unstable(u: np.ndarray) -> np.ndarray:
    y = np.zeros(len(u))
    for k in range(len(u) - 1):
        y[k + 1] = 1.004 * y[k] + 0.1 * u[k]
    return y


def oscillating(u: np.ndarray) -> np.ndarray:
    """A van der Pol oscillator: its own motion is ten times what the input makes of it."""
    y = 1.0
    v = 0.0
    out = np.zeros(len(u))
    for k, level in enumerate(u):
        out[k] = y
        for _ in range(10):
            difference = (1 - y**2) * v - y
            y, v = y + 0.02 * v, v + 0.02 * (difference + 0.1 * level)
    return out


def moved_thrice() -> np.ndarray:
    return np.repeat([0.0, 0.5, -0.4, 0.2], SAMPLES // 4)


U = multilevel(SAMPLES)
GOOD = answer(U)
MOVED_THRICE = moved_thrice()
ONE_SIDED = np.abs(U)
TWO_LEVELS = np.sign(U)

Log = tuple[np.ndarray, np.ndarray]
LOGS: dict[str, Log] = {}
LOGS["white noise"] = tuple(np.random.default_rng(0).standard_normal((2, SAMPLES)))
LOGS["shuffled output"] = (U, np.random.default_rng(2).permutation(GOOD))
LOGS["hardly moving"] = (MOVED_THRICE, answer(MOVED_THRICE))
LOGS["one-sided"] = (ONE_SIDED, answer(ONE_SIDED))
LOGS["saturated"] = (U, np.clip(GOOD, -0.3, 0.3))
LOGS["60 samples"] = (U[:60], GOOD[:60])
LOGS["two levels"] = (TWO_LEVELS, answer(TWO_LEVELS))
LOGS["unstable"] = (U, unstable(U))
LOGS["oscillating"] = (U, oscillating(U))
LOGS["ends before the slow mode"] = (U[:600], answer(U[:600], slow=0.9985))

NO_JUDGEMENT = ["white noise", "shuffled output", "unstable", "oscillating"]
REASONS = {
    "white noise": "In free run",
    "shuffled output": "In free run",
    "hardly moving": "The input changes",
    "one-sided": "one side of its equilibrium",
    "saturated": "it saturates",
}
REASONS["60 samples"] = "training samples"
REASONS["two levels"] = "two levels"
REASONS["unstable"] = "runs away by itself"
REASONS["oscillating"] = "moves by itself"
REASONS["ends before the slow mode"] = "samples or more, the longest piece that trains"
# The records decide the word, not how many designs are tried or how long the loop is watched: a
# small grid and a short loop give the same words.
GRID = [f"+synthesis.{name}={values}" for name, values in FEW.items()]
OWN = {"one-sided": ["data.equilibrium=zero"], "60 samples": ["data.start_up_samples=3"]}
# A model of the class: two lags behind an input map, without neurons.
QUICK = [
    "model=structured",
    "model.order=2",
    "model.neurons=0",
    "model.starts=1",
    "model.draws=2",
    "training.max_epochs=5",
    "loop.horizon_s=3",
    "loop.initial_conditions=2",
    "progress=false",
    *GRID,
]


def run(folder: Path, log: Log, *more: str) -> tuple[int, dict[str, Any]]:
    """Run the study of a log and return its exit status and its record."""
    path = folder / "log.csv"
    columns = np.column_stack(log)
    np.savetxt(path, columns, delimiter=",", header="u,y", comments="", fmt="%.9g")
    data = ["data=recorded", f"data.path={path}", "data.input=u", "data.output=y"]
    place = ["data.step_s=0.1", "study=s", f"results_dir={folder / 'r'}"]
    status = main(["run", *data, *place, *QUICK, *more])
    study = folder / "r" / "s"
    (record,) = study.glob("*/record.json")
    content = json.loads(record.read_text())
    return status, content


def printed_words(capsys: pytest.CaptureFixture[str]) -> str:
    """Printed text, in one line."""
    words = capsys.readouterr().out.split()
    return " ".join(words)


@pytest.mark.parametrize("name", LOGS)
def test_a_log_that_cannot_bear_it_gets_no_unqualified_word(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = OWN.get(name, [])
    status, record = run(tmp_path, LOGS[name], "--strict", *own)
    text = printed_words(capsys)
    level = record["evidence"]
    assert level in ("doubt", "cannot judge")
    withheld = level == "cannot judge"
    assert withheld or name not in NO_JUDGEMENT
    assert REASONS[name] in record["evidence_reasons"]
    assert REASONS[name] in text
    assert "plant" not in text.lower()
    assert (record["predicted_stable"] is None) == withheld
    assert (status == 1) == withheld
    assert ("allows no judgement" in text) == withheld
    assert not record["predicted_stable"] or "stays stable, with doubts" in text


def test_a_test_record_that_is_the_training_record_says_nothing_new(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = [f"data.test_path={tmp_path / 'log.csv'}", "training.max_epochs=12"]
    _, record = run(tmp_path, (U, GOOD), *own)
    assert record["evidence"] == "doubt"
    assert "is part of the training records" in printed_words(capsys)


def test_a_good_log_is_sound(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, record = run(tmp_path, (U, GOOD), "--strict", "training.max_epochs=12")
    assert status == 0
    assert record["evidence"] == "sound"
    assert "doubt" not in printed_words(capsys)
    assert record["predicted_stable"] is not None
