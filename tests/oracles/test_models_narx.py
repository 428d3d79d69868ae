"""ARX, output error and NARX: the system is found, and what each cannot do is seen."""

from dataclasses import replace

import numpy as np
import pytest

from ssm_study.data.assembly import assemble_dataset
from ssm_study.models import baseline_comparison
from ssm_study.models.baseline_comparison import baseline_columns
from ssm_study.models.baselines.regression import (
    NarxModel,
    fit_arx,
    fit_narx_models,
    fit_output_error,
    regression_arrays,
    select_regressors,
)
from ssm_study.models.baselines.solved import NARX, OutputError
from ssm_study.models.baselines.starts import (
    OUTPUTS,
    RUN_IN,
    arx_to_state_space,
    simulate_by_kind_of_start,
)
from ssm_study.models.best_baseline import Baseline, fit_baselines, fit_best_baseline
from ssm_study.models.initial_system import fit_arx_matrices
from ssm_study.models.warm_start import PAST, SAMPLES
from ssm_study.refusal import BadRequest
from ssm_study.report.outcome import baseline_text
from ssm_study.signals import Channel, DataSet, Scale, Trajectory, fit_percent
from ssm_study.training.metrics import records_fit_percent

KNOWN = {1001: 1.2, 1002: -0.5, 2001: 0.3}  # y[k] = 1.2 y[k-1] - 0.5 y[k-2] + 0.3 u[k-1]
INPUT = Channel(name="u", unit="V")
OUTPUT = Channel(name="y", unit="m")
CHANNELS = (INPUT,), (OUTPUT,)


def record(samples: int, seed: int, noise: float = 0.0, product: float = 0.0) -> Trajectory:
    """Begins in motion, so that the joint to the record before is a jump."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=samples)
    y = 3.0 * rng.normal(size=samples)
    for k in range(2, samples):
        from_outputs = KNOWN[1001] * y[k - 1] + KNOWN[1002] * y[k - 2]
        y[k] = from_outputs + KNOWN[2001] * u[k - 1]
        y[k] += product * u[k - 1] * y[k - 1]
    y = y + noise * rng.normal(size=samples)
    return Trajectory(u=u[:, None], y=y[:, None], step_s=0.1)


def records(start_up: int = 0, **how: float) -> DataSet:
    short = record(12 + start_up, 1, **how)
    training = (record(600, 0, **how), short)
    validation = (record(200, 2, **how),)
    parts = training, validation
    zero = np.zeros(1)
    rest = (zero, zero)
    test = (record(200, 3, **how),)
    return assemble_dataset((*parts, test), rest, CHANNELS, start_up)


def test_no_row_reaches_across_two_records() -> None:
    ramp = np.arange(4.0)[:, None]
    first = (ramp, 10.0 + ramp)
    short_ramp = np.arange(3.0)[:, None]
    second = (100.0 + short_ramp, 200.0 + short_ramp)
    codes = [1001, 2002]
    rows, target = regression_arrays([first, second], codes)
    expected = [[11, 0], [12, 1], [201, 100]]
    np.testing.assert_array_equal(rows, expected)
    expected = [12, 13, 202]
    np.testing.assert_array_equal(target, expected)


@pytest.mark.parametrize("terms", [3, None])
def test_the_system_is_found_from_records_that_do_not_join(terms: int | None) -> None:
    data = records()
    narx = NARX(lags=2, degree=1, terms=terms)
    found = narx.fit_model(data)
    input_scale = data.scale.input_scale
    output_scale = data.scale.output_scale
    gain = float(input_scale[0] / output_scale[0])
    coefficients = zip(found.codes, found.theta, strict=True)
    theta = {int(code): value for (code,), value in coefficients}
    expected = KNOWN | {2001: KNOWN[2001] * gain}
    for code, value in expected.items():
        assert theta[code] == pytest.approx(value, abs=1e-3)


def test_forward_selection_takes_the_columns_that_explain() -> None:
    rng = np.random.default_rng(0)
    candidates = rng.normal(size=(200, 6))
    target = 3.0 * candidates[:, 4] - candidates[:, 1]
    repeated = np.column_stack([candidates, candidates[:, 4]])
    expected = [4, 1]
    assert select_regressors(repeated, target, 2) == expected
    assert len(select_regressors(repeated, target, 10)) == 6  # the copy is never taken


def test_output_error_is_unbiased_where_arx_is_not() -> None:
    """Noise on the output biases the poles of ARX; the free run's error does not care."""
    data = records(noise=1.0)
    poles = {}
    oe = fit_output_error(data, 2, 1)
    narx = NARX(lags=2, degree=1)
    arx = narx.fit_model(data)
    for name, model in {"oe": oe, "arx": arx}.items():
        poles[name] = model.theta[1:3]
    expected = [1.2, -0.5]
    assert poles["oe"] == pytest.approx(expected, abs=0.06)
    difference = abs(poles["arx"][0] - 1.2)
    assert difference > 0.2


