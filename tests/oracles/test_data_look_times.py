"""Time columns of logs that `look` reads: scattered, wandering and running backwards."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.signal

from ssm_study.data.look import look


def scattered_log(path: Path, late_s: np.ndarray, step_s: float = 0.005) -> pd.DataFrame:
    """Write a log of a first-order plant whose input acts one sample later, under held levels; its
    times are late by given seconds."""
    rng = np.random.default_rng(0)
    samples = len(late_s)
    levels = rng.uniform(-1, 1, samples // 40)
    u = np.repeat(levels, 40)
    y = scipy.signal.lfilter([0.0, 0.2], [1, -0.8], u)
    even_s = step_s * np.arange(samples)
    time_s = even_s + late_s
    time_ms = np.round(1000 * time_s, 1)
    table = pd.DataFrame({"time (ms)": time_ms, "u": u, "y": y})
    table.to_csv(path, index=False)
    return table


def test_times_that_scatter_are_numbered_and_show_no_feedthrough(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rng = np.random.default_rng(3)
    table = scattered_log(path, rng.uniform(-0.0004, 0.0004, 2000))
    seen = look(path)
    assert "step 0.005 s" in str(seen)
    assert "rows numbered, nothing interpolated" in str(seen)
    assert "answers in the next sample: no dead time" in str(seen)
    assert "feedthrough" not in seen.command
    assert seen.command.startswith("ssm-study run study=log data=recorded")
    y = np.concatenate([record.y[:, 0] for record in seen.records])
    np.testing.assert_array_equal(y, table["y"])


def test_a_clock_that_wanders_is_interpolated_without_feedthrough(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    drift_s = 0.001 * np.sin(np.arange(2000) / 30)
    scattered_log(path, drift_s)
    text = str(look(path))
    assert "of the samples interpolated; data.jitter_tolerance=0." in text
    assert "model.feedthrough=true" not in text


def test_a_clock_that_runs_backwards_is_no_signal(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    table = scattered_log(path, np.zeros(400))
    table.loc[[200, 201], "time (ms)"] = table.loc[[201, 200], "time (ms)"].to_numpy()
    table.to_csv(path, index=False)
    seen = look(path)
    expected = ("u", "y")
    actual = (seen.input, seen.output)
    assert actual == expected
    assert "runs backwards" in str(seen)
    assert "ssm-study run" not in str(seen)


@pytest.mark.parametrize("damage", ["text", "frozen"])
def test_no_guess_goes_around_a_column_that_cannot_be_used(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "log.csv"
    table = scattered_log(path, np.zeros(400))
    load = np.sin(np.arange(400) / 7)
    texts = table["y"].astype(str).where(table.index != 300, "error")
    table["y"] = texts if damage == "text" else 0.0
    table.assign(load=load).to_csv(path, index=False)
    seen = look(path)
    assert "no guess: y may be the output" in str(seen)
    assert "ssm-study run" not in str(seen)
    expected = str(look(path, input="u", output="load"))
    assert "ssm-study run" in expected
