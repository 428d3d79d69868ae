"""The report of `look` on a log, against logs whose plant is known."""

import io
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.signal

from ssm_study.cli.main import DONE, main
from ssm_study.data.log_dynamics import (
    FED_BACK,
    describe_log_dynamics,
    explained_output_variance,
    feedback_error_reduction,
    first_response_lag,
    noise_deviation,
    response_delay_sentence,
)
from ssm_study.data.look import look
from ssm_study.refusal import BadRequest
from ssm_study.report.figure_of_a_log import draw_log
from ssm_study.signals import Trajectory

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
@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_true_is_said_and_what_is_false_is_not(
    tmp_path: Path, name: str, seed: int
) -> None:
    path = tmp_path / "log.csv"
    kind_named(name).log(seed).to_csv(path, index=False)
    said, unsaid = SAYS[name]
    log_look = look(path)
    text = str(log_look)
    assert said in text
    assert unsaid not in text
    assert f"step {kind_named(name).step_s:g} s" in text
    assert text.endswith(log_look.command)


def test_two_samples_show_no_noise() -> None:
    assert noise_deviation(np.array([0.0, 1.0])) == 0.0


def test_a_closed_loop_is_called_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    u = np.zeros(2000)
    y = np.zeros(2000)
    integral = state = 0.0
    set_point = np.repeat(rng.uniform(-1, 1, 40), 50)
    for k in range(1, 2000):
        difference = set_point[k] - y[k - 1]
        u[k] = 4.0 * difference + integral  # a computer that acts a sample later
        difference = set_point[k] - y[k - 1]
        integral += 0.05 * difference
        white_noise = rng.standard_normal()
        state = 0.9 * state + 0.1 * u[k - 1] + 0.03 * white_noise
        y[k] = state
    table = pd.DataFrame({"u": u, "y": y})
    table.to_csv(tmp_path / "log.csv", index=False)
    log_look = str(look(tmp_path / "log.csv", step_s=0.1))
    assert "a closed loop?" in log_look


