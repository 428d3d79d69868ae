"""The mismatch that a record shows at its amplitude: noise told from what repeats, phase from size,
rest from what is left."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_cases import BALLS, motor, motor_design, motor_model
from test_loop_prediction import ONES, linear_model

from ssm_study.data.simulated import (
    DECAYS,
    LEAD_IN,
    PERIOD,
    RETURNS,
    SHARES,
    simulate_mismatch_records,
)
from ssm_study.models.identified import SSM
from ssm_study.robustness.mismatch import BAND, Mismatch, measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.return_to_rest import AT_REST
from ssm_study.signals import Trajectory, find_repetition
from ssm_study.study.stages.mismatch import read_mismatch, write_mismatch
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Gains


@given(st.integers(0, 10_000), st.integers(32, 90), st.integers(0, 70), st.integers(0, 70))
def test_two_equal_pieces_are_found_wherever_they_are(seed, period, before, after):
    rng = np.random.default_rng(seed)
    piece = rng.standard_normal((period, 1))
    white_noise = rng.standard_normal((before, 1))
    rest_after = np.zeros((after, 1))
    u = np.concatenate([white_noise, piece, piece, rest_after])
    expected = (before, period)
    assert find_repetition(u) == expected
    u[before + period // 2] += 1e-3
    assert find_repetition(u) is None


def test_a_signal_that_rests_or_holds_its_levels_does_not_repeat():
    u = np.zeros((500, 1))
    assert find_repetition(u) is None
    rng = np.random.default_rng(0)
    levels = rng.uniform(-1, 1, 40)
    u = np.repeat(levels, 20)[:, None]
    assert find_repetition(u) is None


def twice(model: SSM, missed, noise: float, amplitude: float = 1.0, seed: int = 0) -> Trajectory:
    """Two periods of white input; the output misses the model by `missed` of the scaled input, plus
    sensor noise."""
    rng = np.random.default_rng(seed)
    white_noise = rng.standard_normal((1024, 1))
    u = amplitude * np.tile(white_noise, (3, 1))
    response = model.simulate(u)
    sensor_noise = noise * rng.standard_normal(u.shape)
    y = response + missed(u) + sensor_noise
    return Trajectory(u=u, y=y, step_s=0.01)


def test_noise_of_the_sensor_is_not_mismatch_and_distortion_is():
    """`e = 0.3 |u|` is the mismatch that a cross spectrum of u and e does not show; it repeats, so
    it stays."""
    model = linear_model(0)
    trajectory = twice(model, lambda u: 0.3 * np.abs(u), 0.0)
    quiet = measure_model_error(model, (trajectory,))
    noisy_record = twice(model, lambda u: 0.3 * np.abs(u), 0.2)
    noisy = measure_model_error(model, (noisy_record,))
    expected = 0.3 * np.sqrt(1 - 2 / np.pi)
    assert quiet.gain == pytest.approx(expected, rel=0.05)  # the mean of |u| is no input's answer
    assert noisy.gain == pytest.approx(quiet.gain, rel=0.1)
    rest = noisy.views[0].rest
    median = np.median(rest / quiet.views[0].rest)
    assert median == pytest.approx(1.0, rel=0.2)
    record = twice(model, lambda u: 0.3 * np.abs(u), 0.2)
    once = replace(record, name="once")
    y = once.y[:1024]
    cut = Trajectory(u=once.u[:1024], y=y, step_s=0.01)
    mismatch = measure_model_error(model, (cut,))
    gain = mismatch.gain
    assert gain > 1.5 * quiet.gain
    mean = np.mean(noisy.noise)
    assert mean == pytest.approx(0.2**2, rel=0.1)
    assert max(quiet.noise) < 1e-20
    mismatch = measure_model_error(model, (cut,))
    noise = mismatch.noise
    assert noise == ()  # measured only where an input repeats


def radius(model: SSM, pair: Gains, factor: float) -> float:
    """Spectral radius of the loop of a plant that answers `1 + factor` times what the model does:
    states (x, estimate)."""
    a, b, c, d = (getattr(model.linear, name) for name in "abcd")
    k = pair.k
    more = 1 + factor
    injected = pair.l @ c - factor * pair.l @ d @ k
    plant_rows = [a, b @ k]
    observer_rows = [-more * pair.l @ c, a + b @ k + injected]
    matrix = np.block([plant_rows, observer_rows])
    eigenvalues = np.linalg.eigvals(matrix)
    spectral_radius = np.abs(eigenvalues).max()
    return float(spectral_radius)


@pytest.mark.parametrize("seed", range(2))
def test_a_linear_mismatch_is_all_phase_and_the_loop_is_judged_exactly(seed):
    """The plant is the model plus its own answer times a factor: with a phase the verdict is the
    loop's own."""
    model = linear_model(seed)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3, input_weight=0.01)
    design = riccati_synthesis.design(model, ONES)
    verdicts = set()
    for factor in (-0.95, -0.5, 0.5, 1.5, 3.0, 8.0):
        record = twice(model, lambda u, f=factor: f * model.simulate(u), 0.0)
        shown = measure_model_error(model, (record,))
        view = shown.views[0]
        np.testing.assert_allclose(view.linear, factor, rtol=1e-6)
        largest = view.rest.max()
        upper_limit = 1e-6 * view.by_frequency.max()
        assert largest < upper_limit
        norm = np.linalg.norm(record.u)
        expected = norm / np.sqrt(record.u.size)
        assert view.amplitude == pytest.approx(expected, rel=0.1)
        resolved_margin = predict_margins(model, design.gain_pair, ONES, shown).resolved_margin
        found = resolved_margin > 1
        stable = radius(model, design.gain_pair, factor) < 1
        assert found == stable
        verdicts.add(stable)
    assert verdicts == {True, False} or seed  # both answers occur


