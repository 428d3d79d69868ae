"""Findings about how well the model predicts the records. Does the model predict? Free runs of
validation and test against predictors that know nothing, or are linear."""

import numpy as np
from jaxtyping import Float

from ssm_study.evidence.finding import (
    EvidenceCase,
    Finding,
    findings_by_size,
    make_doubt,
    make_note,
)
from ssm_study.models.metrics import Simulation
from ssm_study.models.warm_start import simulate_from_alternative_states
from ssm_study.signals import fit_from_relative_error, fit_percent, lagged_inputs

POOR_FIT = 50.0  # percent: below, a quarter of the output's power is not predicted
NO_FIT = 20.0  # percent: below, two thirds of it are not; the mean, which needs no model, has 0
APART = 25.0  # points of fit between validation and test that one plant does not explain
LINEAR_BETTER = 10.0  # points of fit by which a linear filter may not beat the model
OWED = 0.15
MOST_OWED = (
    0.4  # shares of the output's power that the residual owes to the input: a doubt, no judgement
)
SMALL_ERROR = 0.02  # rms error as a share of the output's range, below which a fit says little
STARTS_APART = 10.0  # points of fit between two starts of a test record that a doubt states
LAGS = 40
FEW = 300  # samples below which the fits of two parts are not compared


def judge_fit(case: EvidenceCase) -> list[Finding]:
    """Findings on a model's fit that is poor, differs between data sets, or leaves a part of the
    output unexplained."""
    validation = case.validation.fit_percent
    test = case.test.fit_percent
    findings = judge_poor_fit(case)
    samples = [sum(len(r) for r in part.records) for part in (case.validation, case.test)]
    if not findings and min(samples) >= FEW and abs(validation - test) > APART:
        sentence = f"Validation fits by {validation:.0f} %, test by {test:.0f} %"
        findings = [
            make_doubt(f"{sentence}: split the log in interleaved blocks, or find what changed.")
        ]
    linear = fir_fit_percent(case)
    if not findings and linear > test + LINEAR_BETTER:
        sentence = (
            f"A linear filter of {LAGS} taps fits the test record by {linear:.0f} %, the model "
            f"by {test:.0f} %"
        )
        findings = [make_doubt(f"{sentence}: raise model.order or training.starts.")]
    findings += judge_initial_state(case)
    owed = unmodelled_output_share(case)
    sentence = f"The model misses {100 * owed:.0f} % of the output's power, which follow the input"
    return findings + findings_by_size(
        owed, OWED, MOST_OWED, f"{sentence}: raise model.order, or use more neurons."
    )


def judge_poor_fit(case: EvidenceCase) -> list[Finding]:
    """Finding on a model that fits the validation and test records poorly.

    Where the error is small against the range of the training output, the percentage is poor
    because those records hardly move: a doubt that says both, never `cannot judge`.
    """
    pooled = pooled_fit_percent(case)
    sentence = (
        f"In free run the model fits the test record by {case.test.fit_percent:z.1f} %, validation "
        f"by {case.validation.fit_percent:z.1f} %, the mean alone by 0 %"
    )
    share = rms_error_relative_to_range(case)
    if share < SMALL_ERROR and pooled < POOR_FIT:
        return [
            make_doubt(
                f"{sentence}; its error is {100 * share:.2g} % of the output's range, so these "
                "records move too little for a percentage: test where the output moves."
            )
        ]
    remedy = poor_fit_remedy(case)
    return findings_by_size(-pooled, -POOR_FIT, -NO_FIT, f"{sentence}{remedy}")


def poor_fit_remedy(case: EvidenceCase) -> str:
    """Advice at the end of a sentence on a poor fit: whether model or log is the cause, and what to
    do. It is the model if something simple fits the test record better."""
    fits = {f"a linear filter of {LAGS} taps": fir_fit_percent(case)}
    other = simulate_from_alternative_states(case.model, case.data, case.test)
    if other is not None:
        fits["this model from its other start"] = other.fit_percent
    name = max(fits, key=lambda key: fits[key])
    if fits[name] <= max(case.test.fit_percent, 0.0) + LINEAR_BETTER:
        return ": record more of what moves the output, or another input."
    return (
        f", {name} by {fits[name]:.1f} %: the log shows more than this model; set model.order, "
        "raise training.starts, or cut the log otherwise (data.split)."
    )