def test_no_command_is_printed_that_a_run_would_refuse(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    kind_named("direction").log(0, samples=500).to_csv(path, index=False)
    for stated in ({"step_s": 0.3}, {"input": "time_s", "output": "y"}, {"input": "v"}):
        seen = look(path, **stated)
        assert "- not read yet" in str(seen)
        assert "ssm-study run" not in str(seen)
    expected = str(look(path, input="u"))
    assert "ssm-study run" in expected


def test_a_measured_disturbance_is_in_command_and_picture(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    log = kind_named("direction").log(0, samples=500)
    log.assign(load=np.sin(np.arange(500) / 30)).to_csv(path, index=False)
    assert "measured too: load" in str(look(path))
    seen = look(path, disturbance="load")
    assert "measured too" not in str(seen)
    assert seen.command.endswith("data.disturbance=load")
    expected = ["y", "u", "load"]
    actual = [axes.get_ylabel() for axes in draw_log(seen).axes]
    assert actual == expected


def test_an_output_that_never_changes_with_the_input_is_no_integrator() -> None:
    u = np.zeros(3000)
    u[0] = 1.0
    y = np.full(3000, 5.0)
    y[-1] = 5.1
    actual = explained_output_variance(u, y).change
    assert actual == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_a_heater_behind_a_dead_time_is_no_integrator(seed: int) -> None:
    """Within the dead time and the first lag it loses nothing; it does over a minute."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([0.0, 50.0, 100.0], 15), 200)
    late = np.concatenate([np.zeros(15), u])[: len(u)]
    heater = scipy.signal.lfilter([0.05], [1, -0.95], late)
    y = scipy.signal.lfilter([0.3 / 150], [1, -np.exp(-1 / 150)], heater)
    y = np.round(20 + y + 0.02 * rng.standard_normal(len(u)), 2)
    assert not explained_output_variance(u, y).is_integrator


def test_a_sweep_of_sines_is_no_closed_loop() -> None:
    """Its next value follows from its own past, of which the outputs are another account."""
    time = np.arange(1000)
    u = sum(np.sin(2 * np.pi * f * time / 500 + f**2) for f in range(10, 60, 5))
    sine = np.sin(0.3 * np.arange(60))
    y = np.convolve(u, 0.95 ** np.arange(60) * sine)[:1000]
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal(1000)
    y = y + 0.02 * white_noise
    assert feedback_error_reduction(u, y) < FED_BACK


def test_the_command_draws_and_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kind_named("direction").log(0, samples=500).to_csv("my log.csv", index=False)
    actual = main(["look", "my log.csv"])
    assert actual == 0
    printed = capsys.readouterr().out
    assert "data.path=\"'my log.csv'\" data.input=u data.output=y" in printed
    assert (tmp_path / "my log_look.png").stat().st_size > 10_000
    text = Path("my log.csv").read_text().replace(",", ";").replace(".", ",")
    Path("german.txt").write_text(text)
    layout = ["--separator", "semicolons", "--decimal", ",", "--header", "true"]
    actual = main(["look", "german.txt", *layout, "--picture", "seen.png"])
    assert actual == 0
    settings = "data.separator=semicolons data.decimal=\"','\" data.header=true"
    assert settings in capsys.readouterr().out
    assert (tmp_path / "seen.png").is_file()


def test_a_log_that_cannot_be_read_yet_says_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    u = [0.0, 1.0, 2.0] * 40
    y = np.arange(120.0) ** 2
    table = pd.DataFrame({"u": u, "y": y})
    table.to_csv(path, index=False)
    text = str(look(path))
    assert "the sampling time is unknown" in text
    assert "noise" not in text  # 120 rows
    assert text.endswith("data.step_s=SECONDS")
    kind_named("dead_time").log(0)[["u", "y"]].to_csv(path, index=False)
    seen = look(path)
    lag = next(line for line in seen.sentences if line.startswith("dead time"))
    assert "samples" in lag
    assert not seen.step_is_known
    assert str(seen).endswith("data.step_s=SECONDS")
    path.write_text("no numbers here\nat all\n")
    with pytest.raises(BadRequest, match="no rows of numbers"):
        look(path)


def test_named_columns_are_not_measured_too(tmp_path: Path) -> None:
    """They are named without their units, by number, or in other letters."""
    path = tmp_path / "log.csv"
    columns = {"u": "Heat [%]"}
    table = kind_named("direction").log(0, samples=400).rename(columns=columns)
    table.assign(**{"Out (C)": np.arange(400.0) % 7}).to_csv(path, index=False)
    for name in ("Heat", "heat", "Heat [%]", str(list(table).index("Heat [%]"))):
        log_look = look(path, input=name, output="y")
        sentences = log_look.sentences
        others = [one for one in sentences if "too:" in one]
        assert others[0].startswith("measured too: Out (C);")


@pytest.mark.parametrize("lag_samples", [50, 400, 2000])
def test_a_slow_lag_is_no_integrator(lag_samples: int) -> None:
    """Over a few samples a slow lag sums its input, too, but it forgets within the log."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 100), 40)
    y = np.zeros(4000)
    for k in range(1, 4000):
        difference = u[k - 1] - y[k - 1]
        y[k] = y[k - 1] + difference / lag_samples
    assert not explained_output_variance(u, y).is_integrator
    running_sum = np.cumsum(u)
    assert explained_output_variance(u, running_sum).is_integrator


def test_in_a_log_shorter_than_every_window_nothing_is_explained() -> None:
    u = np.arange(5.0)
    shares = explained_output_variance(u, u)
    assert shares.level == 0.0
    assert shares.change == 0.0
    assert shares.lost == 1.0


def test_a_slow_answer_is_seen_in_coarser_steps() -> None:
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1, 1, 100), 80)
    x = np.convolve(u, 1 / 60 * np.exp(-np.arange(400) / 60))[: len(u)]
    y = np.convolve(x, 1 / 60 * np.exp(-np.arange(400) / 60))[: len(u)]
    white_noise = rng.standard_normal(len(y))
    y += 0.01 * white_noise
    assert first_response_lag(u, y) is None
    shares = explained_output_variance(u, y)
    expected = response_delay_sentence(u, y, shares)
    assert "slow" in expected


