"""Numbers that the sentences of the evidence state, and what is computed for them, by a second
formula."""

import numpy as np
import pytest
import scipy
from test_evidence_limits import case_of, data_of, missing_shares

from ssm_study.evidence import feedback, fit
from ssm_study.signals import fit_percent


@pytest.mark.usefixtures("no_filter")
@pytest.mark.parametrize("share", [0.3, 0.8])
def test_the_power_that_the_model_misses_is_stated_in_percent(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit, "unmodelled_output_share", lambda _: share)
    judged = missing_shares(0.25, 0.25)
    (finding,) = fit.judge_fit(judged)
    percent = round(100 * share)
    words = f"The model misses {percent} % of the output's power, "
    assert finding.sentence.startswith(words)


@pytest.fixture
def no_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """A linear filter that fits nothing."""
    monkeypatch.setattr(fit, "fir_fit_percent", lambda _: 0.0)


@pytest.mark.parametrize(("share", "text"), [(0.01644, "1.6"), (0.01996, "2")])
def test_the_error_relative_to_the_range_is_stated_in_percent(
    share: float, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit, "rms_error_relative_to_range", lambda _: share)
    judged = missing_shares(0.9, 0.9)
    (finding,) = fit.judge_poor_fit(judged)
    assert f"its error is {text} % of the output's range" in finding.sentence


def test_the_pooled_fit_is_that_of_both_records_about_their_own_means() -> None:
    """However small the output, for it is in units of the training records."""
    rng = np.random.default_rng(0)
    trained = rng.standard_normal(400)
    shape = (2, 400)
    small_signals = rng.standard_normal(shape)
    validated, tested = 0.01 * small_signals
    white_noise = rng.standard_normal(shape)
    errors = 0.003 * white_noise
    validation = validated + 1
    test = tested - 2
    data = data_of(trained, validation, test)
    judged = case_of(data, *errors)
    centred = [part - part.mean() for part in (validated, tested)]
    joined = np.concatenate(centred)
    true = joined[:, None]
    joined = np.concatenate(errors)
    missed = joined[:, None]
    simulated = true - missed
    both = fit_percent(true, simulated)
    assert fit.pooled_fit_percent(judged) == pytest.approx(both, abs=0.1)


def test_records_that_stand_still_have_no_pooled_fit() -> None:
    still = np.ones(400)
    moving = np.resize([1.0, -1.0], 400)
    data = data_of(moving, still, still)
    error = 0.1 * still
    judged = case_of(data, error, error)
    assert fit.pooled_fit_percent(judged) == -np.inf


@pytest.mark.parametrize("offset", [0.0, 3.0, -50.0])
def test_the_t_statistic_of_a_slope_is_that_of_the_correlation(offset: float) -> None:
    """`t = r sqrt((n - 2) / (1 - r^2))`, wherever the regressor lies."""
    rng = np.random.default_rng(1)
    spread = rng.standard_normal(60)
    x = offset + spread
    white_noise = rng.standard_normal(60)
    y = 0.4 * x + white_noise
    correlation = scipy.stats.pearsonr(x, y)
    r = correlation.statistic
    shape = (60, 1)
    ones = np.ones(shape)
    t = feedback._last_coefficient_t_statistic(ones, y, x)
    unexplained = 1 - r**2
    expected = r * np.sqrt(58 / unexplained)
    assert t == pytest.approx(expected, rel=1e-6)


LENGTHS = [(6, 0), (7, 4), (12, 9)]


@pytest.mark.parametrize(("samples", "rows"), LENGTHS)
def test_records_longer_than_twice_the_lags_give_a_row_for_each_later_sample(
    samples: int, rows: int
) -> None:
    numbers = np.arange(samples)
    signal = numbers % 5.0
    trained = np.arange(9.0)
    data = data_of(trained, signal, signal)
    error = np.zeros(samples)
    judged = case_of(data, error, error)
    past, y = judged.fir_regression_arrays(data.validation, 3)
    assert past.shape == (rows, 5)
    assert len(y) == rows
    if rows:
        (record,) = data.validation
        u, output = judged.scale_record(record)
        later = output[3:]
        np.testing.assert_array_equal(y, later)
        backwards = u[3::-1, 0]
        first_row = [*backwards, 1.0]
        np.testing.assert_array_equal(past[0], first_row)