def test_no_phase_is_read_from_noise_below_the_largest_amplitude():
    """Two records of the model itself under noise: at the smaller amplitude what the noise alone
    answers is dropped."""
    model = linear_model(0)
    records = [twice(model, lambda u: 0 * u, 0.2, a, seed) for seed, a in enumerate((0.3, 1.0))]
    mismatch = measure_model_error(model, tuple(records))
    small, large = mismatch.views
    assert small.amplitude < large.amplitude
    mean = np.mean(small.linear != 0)
    assert mean < 0.1
    mean = np.mean(large.linear != 0)
    assert mean > 0.2
    mismatch = measure_model_error(model, tuple(records[:1]))
    views = mismatch.views
    linear = views[0].linear
    assert np.any(linear)  # alone it is the largest


def test_of_the_two_conditions_the_better_one_counts():
    """A mismatch that is all phase costs no margin, whether small gain passes it or not."""
    model = linear_model(0)
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3, input_weight=0.01)
    design = riccati_synthesis.design(model, ONES)
    small_gain = set()
    for factor in (0.02, -0.95, 0.5, 1.5, 3.0, 8.0):
        if radius(model, design.gain_pair, factor) >= 1:
            continue
        trajectory = twice(model, lambda u, f=factor: f * model.simulate(u), 0.0)
        shown = measure_model_error(model, (trajectory,))
        views = tuple(replace(v, linear=0 * v.linear, rest=v.by_frequency) for v in shown.views)
        sizes = replace(shown, views=views)
        resolved_margin = predict_margins(model, design.gain_pair, ONES, sizes).resolved_margin
        small_gain.add(resolved_margin > 1)
        resolved_margin = predict_margins(model, design.gain_pair, ONES, shown).resolved_margin
        assert resolved_margin > 1e4
    assert small_gain == {True, False}


@pytest.mark.parametrize("seed", range(2))
def test_an_offset_at_rest_counts_by_what_the_loop_leaves_of_it(seed):
    """The loop run with an offset of the output, sample by sample, against the margin; integrators
    leave nothing."""
    model = linear_model(seed)
    no_feedthrough = np.zeros((1, 1))
    linear = replace(model.linear, d=no_feedthrough)
    model = model.with_linear_part(linear)
    moderate = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3, input_weight=0.01)
    design = moderate.design(model, ONES)
    careful = RiccatiSynthesis(rate_controller=0.01, rate_observer=0.1)
    a, b, c, d = (getattr(model.linear, name) for name in "abcd")
    x = np.zeros(3)
    x_hat = np.zeros(3)
    offset = 0.04
    for _ in range(3000):
        u = design.gain_pair.k @ x_hat
        y = c @ x + d @ u + offset
        x = a @ x + b @ u
        pair_l = design.gain_pair.l
        difference = c @ x_hat + d @ u - y
        x_hat = a @ x_hat + b @ u + pair_l @ difference
    trajectory = twice(model, lambda u: 1e-9 * u, 0.0)
    mismatch = measure_model_error(model, (trajectory,))
    view = mismatch.views
    for stuck, farthest in (((offset, 0.03), 1.0), ((0.1, 10 * offset, 0.3), 2.0), ((), 1.0)):
        shown = Mismatch(views=view, stuck=stuck, farthest=farthest)
        found = predict_margins(model, design.gain_pair, ONES, shown)
        largest = max(stuck, default=0.0)
        power_mean = {2: np.sqrt(20), 3: np.cbrt(20), 0: 0}
        worst = largest * power_mean[len(stuck)]
        offset_left = abs(float(y[0])) / offset
        left = offset_left * worst / (BAND * farthest)  # in bands
        if stuck:
            assert found.resolved_margin == pytest.approx(1 / left, rel=1e-3)
        expected = left < 1 and found.controller_radius < 1
        assert found.predicts_stability() == expected
        changed_careful = replace(careful, internal_model=["step"], integral_weight=0.01)
        integral = changed_careful.design(model, ONES)
        resolved_margin = predict_margins(model, integral.gain_pair, ONES, shown).resolved_margin
        assert resolved_margin > 5  # at 1e-4 rad/sample, not at 0


