"""Does the model predict? Free runs of validation and test against predictors that know nothing, or
are linear."""

import numpy as np

from ssm_study.evidence.finding import Case, Finding, doubt, graded, note
from ssm_study.signals import fit_percent, lagged

POOR_FIT = 50.0  # percent: below, a quarter of the output's power is not predicted
NO_FIT = 20.0  # percent: below, two thirds of it are not; the mean, which needs no model, has 0
APART = 25.0  # points of fit between validation and test that one plant does not explain
LINEAR_BETTER = 10.0  # points of fit by which a linear filter may not beat the model
OWED, MOST_OWED = (
    0.15,
    0.4,
)  # shares of the output's power that the residual owes to the input: a doubt, no judgement
LAGS = 40
FEW = 300  # samples below which the fits of two parts are not compared


def findings(case: Case) -> list[Finding]:
    """Fit by itself, between the parts, against a linear filter, and what the residual still owes
    to the input."""
    validation, test, pooled = case.validation.fit_percent, case.test.fit_percent, pooled_fit(case)
    sentence = f"In free run the model fits validation and test together by {pooled:z.0f} %, the mean alone by 0 %: "
    found = graded(
        -pooled,
        -POOR_FIT,
        -NO_FIT,
        f"{sentence}record more of what moves the output, or another input.",
    )
    long = min(sum(len(r) for r in part.records) for part in (case.validation, case.test)) >= FEW
    if not found and long and abs(validation - test) > APART:
        sentence = f"Validation fits by {validation:.0f} %, test by {test:.0f} %"
        found = [doubt(f"{sentence}: split the log in interleaved blocks, or find what changed.")]
    linear = linear_fit(case)
    if not found and linear > test + LINEAR_BETTER:
        sentence = f"A linear filter of {LAGS} taps fits the test record by {linear:.0f} %, the model by {test:.0f} %"
        found = [doubt(f"{sentence}: raise model.order or training.starts.")]
    owed = owed_to_input(case)
    sentence = f"The model misses {100 * owed:.0f} % of the output's power, which follow the input"
    return found + graded(
        owed, OWED, MOST_OWED, f"{sentence}: raise model.order, or use more neurons."
    )


def linear_fit(case: Case) -> float:
    """Fit in percent on the test records of the filter of `LAGS` taps that least squares takes from
    the training.

    Minus infinity where no record is long enough for one.
    """
    x, y = case.regression(case.data.training, LAGS)
    tested, true = case.regression(case.data.test, LAGS)
    return (
        fit_percent(true, tested @ np.linalg.lstsq(x, y, rcond=None)[0])
        if len(x) and len(true)
        else -np.inf
    )


def pooled_fit(case: Case) -> float:
    """Fit in percent over validation and test as one, each record about its own mean: a short piece
    says little."""
    moved, missed = zip(*((y - y.mean(axis=0), e) for _, y, e in case.scored()), strict=True)
    y = np.concatenate(moved)
    return fit_percent(y, y - np.concatenate(missed)) if y.any() else -np.inf


def owed_to_input(case: Case) -> float:
    """Share of the output's power by which a filter from u, fitted to one half of the residual,
    predicts the other."""
    gained, whole = 0.0, 0.0
    for u, y, e in case.scored():
        half = len(u) // 2
        if half <= 4 * LAGS:
            continue
        weights = np.linalg.lstsq(lagged(u[:half], LAGS), e[LAGS:half], rcond=None)[0]
        rest, y = e[half + LAGS :], y[half + LAGS :]
        gained += float((rest**2).sum() - ((rest - lagged(u[half:], LAGS) @ weights) ** 2).sum())
        whole += float(((y - y.mean(axis=0)) ** 2).sum())
    return max(gained, 0.0) / whole if whole else 0.0


def whiteness(case: Case) -> list[Finding]:
    """The field's standard test of the residual: at most a note, since every free run of a
    nonlinear plant fails it.

    Source: Ljung, System Identification, 2nd ed. (1999) section 16.6.
    """
    _, _, e = next(case.scored())
    e = e[:, 0] - e[:, 0].mean()
    power, bound = float(e @ e), 3.0 / np.sqrt(len(e))
    if power == 0:
        return []
    lags = range(1, min(26, len(e) // 4))
    outside = sum(abs(float(e[lag:] @ e[:-lag])) / power > bound for lag in lags)
    sentence = f"The model's error is correlated in time ({outside} of {len(lags)} lags), as in most free runs."
    return [note(sentence)] if outside > 3 else []