def test_a_column_that_counts_is_no_signal(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal(500)
    t = 0.01 * np.arange(500)
    n = np.arange(500)
    angle = np.cumsum(u)
    columns = {"t": t, "n": n, "u": u, "angle": angle}
    table = pd.DataFrame(columns)
    table[["t", "n", "angle", "u"]].to_csv(tmp_path / "log.csv", index=False)
    shown = look(tmp_path / "log.csv")
    assert shown.input == "u"
    assert shown.output == "angle"
    table = pd.DataFrame(columns)
    table[["t", "n", "u"]].to_csv(tmp_path / "counter.csv", index=False)
    output = look(tmp_path / "counter.csv").output
    assert output is None


def test_the_first_column_of_a_matrix_is_its_clock_if_it_runs_evenly(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    signals = rng.standard_normal((500, 2))
    clock = 0.02 * np.arange(500)[:, None]
    scipy.io.savemat(tmp_path / "log.mat", {"gain": 3.0, "data": np.hstack([clock, signals])})
    log_look = look(tmp_path / "log.mat", input="data:2", output="data:3")
    text = str(log_look)
    assert "clock data:1 (no unit: seconds); step 0.02 s" in text
    counted = np.hstack([np.arange(500)[:, None], signals])
    scipy.io.savemat(tmp_path / "rows.mat", {"data": counted})
    log_look = str(look(tmp_path / "rows.mat", input="data:2", output="data:3"))
    assert "no clock found" in log_look


@pytest.mark.parametrize("title", ["t_now", "time rel", "sensor_timestamp"])
def test_a_clocks_word_beside_others_names_a_clock_that_never_stands(
    tmp_path: Path, title: str
) -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal(500)
    clock = 0.1 * np.arange(500)
    y = np.cumsum(u)
    table = pd.DataFrame({"u": u, title: clock, "y": y})
    table.to_csv(tmp_path / "log.csv", index=False)
    log_look = str(look(tmp_path / "log.csv"))
    assert f"clock {title} (no unit: seconds); step 0.1 s" in log_look
    clock[10] = clock[9]
    y = np.cumsum(u)
    table = pd.DataFrame({"u": u, title: clock, "y": y})
    table.to_csv(tmp_path / "log.csv", index=False)
    log_look = str(look(tmp_path / "log.csv"))
    assert "no clock found" in log_look


def test_a_set_point_is_no_input(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    heater = rng.uniform(0, 100, 500)
    wanted = np.repeat([40.0, 50.0], 250)
    running_sum = np.cumsum(heater)
    columns = {"Time": 5.0 * np.arange(500), "T1": running_sum, "Q1": heater, "TSP1": wanted}
    table = pd.DataFrame(columns)
    table.to_csv(tmp_path / "log.csv", index=False)
    shown = look(tmp_path / "log.csv")
    assert shown.input == "Q1"
    assert shown.output == "T1"
    assert "data.reference=TSP1" in str(shown)


@pytest.mark.parametrize(("gain_d", "is_loop"), [(3.0, True), (0.0, False)])
def test_a_loop_that_answers_within_the_sample_is_not_called_feedthrough(
    gain_d: float, is_loop: bool
) -> None:
    rng = np.random.default_rng(0)
    u = np.zeros(3000)
    y = np.zeros(3000)
    speed = position = 0.0
    set_point = np.repeat([1.0, 3.0, 0.0, 2.0] * 5, 150)
    for k in range(1, 3000):
        speed = 0.9 * speed + 0.02 * u[k - 1]
        position += speed
        white_noise = rng.standard_normal()
        y[k] = position + 0.02 * white_noise
        difference = set_point[k] - y[k]
        u[k] = 0.5 * difference - gain_d * (y[k] - y[k - 1])
    trajectory = Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)
    records = [trajectory]
    text = "\n".join(describe_log_dynamics(records))
    assert "which of them answers is not to be seen" in text
    assert "feedthrough" not in text
    assert ("a closed loop?" in text) is is_loop  # a gain alone is hardly to be told from the plant


def test_names_that_terminal_and_font_lack_are_escaped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A terminal without Chinese letters, and a figure without a font for them."""
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, 40), 10)
    y = scipy.signal.lfilter([0.1], [1, -0.9], u)
    path = tmp_path / "日志.csv"
    table = pd.DataFrame({"time": 0.1 * np.arange(400), "电压": u, "转速": y})
    table.to_csv(path, index=False)
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, encoding="latin-1"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        actual = main(["look", str(path), "--picture", str(tmp_path / "log.png")])
        assert actual == DONE
    sys.stdout.flush()
    assert rb"\u7535\u538b" in printed.getvalue()


def test_ends_of_pieces_at_other_values_are_no_rests() -> None:
    """Each piece rests at a value of its own; the standstill at zero is named."""
    rng = np.random.default_rng(1)
    records = []
    for start in (0.0, 1.0):
        still = np.full(300, start)
        levels = rng.uniform(-1, 1, 20)
        held = np.repeat(levels, 30)
        u = np.concatenate([still, held])
        y = scipy.signal.lfilter([0.0, 0.2], [1, -0.8], u - start)
        record = Trajectory(u=u[:, None], y=y[:, None], step_s=0.01)
        records.append(record)
    sentences = describe_log_dynamics(records)
    assert not any("times at" in sentence for sentence in sentences)
    assert sentences[0].startswith("standstill: input 0, output 0, for 3")
    period = np.repeat([1.0, 0.0], 100)
    back = np.tile(period, 5)
    y = scipy.signal.lfilter([0.0, 0.2], [1, -0.8], back)
    record = Trajectory(u=back[:, None], y=y[:, None], step_s=0.01)
    rests = describe_log_dynamics([record])
    assert any("rests 5 times at one value" in sentence for sentence in rests)