def test_between_two_amplitudes_lies_what_neither_shows():
    """A gain of 0.1 at one amplitude and 6 at another: each loop is stable, the ones between are
    not all."""
    model = linear_model(1)
    scale = 3.0
    riccati_synthesis = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3)
    design = riccati_synthesis.design(model, ONES)
    turned = [
        twice(model, lambda u, f=f: f * model.simulate(u), 0.0, a)
        for f, a in ((-1.0, 0.1), (0.0, scale))
    ]
    alone = [
        predict_margins(
            model, design.gain_pair, ONES, measure_model_error(model, (one,))
        ).resolved_margin
        for one in turned
    ]
    mismatch = measure_model_error(model, tuple(turned))
    both = predict_margins(model, design.gain_pair, ONES, mismatch).resolved_margin
    assert both <= min(alone)


def test_a_plant_that_does_not_rest_has_a_mismatch_without_bound():
    model = motor_model()
    rng = np.random.default_rng(0)
    record = twice(model, lambda u: 0.01 * u, 0.0)
    still = np.zeros((600, 1))
    k = np.arange(600)[:, None]
    white_noise = rng.standard_normal(still.shape)
    noise = 0.5 * white_noise  # a tenth of the output's scale of 5
    scale = model.scale.output_scale[0]
    angles = (0.2, 2.6)
    slow, fast = (0.2 * scale * np.cos(angle * k) for angle in angles)
    for left, rests in ((0 * k, True), (0.5 * AT_REST * scale * k**0, True), (slow, False), (fast,
                                                                                             False),
                        (0.1 * scale * k**0, False), (3 * scale * np.exp(-k / 30),
                                                      True)):  # fmt: skip
        changed_output = left + noise
        trajectory = Trajectory(u=still, y=changed_output, step_s=0.01)
        shown = measure_model_error(model, (record,), 0, (trajectory,))
        assert shown.plant_comes_to_rest == rests
        pair = motor_design().gain_pair
        margin = predict_margins(model, pair, BALLS, shown).resolved_margin
        assert (margin > 0) == rests
        actual = np.isfinite(shown.largest_recorded_gain)
        assert actual == rests


def test_trials_are_two_periods_at_each_amplitude_then_rest_then_free_decays_and_slow_returns():
    rng = np.random.default_rng(3)
    deviation = np.array([0.1])
    records = simulate_mismatch_records(motor(), rng, deviation)
    expected = len(SHARES) + len(DECAYS) + len(RETURNS)
    assert len(records) == expected
    largest = max(np.abs(record.u).max() for record in records)
    upper_limit = motor().input_amplitude[0]
    assert largest <= upper_limit  # none goes beyond it
    for record, share in zip(records, SHARES, strict=False):
        expected = (LEAD_IN, PERIOD)
        assert find_repetition(record.u) == expected
        largest = np.abs(record.u).max()
        input_amplitude = motor().input_amplitude
        upper_limit = share * input_amplitude[0]
        assert largest <= upper_limit
        assert not record.u[-PERIOD // 2 :].any()
    slow_returns = records[-len(RETURNS) :]
    for record, share in zip(slow_returns, RETURNS, strict=True):
        input_amplitude = motor().input_amplitude
        expected = share * input_amplitude[0]
        actual = record.u[0, 0]
        assert actual == expected
        differences = np.diff(record.u[:, 0])
        largest = np.abs(differences).max()
        start = np.abs(record.u[0, 0])
        assert 0 < largest < start / 100
        assert not record.u[-PERIOD // 2 :].any()
    free_decays = records[len(SHARES) :]
    for record, share in zip(free_decays, DECAYS, strict=False):
        assert not record.u.any()
        start = record.y[0, 0]
        assert start == pytest.approx(4.0 * share, abs=0.5)
    rng = np.random.default_rng(3)
    deviation = np.array([0.1])
    again = simulate_mismatch_records(motor(), rng, deviation)
    assert all((a.y == b.y).all() for a, b in zip(records, again, strict=True))


def test_a_mismatch_is_stored_bit_for_bit(tmp_path: Path):
    """With a trial in closed loop and a rest, and without; infinite gains included."""
    missed_record = twice(linear_model(0), lambda u: 0.3 * np.abs(u), 0.2)
    shown = measure_model_error(linear_model(0), (missed_record,))
    view = shown.views[0]
    by_frequency = np.full_like(view.rest, np.inf)
    linear = view.linear + complex(np.inf, 1.0)
    lost = replace(view, by_frequency=by_frequency, linear=linear)
    unexcited = (0.1, 3.0)
    changed_shown = replace(
        shown, loop=lost, left_at_rest=0.25, unexcited=unexcited, stuck=(0.3,), farthest=2.5
    )
    for one in (shown, changed_shown):
        write_mismatch(tmp_path, one)
        expected = plain(one)
        actual = plain(read_mismatch(tmp_path))
        assert actual == expected


def plain(content):
    """A dataclass as nested tuples, arrays as their bytes."""
    if is_dataclass(content):
        return [(field.name, plain(getattr(content, field.name))) for field in fields(content)]
    if isinstance(content, np.ndarray):
        return content.dtype.str, content.shape, content.tobytes()
    return [plain(one) for one in content] if isinstance(content, tuple) else repr(content)
