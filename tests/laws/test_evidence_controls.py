"""Negative controls, each from a log to the printed words: no log that cannot bear it gets a word
of comfort."""

import json
from pathlib import Path

import numpy as np
import pytest
from docs_commands import FEW

from ssm_study.cli.main import main

SAMPLES = 1500


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
LOGS = {
    "white noise": (
        *np.random.default_rng(0).standard_normal((2, SAMPLES)),
        "cannot judge",
        "free run",
    ),
    "shuffled output": (
        U,
        np.random.default_rng(2).permutation(answer(U)),
        "cannot judge",
        "free run",
    ),
    "hardly moving": (moved_thrice(), answer(moved_thrice()), "", "The input changes"),
    "one-sided": (np.abs(U), answer(np.abs(U)), "", "one side of its equilibrium"),
    "saturated": (U, np.clip(answer(U), -0.3, 0.3), "", "it saturates"),
    "60 samples": (U[:60], answer(U[:60]), "", "training samples"),
    "two levels": (np.sign(U), answer(np.sign(U)), "", "two levels"),
    "unstable": (U[:1000], unstable(U[:1000]), "cannot judge", "runs away by itself"),
    "oscillating": (U, oscillating(U), "cannot judge", "moves by itself"),
    "ends before the slow mode": (U[:600], answer(U[:600], slow=0.9985), "", ""),
}
# The records decide the word, not how many designs are tried or how long the loop is watched: a
# small grid and a short loop give the same words.
GRID = [f"+synthesis.{name}={values}" for name, values in FEW.items()]
OWN = {"one-sided": ["data.equilibrium=zero"], "60 samples": ["data.start_up_samples=3"]}


def run(folder: Path, u: np.ndarray, y: np.ndarray, *more: str) -> tuple[int, dict]:
    log = folder / "log.csv"
    np.savetxt(log, np.column_stack([u, y]), delimiter=",", header="u,y", comments="", fmt="%.9g")
    given = [
        "data=recorded",
        f"data.path={log}",
        "data.input=u",
        "data.output=y",
        "data.step_s=0.1",
        "study=s",
    ]
    quick = [
        "model=structured",
        "model.order=3",
        "model.neurons=1",
        "model.starts=1",
        "model.draws=2",
        "training.max_epochs=12",
        "loop.horizon_s=3",
        "loop.initial_conditions=2",
        "progress=false",
        *GRID,
    ]
    status = main(["run", *given, *quick, f"results_dir={folder / 'r'}", *more])
    s_path = folder / "r" / "s"
    (record,) = s_path.glob("*/record.json")
    text = record.read_text()
    content = json.loads(text)
    return status, content


@pytest.mark.parametrize("name", LOGS)
def test_a_log_that_cannot_bear_it_gets_no_unqualified_word(name, tmp_path, capsys):
    u, y, level, said = LOGS[name]
    own = OWN.get(name, [])
    status, record = run(tmp_path, u, y, "--strict", *own)
    out = capsys.readouterr().out
    text = " ".join(out.split())
    assert record["evidence"] in ((level,) if level else ("doubt", "cannot judge"))
    assert said in text
    assert "plant" not in text.lower()
    withheld = record["evidence"] == "cannot judge"
    assert (record["predicted_stable"] is None) == withheld
    assert (status == 1) == withheld
    assert ("allows no judgement" in text) == withheld
    assert not record["predicted_stable"] or "stays stable, with doubts" in text


def test_a_test_record_that_is_the_training_record_says_nothing_new(tmp_path, capsys):
    _, record = run(tmp_path, U, answer(U), f"data.test_path={tmp_path / 'log.csv'}")
    assert record["evidence"] == "doubt"
    out = capsys.readouterr().out
    text = " ".join(out.split())
    assert "is part of the training records" in text


def test_a_good_log_is_sound(tmp_path, capsys):
    status, record = run(tmp_path, U, answer(U), "--strict", "training.max_epochs=40")
    assert status == 0
    assert record["evidence"] == "sound"
    out = capsys.readouterr().out
    assert "doubt" not in out
    assert record["predicted_stable"] is not None