def test_the_best_baseline_of_a_product_is_a_polynomial(monkeypatch: pytest.MonkeyPatch) -> None:
    data = records(start_up=20, product=0.15, noise=0.02)
    baselines = fit_baselines(data)
    monkeypatch.setattr(baseline_comparison, "fit_baselines", lambda _: baselines)
    best = max(baselines, key=lambda each: each.fit_validation_percent)
    assert "NARX" in best.words
    assert records_fit_percent(best.model, data.test, data) > 90.0
    model = OutputError(order=2).fit_model(data)
    linear = records_fit_percent(model, data.test, data)
    upper_limit = records_fit_percent(best.model, data.test, data) - 5.0
    assert linear < upper_limit
    columns = baseline_columns(data)
    assert columns is not None
    near = [
        each.test_fit_percent(data)
        for each in baselines
        if each.fit_validation_percent >= best.fit_validation_percent - 1.0
    ]
    assert columns["fit_baseline_lowest_percent"] == pytest.approx(min(near))
    assert columns["fit_baseline_highest_percent"] == pytest.approx(max(near))


def test_of_two_outputs_each_has_a_baseline_and_both_are_scored_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fit_small_arx(part: DataSet) -> Baseline:
        words = f"ARX of {part.outputs[0].name}"
        return Baseline(words=words, model=fit_arx(part, 2, 1), fit_validation_percent=0.0)

    monkeypatch.setattr(baseline_comparison, "fit_best_baseline", fit_small_arx)
    both = with_second_output(records(start_up=20, noise=0.02))
    columns = baseline_columns(both)
    assert columns is not None
    assert columns["baseline"] == "y: ARX of y; speed: ARX of speed"
    simulated = []
    for number in range(2):
        part = both.with_one_output(number)
        model = fit_arx(part, 2, 1)
        runs = simulate_by_kind_of_start(model, part, part.test)
        simulated.append(runs[OUTPUTS].simulated[0])
    y_hat = np.hstack(simulated)
    by_hand = fit_percent(both.test[0].y, y_hat, 20)
    assert columns["fit_baseline_percent"] == pytest.approx(by_hand, rel=1e-12)
    assert baseline_text(columns).endswith("y: ARX of y; speed: ARX of speed")


def with_second_output(data: DataSet) -> DataSet:
    """The same records with the differences of the output as a second output."""
    parts = []
    for part in (data.training, data.validation, data.test):
        parts.append(tuple(with_difference(record) for record in part))
    rest = (np.zeros(1), np.zeros(2))
    speed = Channel(name="speed", unit="m/s")
    channels = ((INPUT,), (OUTPUT, speed))
    return assemble_dataset(tuple(parts), rest, channels, data.start_up_samples)


def with_difference(record: Trajectory) -> Trajectory:
    differences = np.diff(record.y, axis=0, prepend=record.y[:1])
    return replace(record, y=np.hstack([record.y, differences]))


def test_a_wide_spread_of_baselines_is_said() -> None:
    record = {"fit_baseline_percent": 71.0, "baseline": "ARX", "fit_test_percent": 60.0}
    narrow = {"fit_baseline_lowest_percent": 70.0, "fit_baseline_highest_percent": 72.0}
    wide = {"fit_baseline_lowest_percent": 0.4, "fit_baseline_highest_percent": 74.5}
    diverges = {"fit_baseline_lowest_percent": None, "fit_baseline_highest_percent": 74.5}
    words = "71.0 %, ARX{}: it predicts better than this model"
    assert baseline_text(record | narrow) == words.format("")
    spread = " (0.4 to 74.5 % with those that validate as well)"
    assert baseline_text(record | wide) == words.format(spread)
    assert "divergence to 74.5 %" in baseline_text(record | diverges)