def judge_initial_state(case: EvidenceCase) -> list[Finding]:
    """Finding on a test record whose fit depends strongly on the estimated initial state."""
    other = simulate_from_alternative_states(case.model, case.data, case.test)
    if other is None or abs(other.fit_percent - case.test.fit_percent) <= STARTS_APART:
        return []
    from_past = any(state is not None for state in case.test.starts)
    words = ("from its first samples", "from the log before it")
    sentence = (
        "The fit depends on the state in which a test record begins: "
        f"{case.test.fit_percent:.1f} % {words[from_past]} (which pieces of the training and "
        f"validation records prefer), {other.fit_percent:.1f} % {words[not from_past]}. Test on a "
        "longer record."
    )
    return [make_doubt(sentence)]


def fir_fit_percent(case: EvidenceCase) -> float:
    """Fit to the test records, in percent, of a linear finite-impulse-response model that is
    estimated on the training records. It has `LAGS` taps.

    Minus infinity where no record is long enough for one.
    """
    x, y = case.fir_regression_arrays(case.data.training, LAGS)
    tested, true = case.fir_regression_arrays(case.data.test, LAGS)
    if not len(x) or not len(true):
        return -np.inf
    weights = np.linalg.lstsq(x, y, rcond=None)[0]
    return fit_percent(true, tested @ weights)


def pooled_fit_percent(case: EvidenceCase) -> float:
    """Fit of the model, in percent, over the validation and test records together.

    It lies between the two fits that the outcome prints, which are about the same means.
    """
    missed = 0.0
    moved = 0.0
    for part in (case.validation, case.test):
        y, error = scaled_output_and_error(case, part)
        missed += float((error**2).sum())
        moved += float(((y - y.mean(axis=0)) ** 2).sum())
    return fit_from_relative_error(np.sqrt(missed / moved)) if moved else -np.inf


def scaled_output_and_error(
    case: EvidenceCase, simulation: Simulation
) -> tuple[Float[np.ndarray, "T p"], Float[np.ndarray, "T p"]]:
    """Scaled outputs and simulation errors of several simulated records, concatenated, without
    start-up samples."""
    start = simulation.start_up_samples
    scale = case.data.scale
    y = [scale.scaled_output(record.y)[start:] for record in simulation.records]
    pairs = zip(simulation.records, simulation.simulated, strict=True)
    error = [((record.y - run) / scale.output_scale)[start:] for record, run in pairs]
    return np.concatenate(y), np.concatenate(error)


def rms_error_relative_to_range(case: EvidenceCase) -> float:
    """Root mean square simulation error relative to the range of the training output, for the worst
    output."""
    parts = [scaled_output_and_error(case, part)[1] for part in (case.validation, case.test)]
    rms = np.sqrt((np.concatenate(parts) ** 2).mean(axis=0))
    trained = np.concatenate([case.scale_record(record)[1] for record in case.data.training])
    ranges = np.ptp(trained, axis=0)
    shares = rms / np.maximum(ranges, np.finfo(float).tiny)
    return float(shares.max())


def unmodelled_output_share(case: EvidenceCase) -> float:
    """Fraction of the output's power that a filter of past inputs explains but the model does not.
    A filter from u, fitted to one half of the residual, predicts the other half.

    The power is that of each part about its own mean, as in the fit that the outcome prints.
    """
    gained = 0.0
    samples = 0
    for u, _, e in case.scored_records():
        half = len(u) // 2
        if half <= 4 * LAGS:
            continue
        past = lagged_inputs(u[:half], LAGS)
        weights = np.linalg.lstsq(past, e[LAGS:half], rcond=None)[0]
        rest = e[half + LAGS :]
        unexplained = rest - lagged_inputs(u[half:], LAGS) @ weights
        gained += float((rest**2).sum() - (unexplained**2).sum())
        samples += len(rest)
    outputs = [scaled_output_and_error(case, part)[0] for part in (case.validation, case.test)]
    deviations = [y - y.mean(axis=0) for y in outputs]
    powers = np.concatenate([(part**2).sum(axis=1) for part in deviations])
    whole = samples * float(powers.mean())
    return max(gained, 0.0) / whole if whole else 0.0


def judge_whiteness(case: EvidenceCase) -> list[Finding]:
    """Finding of the standard whiteness test (autocorrelation) on the simulation error. It is at
    most a note, since every free run of a nonlinear plant fails the test.

    Source: Ljung, System Identification, 2nd ed. (1999) section 16.6.
    """
    _, _, e = next(case.scored_records())
    e = e[:, 0] - e[:, 0].mean()
    power = float(e @ e)
    bound = 3.0 / np.sqrt(len(e))
    if power == 0:
        return []
    lags = range(1, min(26, len(e) // 4))
    correlations = [float(e[lag:] @ e[:-lag]) / power for lag in lags]
    outside = sum(abs(correlation) > bound for correlation in correlations)
    sentence = (
        f"The model's error is correlated in time ({outside} of {len(lags)} lags), as in most "
        "free runs."
    )
    return [make_note(sentence)] if outside > 3 else []
