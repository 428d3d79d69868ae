"""The report of `look` on a log, against logs whose plant is known."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssm_study.cli.main import main
from ssm_study.data.log_dynamics import answer_sentence, first_answer, input_shares
from ssm_study.data.look import look
from ssm_study.refusal import BadRequest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import kind_named

SAYS = {
    "same_sample": ("answers within the same sample", "dead time"),
    "dead_time": ("dead time: the output answers after", "same sample"),
    "position_dead_zone": ("integrator: the input explains", "same sample"),
    "direction": ("answers in the next sample: no dead time", "integrator"),
    "slow_coarse": ("a coarse sensor", "integrator"),
    "drifting": ("noise at most", "integrator"),
}


@pytest.mark.parametrize("name", SAYS)
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_what_is_true_is_said_and_what_is_false_is_not(
    tmp_path: Path, name: str, seed: int
) -> None:
    path = tmp_path / "log.csv"
    kind_named(name).log(seed).to_csv(path, index=False)
    said, unsaid = SAYS[name]
    text = str(look(path))
    assert said in text
    assert unsaid not in text
    assert f"step {kind_named(name).step_s:g} s" in text
    assert text.endswith(look(path).command)


def test_a_closed_loop_is_called_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    u = np.zeros(2000)
    y = np.zeros(2000)
    integral = state = 0.0
    set_point = np.repeat(rng.uniform(-1, 1, 40), 50)
    for k in range(1, 2000):
        u[k] = 4.0 * (set_point[k] - y[k - 1]) + integral  # a computer that acts a sample later
        integral += 0.05 * (set_point[k] - y[k - 1])
        state = 0.9 * state + 0.1 * u[k - 1] + 0.03 * rng.standard_normal()
        y[k] = state
    pd.DataFrame({"u": u, "y": y}).to_csv(tmp_path / "log.csv", index=False)
    assert "a closed loop?" in str(look(tmp_path / "log.csv", step_s=0.1))


def test_the_command_draws_and_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kind_named("direction").log(0, samples=500).to_csv("my log.csv", index=False)
    assert main(["look", "my log.csv"]) == 0
    printed = capsys.readouterr().out
    assert "data.path=\"'my log.csv'\" data.input=u data.output=y" in printed
    assert (tmp_path / "my log_look.png").stat().st_size > 10_000


def test_a_log_that_cannot_be_read_yet_says_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    pd.DataFrame({"u": [0.0, 1.0, 2.0] * 40, "y": np.arange(120.0) ** 2}).to_csv(path, index=False)
    text = str(look(path))
    assert "the sampling time is unknown" in text
    assert text.endswith("data.step_s=SECONDS")
    path.write_text("no numbers here\nat all\n")
    with pytest.raises(BadRequest, match="no rows of numbers"):
        look(path)


@pytest.mark.parametrize("lag_samples", [50, 400, 2000])
def test_a_slow_lag_is_no_integrator(lag_samples: int) -> None:
    """Over a few samples a slow lag sums its input, too, but it forgets within the log."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 100), 40)
    y = np.zeros(4000)
    for k in range(1, 4000):
        y[k] = y[k - 1] + (u[k - 1] - y[k - 1]) / lag_samples
    assert not input_shares(u, y).is_integrator
    assert input_shares(u, np.cumsum(u)).is_integrator


def test_a_slow_answer_is_seen_in_coarser_steps() -> None:
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1, 1, 100), 80)
    x = np.convolve(u, 1 / 60 * np.exp(-np.arange(400) / 60))[: len(u)]
    y = np.convolve(x, 1 / 60 * np.exp(-np.arange(400) / 60))[: len(u)]
    y += 0.01 * rng.standard_normal(len(y))
    assert first_answer(u, y) is None
    assert "slow" in answer_sentence(u, y, input_shares(u, y))
