"""Findings on a log from a closed loop, in which noise of the output is fed back to the input.

`v` and `w` are what the last `PAST` inputs do not predict of an output and of an input; with
feedback `v` predicts a share of `w`, fitted to one half of each record and scored on the other. A
reference's steps are new in the input too, and large: `w` is clipped. What hides a loop:
docs/trust.md. Source: Caines & Chan, IEEE Trans. Automatic Control 20 (1975) 498-508.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from ssm_study.data.log_dynamics import explained_output_variance
from ssm_study.evidence.finding import EvidenceCase, Finding, make_doubt, make_note
from ssm_study.models.initial_system import fit_arx_matrices
from ssm_study.models.spec import scale_records
from ssm_study.models.warm_start import join_records_without_gaps
from ssm_study.signals import DataSet

PAST = 20
OUTPUTS = 4  # samples of the input's own past, and of the output's
CLIPPED = 4.4  # median sizes of w: three standard deviations of a normal one
# Shares of w: from earlier outputs, and with the present one, which an input may reach before it is
# read. Of records at hand 0.01 and 0.07 at most in open loop, 0.08 and 0.11 in EMPS; of drawn PI
# loops 95 % above 0.05 and 0.23.
EARLIER = 0.05
PRESENT = 0.12
FORESEEN = (
    1e-4  # share of an input's power that its past must leave: what a multisine leaves is rounding
)
FEWEST = 300
SHORTEST = (
    6  # samples in all, and times `PAST` a record, below which nothing is said, or it is left out
)
# over the samples: what chance alone adds to a share, seen in open-loop logs of 120 to 1500 samples
SCATTER = 20
ROUNDING = 1e-9
LEAST_SHARE = 0.2  # of the input's power, below which the set point hardly moves a known loop
LAGS = (3, 5, 8)
# The same in a loop: with few lags the sensor's noise, which the loop feeds back, hides a mode that
# grows. Of 100 drawn unstable plants in a loop 3, 5, 8 lags find 19, these 100; of 292 drawn stable
# ones both find one.
LAGS_IN_LOOP = (12, 20, 30)
UNSTABLE = 1.01
ALIKE = 0.02  # models that must agree on a mode outside the circle
# By what a mode must grow over all samples, as a logarithm: `T (rho - 1)` of an integrator of noise
# alone is more once in a hundred. Source: Fuller, Introduction to Statistical Time Series (1976),
# table 8.5.1.
GROWTH = 2.03
# Standard errors by which growth must follow from the output itself, beside any static map of the
# input: motors with a dead zone reach 2.5, plants that run away with little noise 5.9 and more.
GROWS = 4.0
REMEMBERED = 0.5  # share of itself that an integrator may lose over all samples, as a logarithm
MOVED_BY_INPUT = 0.5  # share of the rise that the input must explain
KNOTS = 9
STRIDE = 10  # of the static map, and the samples over which growth is looked for
Rows = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, "_"]


def judge_feedback(case: EvidenceCase) -> Iterator[Finding]:
    """Findings on a log that was recorded in a closed loop, or whose plant is unstable or
    integrates its input."""
    share = case.data.metadata.get("by_set_point")
    if share is not None:
        statement = (
            "The input is what the set point of the log's loop makes of it, "
            f"{100 * float(share):.0f} % of its power"
        )
        if float(share) >= LEAST_SHARE:
            yield make_note(f"{statement}.")
        else:
            yield make_doubt(f"{statement}: move the set point more.")
    earlier = feedback_error_reduction(case.data, 1)
    present = feedback_error_reduction(case.data, 0)
    closed = shows_closed_loop(case.data, earlier, present)
    at_once = closed and earlier < EARLIER and responds_within_sample(case.data)
    if at_once and not case.model.linear.d.any():
        yield make_doubt(
            f"The output answers the input within the sample ({100 * present:.0f} % of what is new "
            "in the one is in the other, and earlier outputs explain nothing of the input): use "
            "model.feedthrough=true."
        )
    elif closed and not at_once:
        statement = feedback_sentence(earlier, present)
        remedy = "name its set point, data.reference, or PI"
        if share:
            remedy = "check data.reference or data.controller"
        yield make_doubt(
            f"{statement}, as in a closed-loop log: {remedy}, or record with the loop open."
        )
    integrated = case.model.linear.spectral_radius >= 1 - ROUNDING
    in_loop = (closed and not at_once) or share is not None
    yield from judge_instability(
        case.data, is_closed_loop=in_loop, has_integrating_model=integrated
    )


def feedback_sentence(earlier_share: float, present_share: float) -> str:
    """Sentence that states the statistic by which a log shows that it was recorded in closed loop.
    Of two statistics it is the one further above its threshold of two."""
    if present_share - PRESENT >= earlier_share - EARLIER:
        return (
            "What is new in the output explains "
            f"{100 * present_share:.0f} % of what is new in the input"
        )
    return f"Earlier outputs explain {100 * earlier_share:.0f} % of what is new in the input"


def responds_within_sample(data: DataSet) -> bool:
    """Whether the output responds to the input within the same sample because of direct
    feedthrough, not of feedback.

    A controller with negative feedback makes the first coefficient of the finite impulse response
    point against the plant's further response; a plant that answers within the sample does not.
    """
    shortest = SHORTEST * PAST
    pairs = [(u, y) for u, y in scale_records(data) if len(u) >= shortest]
    if not pairs:
        return False
    past_inputs = []
    for u, _ in pairs:
        windows = sliding_window_view(u, PAST + 1, axis=0)[:, :, ::-1]
        past_inputs.append(windows.reshape(len(windows), -1))
    past = np.concatenate(past_inputs)
    outputs = np.concatenate([y[PAST:] for _, y in pairs])
    with_constant = np.pad(past, ((0, 0), (0, 1)), constant_values=1.0)
    weights = _least_squares_coefficients(with_constant, outputs)
    response = weights[:-1].reshape(-1, PAST + 1, outputs.shape[1])
    at_once = response[:, 0]
    later = response[:, 1:].sum(axis=1)
    largest = np.unravel_index(np.abs(at_once).argmax(), at_once.shape)
    return bool(at_once[largest] * later[largest] > 0)


def _least_squares_coefficients(regressors: Rows, targets: Rows) -> Rows:
    """Coefficients of the least-squares fit of targets by regressors."""
    weights, *_ = np.linalg.lstsq(regressors, targets, rcond=ROUNDING)
    return weights


def shows_closed_loop(data: DataSet, earlier_share: float, present_share: float) -> bool:
    """Whether the statistics of a log show that it was recorded in closed loop."""
    samples = sum(len(record) for record in data.training)
    if samples < FEWEST:
        return False
    excess = max(earlier_share - EARLIER, present_share - PRESENT)
    return excess >= SCATTER / samples


def judge_instability(
    data: DataSet, *, is_closed_loop: bool, has_integrating_model: bool = False
) -> Iterator[Finding]:
    """Findings on a log whose plant is unstable or integrates its input.

    In open loop sensor noise makes a mode look slower, and integrators of noise stay below
    `GROWTH`. In a closed loop noise moves the estimate either way, so that only `UNSTABLE` is
    clear, and models of many lags show it.
    """
    whole = replace(data, training=(*data.training, *data.validation, *data.test))
    fitted_data = data if is_closed_loop else whole
    longest = max(len(record) for record in fitted_data.training)
    has_room = longest > SHORTEST * max(LAGS_IN_LOOP)
    lags_tried = LAGS_IN_LOOP if is_closed_loop and has_room else LAGS
    modes = [dominant_pole_modulus(fitted_data, lags) for lags in lags_tried]
    slowest = min(modes)
    samples = sum(map(len, whole.training))
    least = UNSTABLE if is_closed_loop else math.exp(GROWTH / samples)
    alike = np.ptp(modes) < ALIKE
    mode = f"a mode at {np.median(modes):.5g} a sample"
    by_input, by_itself = increment_statistics(whole)
    grows = is_closed_loop or by_itself > GROWS
    if alike and slowest > least and grows:
        statement = f"The output runs away by itself ({mode}), and models here are stable"
        sentence = f"{statement}: log its loop with the set point as the input."
        yield Finding(level="cannot judge", sentence=sentence)
        return
    if is_closed_loop or has_integrating_model:
        return
    lasts = alike and slowest > 1 - REMEMBERED / samples
    reason = ""
    if lasts and by_input > MOVED_BY_INPUT:
        reason = f"{mode}, and {100 * by_input:.0f} % of its rise follow a static map of the input"
    else:
        share = integrator_share(whole)
        if share is not None:
            reason = (
                f"the input's mean explains {100 * share:.0f} % of its changes, and it forgets none"
            )
    if reason:
        remedy = "use model.integrating_output=true"
        yield make_doubt(f"The output integrates its input ({reason}): {remedy}.")


def integrator_share(data: DataSet) -> float | None:
    """Fraction of the output's changes that the mean input explains, for a plant that integrates
    its input; None for any other plant. For one input only."""
    stretches = join_records_without_gaps(data)
    if not stretches or data.scale.inputs != 1 or data.scale.outputs != 1:
        return None
    longest = max(stretches, key=len)
    shares = explained_output_variance(longest.u[:, 0], longest.y[:, 0])
    return shares.change if shares.is_integrator else None


def increment_statistics(data: DataSet) -> tuple[float, float]:
    """Fraction of the output's increments that the input explains, and the t-statistic of their
    dependence on the output's level.

    Least squares `y[k + h] - y[k] = h (f(u) + g(u before)) + c y[k - h]` with f and g piecewise
    linear: an integrator behind a dead zone or a curve has c = 0. Returns the share of the power of
    the rise that f and g explain, the least of all outputs, and c over its standard error, the
    largest; `(0, infinite)` where the records are too few to tell.
    """
    scale = data.scale
    records = []
    for record in (*data.training, *data.validation, *data.test):
        scaled_input = scale.scaled_input(record.u)
        scaled_output = scale.scaled_output(record.y)
        records.append((scaled_input, scaled_output))
    inputs = np.concatenate([u for u, _ in records])
    shares = np.linspace(0, 1, KNOTS)
    nodes = [np.unique(np.quantile(column, shares)) for column in inputs.T]
    pieces = [_increment_regression_rows(u, y, nodes) for u, y in records if len(u) > 4 * STRIDE]
    if not pieces:
        return 0.0, np.inf
    moved, rise, before = (np.concatenate(side) for side in zip(*pieces, strict=True))
    missed = rise - moved @ _least_squares_coefficients(moved, rise)
    power = np.maximum((rise**2).sum(axis=0), np.finfo(float).tiny)
    missed_power = (missed**2).sum(axis=0)
    explained = 1 - missed_power / power
    statistics = []
    for output_rise, output_before in zip(rise.T, before.T, strict=True):
        statistics.append(_last_coefficient_t_statistic(moved, output_rise, output_before))
    return float(explained.min()), max(statistics)


def _increment_regression_rows(
    inputs: Rows, outputs: Rows, nodes: list[Vector]
) -> tuple[Rows, Rows, Rows]:
    """Rows of a regression of the output's increments on the input and the level of the output.
    They hold the input's effect over one stride and over the stride before, the output's rise, and
    the output before."""
    hats: list[np.ndarray] = []
    for column, at in zip(inputs.T, nodes, strict=True):
        hats += [np.interp(column, at, corner) for corner in np.eye(len(at))]
    regressors = np.stack(hats, axis=1)
    added = np.cumsum(regressors, axis=0) / STRIDE
    k = np.arange(2 * STRIDE, len(inputs) - STRIDE, STRIDE)
    end_of_stride = added[k + STRIDE - 1]
    start_of_stride = added[k - 1]
    start_of_stride_before = added[k - STRIDE - 1]
    now = end_of_stride - start_of_stride
    earlier = start_of_stride - start_of_stride_before
    moved = np.concatenate([now, earlier], axis=1)
    rise = outputs[k + STRIDE] - outputs[k]
    output_before = outputs[k - STRIDE]
    return moved, rise, output_before


def _last_coefficient_t_statistic(
    regressors: Rows, targets: Vector, last_regressor: Vector
) -> float:
    """Ratio of the last coefficient of a least-squares fit to the coefficient's standard error
    (t-statistic)."""
    rows = np.column_stack([regressors, last_regressor])
    weights, _, rank, _ = np.linalg.lstsq(rows, targets, rcond=ROUNDING)
    missed = targets - rows @ weights
    degrees_of_freedom = max(len(targets) - int(rank), 1)
    variance = float(missed @ missed) / degrees_of_freedom
    inverse_gram = np.linalg.pinv(rows.T @ rows)
    spread = variance * inverse_gram[-1, -1]
    standard_error = np.sqrt(max(spread, np.finfo(float).tiny))
    return float(weights[-1] / standard_error)


def dominant_pole_modulus(data: DataSet, lags: int) -> float:
    """Largest modulus among the poles of an ARX model that is fitted to the log. It is arbitrary if
    the log has no reference signal."""
    records = scale_records(data)
    a, *_ = fit_arx_matrices(records, lags, feedthrough=False)
    p = len(data.scale.output_scale)
    companion = np.eye(lags * p, k=-p)
    companion[:p] = np.concatenate(a, axis=1)
    eigenvalues = np.linalg.eigvals(companion)
    return float(np.abs(eigenvalues).max())


def feedback_error_reduction(data: DataSet, first_lag: int) -> float:
    """Fraction by which past outputs reduce the power of the error of predicting the input; it is
    large for a log from a closed loop. It is the largest share of any input's `w` that `v`, from
    `first_lag` samples ago on, explains in the other half."""
    halves = list[list[Rows]]()
    for u, y in scale_records(data):
        halves += _regression_rows_by_halves(u, y, first_lag)
    if not halves:
        return 0.0
    first_half = _concatenate_regression_rows(halves[0::2])
    second_half = _concatenate_regression_rows(halves[1::2])
    forwards = _residual_powers(first_half, second_half)
    backwards = _residual_powers(second_half, first_half)
    power, new, clipped, missed = forwards + backwards
    is_tested = (new > FORESEEN * power) & (clipped > 0)
    shares = 1 - missed[is_tested] / clipped[is_tested]
    return float(np.max(shares, initial=0.0))


def _concatenate_regression_rows(halves: list[list[Rows]]) -> list[Rows]:
    """Concatenate the regression data of several half records, array by array."""
    return [np.concatenate(arrays) for arrays in zip(*halves, strict=True)]


def _residual_powers(fitted: list[Rows], scored: list[Rows]) -> Float[np.ndarray, "4 m"]:
    """Powers of four signals in the scored half of a record: of the input, of its prediction error
    `w`, of `w` with outliers clipped, and of what past outputs leave unexplained of the clipped
    error. The coefficients are those of the fitted half."""
    past, y, u = fitted
    own_past, own_y, own_u = scored
    on_u = _least_squares_coefficients(past, u)
    on_y = _least_squares_coefficients(past, y)
    v = y - past @ on_y
    w = u - past @ on_u
    own_v = own_y - own_past @ on_y
    own_w = own_u - own_past @ on_u
    most = CLIPPED * np.median(np.abs(w), axis=0)
    w = np.clip(w, -most, most)
    own = np.clip(own_w, -most, most)
    explained = own_v @ _least_squares_coefficients(v, w)
    moved = own_u - own_u.mean(axis=0)
    signals = (moved, own_w, own, own - explained)
    powers = [(signal**2).sum(axis=0) for signal in signals]
    return np.array(powers)


def _regression_rows_by_halves(
    inputs: Rows, outputs_of_record: Rows, first_lag: int
) -> Iterator[list[Rows]]:
    """Regression data of the first and of the second half of a record: past inputs, past outputs
    and the present input. They hold past inputs and a one, outputs of `first_lag` to `OUTPUTS`
    samples ago, and the input."""
    rows = len(inputs) - PAST
    if len(inputs) < SHORTEST * PAST:
        return
    past_windows = sliding_window_view(inputs[:-1], PAST, axis=0)
    past = past_windows.reshape(rows, -1)
    outputs = outputs_of_record[PAST - OUTPUTS : len(outputs_of_record) - first_lag]
    output_windows = sliding_window_view(outputs, OUTPUTS + 1 - first_lag, axis=0)
    before = output_windows.reshape(rows, -1)
    with_constant = np.pad(past, ((0, 0), (0, 1)), constant_values=1.0)
    sides = (with_constant, before, inputs[PAST:])
    middle = rows // 2
    yield [side[:middle] for side in sides]
    yield [side[middle:] for side in sides]
