"""Start of a test piece, from the past of its log or from its first samples; the truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from ssm_study.data.assembly import assemble_dataset
from ssm_study.data.splits import split_by_time, split_into_blocks
from ssm_study.evidence import fit
from ssm_study.evidence.finding import EvidenceCase
from ssm_study.models.identified import SSM
from ssm_study.models.metrics import Simulation
from ssm_study.models.warm_start import (
    PAST,
    SAMPLES,
    choose_initial_state_source,
    initial_state_columns,
    preceding_log,
    simulate_validation_and_test,
    state_from_preceding_log,
)
from ssm_study.signals import Channel, DataSet, Trajectory
from ssm_study.systems import StateSpace

SLOW = 0.995
START_UP = 20


def model() -> SSM:
    """A slow and a fast lag whose sum is the output: twenty samples hardly show the slow one."""
    a = np.diag([SLOW, 0.5])
    b = np.array([[1 - SLOW], [0.5]])
    c = np.ones((1, 2))
    d = np.zeros((1, 1))
    linear = StateSpace(a=a, b=b, c=c, d=d)
    return SSM.from_linear(linear, 0.1)


def log(*, noise: float = 0.0, drift: float = 0.0, samples: int = 3000) -> Trajectory:
    """Answer of the model to random levels, with coloured noise and a load that is in no input."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1, 1, samples // 50), 50)[:, None]
    y = model().simulate(u)
    white_noise = rng.standard_normal(samples)
    running_sum = np.cumsum(white_noise)
    wander = running_sum[:, None]
    white_noise = rng.standard_normal(samples)
    filtered_signal = scipy.signal.lfilter([1.0], [1.0, -0.9], white_noise)
    coloured = filtered_signal[:, None]
    y = y + noise * coloured + drift * wander
    return Trajectory(u=u, y=y, step_s=0.1, log=1)


def cut(record: Trajectory, splitter=None) -> DataSet:
    parts = split_by_time(record, 0.2, 0.2) if splitter is None else splitter(record)
    rest = (np.zeros(1), np.zeros(1))
    channel = Channel(name="u", unit="")
    channels = ((channel,), (Channel(name="y", unit=""),))
    data = assemble_dataset(parts, rest, channels, START_UP)
    scale = model().scale
    return replace(data, scale=scale)


def test_the_state_from_the_past_is_that_of_the_plant() -> None:
    record = log()
    data = cut(record)
    piece = data.test[0]
    state = state_from_preceding_log(model(), data, piece)
    linear = model().linear
    first = data.test[0].first
    _, expected = linear.simulate(record.u[:first])
    assert state is not None
    np.testing.assert_allclose(state, expected, atol=1e-3)


def test_noise_over_the_first_samples_prefers_the_past_and_a_wandering_load_the_samples() -> None:
    noisy = cut(log(noise=0.1))
    piece_starts = choose_initial_state_source(model(), noisy)
    choice = piece_starts.choice
    assert choice == PAST
    wandering = cut(log(drift=0.1))
    piece_starts = choose_initial_state_source(model(), wandering)
    choice = piece_starts.choice
    assert choice == SAMPLES


@pytest.mark.parametrize("splitter", [None, split_into_blocks])
def test_the_headline_is_that_of_the_choice_and_the_other_fit_is_a_column(splitter) -> None:
    data = cut(log(noise=0.1), splitter)
    validation, test = simulate_validation_and_test(model(), data)
    facts = initial_state_columns(model(), data, test)
    from_samples = Simulation.simulate_records(model(), data.test, START_UP)
    assert facts["piece_start"] == PAST
    assert facts["fit_test_other_start_percent"] == from_samples.fit_percent
    assert test.fit_percent > from_samples.fit_percent
    states = (*validation.starts, *test.starts)
    assert all(state is not None for state in states)


def test_a_doubt_has_both_fits_where_they_differ_by_more_than_ten_points() -> None:
    data = cut(log(noise=0.1))
    from_samples = Simulation.simulate_records(
        model(), data.test, START_UP, (np.array([3.0, 0.0]),)
    )
    validation, test = simulate_validation_and_test(model(), data)
    case = EvidenceCase(data=data, model=model(), validation=validation, test=test)
    fit_test_other_start_percent = initial_state_columns(model(), data, test)[
        "fit_test_other_start_percent"
    ]
    difference = fit_test_other_start_percent - test.fit_percent
    apart = abs(difference)
    expected = int(apart > fit.STARTS_APART)
    assert len(fit.judge_initial_state(case)) == expected
    changed_case = replace(case, test=from_samples)
    (finding,) = fit.judge_initial_state(changed_case)
    assert finding.level == "doubt"
    assert f"{from_samples.fit_percent:.1f} % from the log before it" in finding.sentence
    assert "from its first samples" in finding.sentence


def test_a_record_without_a_past_has_one_start() -> None:
    """Simulated records, the beginning of a log, a piece behind a hole, no start-up samples."""
    simulated = cut(replace(log(), log=0))
    piece_starts = choose_initial_state_source(model(), simulated)
    choice = piece_starts.choice
    assert choice is None
    parts = simulate_validation_and_test(model(), simulated)
    test = parts[1]
    piece_start = initial_state_columns(model(), simulated, test)["piece_start"]
    assert piece_start is None
    data = cut(log())
    piece = data.training[0]
    assert preceding_log(data, piece) is None
    first = data.test[0].first + 7
    behind_a_hole = replace(data.test[0], first=first)
    changed_data = replace(data, test=(behind_a_hole,))
    assert preceding_log(changed_data, behind_a_hole) is None
    from_rest = replace(data, start_up_samples=0)
    piece_starts = choose_initial_state_source(model(), from_rest)
    choice = piece_starts.choice
    assert choice is None
