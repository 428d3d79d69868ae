"""Picture of the correlation of a free run's error with itself and with the inputs."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ssm_study.api.pictures.picture import Band, Picture, PicturePanel, Series

SURE = 1.96  # standard deviations of a normal distribution that hold 95 %
MAX_LAG = 25  # samples
Signals = Sequence[Float[np.ndarray, "_ c"]]


def residual_correlation_picture(
    errors: Signals, inputs: Signals, output_name: str, input_names: Sequence[str]
) -> Picture:
    """Picture of the correlations of a free run's simulation error with itself and with the inputs.

    Of the first output; one panel for it alone and one for each input.
    """
    samples = sum(map(len, errors))
    shortest = min(map(len, errors))
    lags = min(MAX_LAG, shortest // 4)
    bound = SURE / np.sqrt(samples)
    own = correlate_signals(errors, errors, 0, 0, lags, one_sided=True)
    panels = [
        _correlation_panel(own, bound, f"Error of {replace_underscores(output_name)} with itself")
    ]
    for j, name in enumerate(input_names):
        cross = correlate_signals(errors, inputs, 0, j, lags, one_sided=False)
        picture_panel = _correlation_panel(cross, bound, f"Error with {replace_underscores(name)}")
        panels.append(picture_panel)
    title = "Correlation of the free run's error on the test record"
    all_panels = tuple(panels)
    column_count = len(panels)
    return Picture(title=title, panels=all_panels, columns=column_count)


def replace_underscores(name: str) -> str:
    """Replace the underscores in the name of a channel by spaces."""
    return name.replace("_", " ")


def _correlation_panel(
    correlation: tuple[Int[np.ndarray, "L"], Float[np.ndarray, "L"]], bound: float, title: str
) -> PicturePanel:
    """Panel of a picture with one correlation function as stems, and its confidence bounds. The
    title counts the lags outside them, without lag zero of a signal with itself."""
    lags, values = correlation
    starts_at_zero = lags[0] == 0
    is_free = lags > 0 if starts_at_zero else np.full(len(lags), True)
    is_outside = np.abs(values[is_free]) > bound
    outside = int(np.sum(is_outside))
    count = f"{outside} of {int(is_free.sum())} lags outside 95 % bounds"
    end_lags = [lags[0], lags[-1]]
    ends = np.array(end_lags, dtype=float)
    low = np.full(2, -bound)
    high = np.full(2, bound)
    band = Band(x=ends, low=low, high=high)
    lag_values = lags.astype(float)
    stems = Series(x=lag_values, y=values, mark="stems")
    all_series = (stems,)
    return PicturePanel(
        x_label="Lag (samples)",
        y_label="Correlation (–)",
        series=all_series,
        bands=(band,),
        title=f"{title}:\n{count}",
        height=1.1,
    )


def correlate_signals(
    first: Signals, second: Signals, i: int, j: int, lags: int, *, one_sided: bool
) -> tuple[Int[np.ndarray, "L"], Float[np.ndarray, "L"]]:
    """Correlation function of two signals over a range of lags, computed from all records together.

    Returns lags and coefficients; divided so that a signal with itself has one at lag zero.
    """
    first_lag = 0 if one_sided else -lags
    range_of_lags = np.arange(first_lag, lags + 1)
    sums = np.zeros(len(range_of_lags))
    powers = np.zeros(2)
    for a, b in zip(first, second, strict=True):
        signal = a[:, i]
        other_signal = b[:, j]
        x = signal - signal.mean()
        z = other_signal - other_signal.mean()
        power = float(x @ x)
        other_power = float(z @ z)
        powers += [power, other_power]
        for k, lag in enumerate(map(int, range_of_lags)):
            later_from = max(lag, 0)
            later_to = len(x) + min(lag, 0)
            later = x[later_from:later_to]
            earlier_from = max(-lag, 0)
            earlier_to = len(z) + min(-lag, 0)
            earlier = z[earlier_from:earlier_to]
            sums[k] += float(later @ earlier)
    size = np.sqrt(powers.prod())
    return range_of_lags, sums / size if size > 0 else sums