def test_measured_start_up_samples_are_the_past_of_a_regression() -> None:
    data = records(start_up=20)
    narx = NARX(lags=2, degree=1)
    model = narx.fit_model(data)
    assert records_fit_percent(model, data.test, data) > 99.9
    piece = data.test[0]
    response = model.simulate(piece.u)
    from_rest = response[:40] - piece.y[:40]
    largest = np.abs(from_rest).max()
    assert largest > 0.5


def test_lags_longer_than_every_record_are_refused() -> None:
    narx = NARX(lags=600, degree=1)
    with pytest.raises(BadRequest, match="longest training record has 600 samples"):
        narx.fit_model(records())


def slow_records() -> DataSet:
    """Records of a slow lag with a coarse sensor, cut from one log."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.normal(size=40), 50)
    y = np.zeros(2000)
    for k in range(1, 2000):
        y[k] = 0.98 * y[k - 1] + 0.02 * u[k - 1]
    noisy = y + 0.2 * y.std() * rng.normal(size=2000)
    log = Trajectory(u=u[:, None], y=noisy[:, None], step_s=0.1, log=1)
    parts = (log[:1400],), (log[1400:1700],), (log[1700:],)
    zero = np.zeros(1)
    return assemble_dataset(parts, (zero, zero), CHANNELS, 20)


def test_a_baseline_does_not_start_from_one_noisy_output() -> None:
    """A slow mode carries the noise of the first outputs on; a state from the past has none."""
    data = slow_records()
    model = fit_output_error(data, 1, 1)
    runs = simulate_by_kind_of_start(model, data, data.test)
    fits = {start: run.fit_percent for start, run in runs.items()}
    assert fits[PAST] > fits[OUTPUTS] + 1.0
    assert fits[SAMPLES] > fits[OUTPUTS]
    best = fit_best_baseline(data)
    assert best is not None
    assert best.start != OUTPUTS


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_linear_recursion_is_the_same_as_its_state_space(delay: int) -> None:
    data = records(start_up=20)
    arx = fit_arx(data, 3, delay)
    system = arx_to_state_space(arx, data.step_s)
    u = data.test[0].u
    assert system.simulate(u) - system.simulate(0 * u) == pytest.approx(
        arx.simulate(u) - arx.simulate(0 * u), abs=1e-9
    )


def test_a_polynomial_runs_through_the_log_before_a_record() -> None:
    data = slow_records()
    model = next(fit_narx_models(data, 1, 2, 1, [3]))
    run = simulate_by_kind_of_start(model, data, data.test)[PAST]
    past = data.validation[0][-RUN_IN:]
    whole = np.concatenate([past.u, data.test[0].u])
    expected = model.simulate_from_outputs(whole, past.y[:20])[len(past) :]
    np.testing.assert_array_equal(run.simulated[0], expected)


@pytest.mark.parametrize("short", [3, 9, 12, 20])
def test_pieces_shorter_than_the_lags_change_no_arx_model(short: int) -> None:
    """A log that is cut at every missing row has such pieces."""
    long_record = record(400, 1)
    pairs = [(long_record.u, long_record.y)]
    piece = record(short, 2)
    expected = fit_arx_matrices(pairs, 20, True)
    found = fit_arx_matrices([*pairs, (piece.u, piece.y)], 20, True)
    for matrices, matrices_without in zip(found, expected, strict=True):
        np.testing.assert_array_equal(matrices, matrices_without)


@pytest.mark.parametrize("short", [1, 5, 9])
def test_a_piece_shorter_than_a_lag_is_simulated(short: int) -> None:
    """No input of before the piece is known, so the term of that lag is zero throughout."""
    codes = np.array([[1001], [2010]])
    model = NarxModel(codes=codes, theta=np.array([0.5, 1.0]), scale=Scale.identity(1, 1))
    u = np.ones((short, 1))
    start = np.ones((1, 1))
    y = model.simulate_from_outputs(u, start)
    np.testing.assert_allclose(y[:, 0], 0.5 ** np.arange(short))
