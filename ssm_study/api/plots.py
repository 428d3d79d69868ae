"""Figures of models and designs; each function returns a Matplotlib figure and shows nothing."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex, Float, Int

from ssm_study import style
from ssm_study.bounds.frequency import frequency_response
from ssm_study.bounds.slopes import certified_balls
from ssm_study.models.metrics import Simulation
from ssm_study.robustness.mismatch import ANGLES
from ssm_study.robustness.sensitivity import ends, sensitivity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ssm_study.api.comparing import ModelComparison
    from ssm_study.api.design import Design
    from ssm_study.api.model import Model, Values
    from ssm_study.plants.plant import Plant

CONFIDENCE_95 = 1.96  # standard deviations
STARTS = (-1.0, 1.0)  # from where a loop is drawn unless it is told, in output scales


def plot_free_run(model: "Model") -> "Figure":
    """Draw the free run on the longest test record: measured as dots, model on top, residuals.

    One column per output; the title holds the fit on all test records.
    """
    data = model.data
    simulation = Simulation.of(model.simulator, data.test, data.start_up_samples)
    lengths = [len(record) for record in data.test]
    longest = int(np.argmax(lengths))
    record = data.test[longest]
    simulated = simulation.simulated[longest]
    with style.paper():
        figure = style.canvas(style.PAGE_IN, 3.2)
        axes = figure.subplots(
            2, record.y.shape[1], sharex=True, squeeze=False, height_ratios=[2, 1]
        )
        for j, channel in enumerate(data.outputs):
            _draw_measured(axes[0, j], record.time_s, record.y[:, j])
            axes[0, j].plot(record.time_s, simulated[:, j], color=style.BLUE, label="model")
            axes[0, j].set_ylabel(label_of(channel))
            _draw_residuals(axes[1, j], record.time_s, record.y[:, j] - simulated[:, j])
            _mark_start_up(axes[:, j], record.time_s, data.start_up_samples)
        axes[0, 0].legend(loc="upper right", ncols=3)
        figure.suptitle(f"Free run on the test record, fit {simulation.fit_percent:.1f} %")
    return figure


def plot_overlay(comparison: "ModelComparison") -> "Figure":
    """Draw the free runs of several models over one record, residuals below."""
    outputs = comparison.measured.shape[1]
    with style.paper():
        figure = style.canvas(style.PAGE_IN, 3.4)
        axes = figure.subplots(2, outputs, sharex=True, squeeze=False, height_ratios=[2, 1])
        for j, name in enumerate(comparison.output_names):
            _draw_measured(axes[0, j], comparison.time_s, comparison.measured[:, j])
            for i, (label, simulated) in enumerate(comparison.simulated.items()):
                color = style.CYCLE[i % len(style.CYCLE)]
                fit: Any = comparison.table["fit_percent"][label]
                words = f"{label} ({float(fit):.1f} %)"
                error = comparison.measured[:, j] - simulated[:, j]
                axes[0, j].plot(comparison.time_s, simulated[:, j], color=color, label=words)
                axes[1, j].plot(comparison.time_s, error, color=color, linewidth=0.8)
            axes[0, j].set_ylabel(name)
            axes[1, j].set_ylabel("residual")
            axes[1, j].set_xlabel("time (s)")
        axes[0, 0].legend(loc="upper right", ncols=2)
    return figure


def plot_bode(model: "Model") -> "Figure":
    """Draw magnitude and phase at the equilibrium, one colour per pair of channels.

    Dots are the estimate from the validation records, where input and output are one each.
    """
    response = model.frequency_response()
    with style.paper():
        figure = style.canvas(style.PAGE_IN, 3.4)
        magnitude, phase = figure.subplots(2, 1, sharex=True)
        for i, (pair, rows) in enumerate(response.groupby(["output", "input"])):
            color = style.CYCLE[i % len(style.CYCLE)]
            label = " from ".join(map(str, pair))
            magnitude.loglog(rows.frequency_rad_s, rows.magnitude, color=color, label=label)
            phase.semilogx(rows.frequency_rad_s, rows.phase_deg, color=color)
            _draw_band_of_slopes(magnitude, model, rows, color)
        if len(model.data.inputs) == len(model.data.outputs) == 1:
            _draw_estimated_response(magnitude, phase, model)
        magnitude.set_ylabel("magnitude")
        magnitude.legend(loc="lower left")
        phase.set_ylabel("phase (deg)")
        phase.set_xlabel("frequency (rad/s)")
        figure.suptitle("Frequency response at the equilibrium")
    return figure


def plot_residual_correlations(model: "Model", lags: int) -> "Figure":
    """Draw the residuals' correlation with themselves and with each input, 95 % bounds in grey.

    Of the test records, start-up left out; inside the bounds nothing is left to explain.
    """
    data = model.data
    simulation = Simulation.of(model.simulator, data.test, data.start_up_samples)
    start = data.start_up_samples
    errors = [r.y[start:] - s[start:] for r, s in zip(data.test, simulation.simulated, strict=True)]
    inputs = [record.u[start:] for record in data.test]
    samples = sum(map(len, errors))
    bound = CONFIDENCE_95 / np.sqrt(samples)
    with style.paper():
        figure = style.canvas(style.PAGE_IN, 2.4)
        panels = figure.subplots(1, 1 + len(data.inputs), squeeze=False, sharey=True)[0]
        own = correlate(errors, errors, 0, 0, lags, one_sided=True)
        _draw_correlation(panels[0], own, bound, f"residual of {data.outputs[0].name} with itself")
        for j, channel in enumerate(data.inputs):
            cross = correlate(errors, inputs, 0, j, lags, one_sided=False)
            _draw_correlation(panels[j + 1], cross, bound, f"residual with {channel.name}")
        panels[0].set_ylabel("correlation")
    return figure


def plot_poles(
    groups: Mapping[str, Complex[np.ndarray, "n"]], rate: float | None = None
) -> "Figure":
    """Draw eigenvalues in the unit circle, and the circle that a contraction rate proves.

    The inner circle has radius `sqrt(1 - rate)`.
    """
    markers = ("x", "o", "^", "s")
    angles = np.linspace(0, 2 * np.pi, 361)
    with style.paper():
        figure = style.canvas(style.COLUMN_IN, style.COLUMN_IN)
        axes = figure.subplots()
        axes.plot(np.cos(angles), np.sin(angles), color=style.INK, linewidth=0.8)
        if rate is not None:
            radius = np.sqrt(1 - rate)
            label = f"certified factor {radius:.3f}"
            circle = radius * np.exp(1j * angles)
            axes.plot(circle.real, circle.imag, color=style.GREY, linestyle="--", label=label)
        for i, (name, poles) in enumerate(groups.items()):
            look: dict[str, Any] = {"color": style.CYCLE[i], "marker": markers[i % len(markers)]}
            axes.plot(poles.real, poles.imag, linestyle="", fillstyle="none", label=name, **look)
        axes.set_aspect("equal")
        axes.set_xlabel("real part, per sample")
        axes.set_ylabel("imaginary part")
        axes.legend(loc="upper left", bbox_to_anchor=(0, 1.16), ncols=2)
    return figure


def plot_loop(design: "Design", y0: "Values | None", plant: "Plant | None") -> "Figure":
    """Draw outputs and inputs of the loop from initial outputs, the open loop in grey.

    Without noise; the controlled outputs in blue, the range of recorded inputs dashed.
    """
    from ssm_study.api.loops import close_loop, identified_plant
    from ssm_study.loop.controller import Uncontrolled

    on = plant or identified_plant(design)
    scale = design.model.scale
    if y0 is None:
        y0 = scale.output_equilibrium + np.outer(STARTS, scale.output_scale)
    controlled = close_loop(design, y0, on)
    uncontrolled = close_loop(design, y0, on, controller=Uncontrolled.of(on))
    with style.paper():
        figure = style.canvas(style.PAGE_IN, 3.2)
        columns = max(scale.inputs, scale.outputs)
        axes = figure.subplots(2, columns, sharex=True, squeeze=False)
        for j, channel in enumerate(on.outputs):
            axes[0, j].plot(uncontrolled.time_s, uncontrolled.y[..., j].T, color=style.PALE)
            axes[0, j].plot(controlled.time_s, controlled.y[..., j].T, color=style.BLUE)
            axes[0, j].set_ylabel(label_of(channel))
        for j, channel in enumerate(on.inputs):
            axes[1, j].plot(controlled.time_s, controlled.u[..., j].T, color=style.VERMILLION)
            _draw_recorded_range(axes[1, j], design, j)
            axes[1, j].set_ylabel(label_of(channel))
            axes[1, j].set_xlabel("time (s)")
        where = "the simulated plant" if plant else "the identified model"
        figure.suptitle(f"Loop on {where}; the open loop in grey")
    return figure


def plot_margin(design: "Design") -> "Figure":
    """Draw the small-gain margin at each frequency, one line per recorded amplitude, line at 1.

    `1 / (g(w) |T_ue(w)|)`: how much larger the recorded model error could be at that frequency
    alone before small gain fails. The design's own margin, in the title, also uses the error's
    phase where the record shows it, so it may be larger. Raises `BadRequest` without records.
    """
    from ssm_study.refusal import require

    origin = design.origin
    require(origin is not None, "design", "loaded or bare", "has no records", "use st.fit first")
    assert origin is not None
    sizes = loop_sizes(design)
    with style.paper():
        figure = style.canvas(style.PAGE_IN, 2.8)
        axes = figure.subplots()
        omega = ANGLES / design.model.step_s
        for i, view in enumerate(origin.mismatch.views):
            gain = view.by_frequency * sizes
            shown = gain > 0
            color = style.CYCLE[i % len(style.CYCLE)]
            label = f"input rms {view.amplitude:.2g}"
            axes.semilogy(omega[shown], 1 / gain[shown], color=color, label=label)
        axes.axhline(1, color=style.INK, linewidth=1.2)
        axes.set_xlabel("frequency (rad/s)")
        axes.set_ylabel("small-gain margin")
        axes.legend(loc="upper left", ncols=2)
        margin = design.facts.get("resolved_margin")
        words = "" if margin is None else f"; the design's margin, with phase: {margin:.3g}"
        figure.suptitle(f"Below 1 small gain fails{words}")
    return figure


def loop_sizes(design: "Design") -> Float[np.ndarray, "F"]:
    """Largest gain from output error to input at each angle, over the ends of the slopes."""
    balls = certified_balls(design.model)
    sizes = np.zeros(len(ANGLES))
    for linear, gains, slope_in, slope_out in ends(
        design.model.system, design.certificate.pair, balls
    ):
        response = frequency_response(sensitivity(linear, gains, slope_in, slope_out), ANGLES)
        largest = np.linalg.svd(response, compute_uv=False)[:, 0]
        sizes = np.maximum(sizes, largest)
    return sizes


def label_of(channel: Any) -> str:
    """Name of a channel with its unit in parentheses."""
    return f"{channel.name} ({channel.unit})" if channel.unit else str(channel.name)


def correlate(
    first: list[Float[np.ndarray, "_ p"]],
    second: list[Float[np.ndarray, "_ q"]],
    i: int,
    j: int,
    lags: int,
    *,
    one_sided: bool,
) -> tuple[Int[np.ndarray, "L"], Float[np.ndarray, "L"]]:
    """Correlation of `first[k]` with `second[k - lag]`, all records together, means removed.

    Returns lags and coefficients; divided so that a signal with itself has one at lag zero.
    """
    range_of_lags = np.arange(0 if one_sided else -lags, lags + 1)
    sums = np.zeros(len(range_of_lags))
    powers = np.zeros(2)
    for a, b in zip(first, second, strict=True):
        x = a[:, i] - a[:, i].mean()
        z = b[:, j] - b[:, j].mean()
        powers += [float(x @ x), float(z @ z)]
        for k, lag in enumerate(map(int, range_of_lags)):
            later = x[max(lag, 0) : len(x) + min(lag, 0)]
            earlier = z[max(-lag, 0) : len(z) + min(-lag, 0)]
            sums[k] += float(later @ earlier)
    size = np.sqrt(powers.prod())
    return range_of_lags, sums / size if size > 0 else sums


def _draw_measured(
    axes: "Axes", time_s: Float[np.ndarray, "T"], values: Float[np.ndarray, "T"]
) -> None:
    """Draw a measured signal as small dots."""
    look: dict[str, Any] = {"marker": ".", "markersize": 2, "linestyle": "", "color": style.GREY}
    axes.plot(time_s, values, label="measured", **look)


def _draw_residuals(
    axes: "Axes", time_s: Float[np.ndarray, "T"], values: Float[np.ndarray, "T"]
) -> None:
    """Draw what is measured and not simulated."""
    axes.axhline(0, color=style.PALE)
    axes.plot(time_s, values, color=style.VERMILLION, linewidth=0.8)
    axes.set_ylabel("residual")
    axes.set_xlabel("time (s)")


def _mark_start_up(panels: Any, time_s: Float[np.ndarray, "T"], samples: int) -> None:
    """Shade the samples that estimate the initial state and are not scored."""
    if samples:
        for axes in panels:
            axes.axvspan(time_s[0], time_s[samples], color=style.PALE, alpha=0.5, linewidth=0)


def _draw_correlation(
    axes: "Axes",
    correlation: tuple[Int[np.ndarray, "L"], Float[np.ndarray, "L"]],
    bound: float,
    title: str,
) -> None:
    """Draw one correlation as stems over its bounds."""
    lags, values = correlation
    axes.axhspan(-bound, bound, color=style.PALE, linewidth=0)
    axes.vlines(lags, 0, values, color=style.BLUE, linewidth=1.0)
    axes.plot(lags, values, marker="o", markersize=2, linestyle="", color=style.BLUE)
    axes.set_xlabel("lag (samples)")
    axes.set_title(title)


def _draw_recorded_range(axes: "Axes", design: "Design", j: int) -> None:
    """Draw the range of one input in the training records."""
    if design.origin is None:
        return
    values = np.concatenate([record.u[:, j] for record in design.origin.data.training])
    for end in (values.min(), values.max()):
        axes.axhline(end, color=style.GREY, linestyle="--", linewidth=0.8)


def _draw_band_of_slopes(axes: "Axes", model: "Model", rows: Any, color: str) -> None:
    """Shade the magnitudes that the slopes of the input map allow, for one input and one output."""
    scaffold = model.ssm.scaffold_in
    if scaffold.inputs != 1 or len(model.data.outputs) != 1:
        return
    slope_at_rest = float(scaffold.jacobian(np.zeros(1))[0, 0])
    ball = certified_balls(model.ssm).input
    if slope_at_rest <= 0 or ball.lower <= 0:
        return
    low = rows.magnitude * ball.lower / slope_at_rest
    high = rows.magnitude * ball.upper / slope_at_rest
    label = "slopes of the input map"
    axes.fill_between(rows.frequency_rad_s, low, high, color=color, alpha=0.15, label=label)


def _draw_estimated_response(magnitude: "Axes", phase: "Axes", model: "Model") -> None:
    """Draw the frequency response that the validation records show: averaged cross spectra.

    By Welch's method; frequencies with less than 1 % of the input's mean power are left out.
    """
    from scipy import signal

    record = max(model.data.validation, key=len)
    segment = min(256, len(record) // 4)
    if segment < 16:
        return
    u = record.u[:, 0] - record.u[:, 0].mean()
    y = record.y[:, 0] - record.y[:, 0].mean()
    rate = 1 / record.step_s
    frequency, cross = signal.csd(u, y, fs=rate, nperseg=segment)
    _, power = signal.welch(u, fs=rate, nperseg=segment)
    excited = (power > 0.01 * power.mean()) & (frequency > 0)
    estimate = cross[excited] / power[excited]
    omega = 2 * np.pi * frequency[excited]
    look: dict[str, Any] = {"marker": ".", "markersize": 3, "linestyle": "", "color": style.GREY}
    magnitude.loglog(omega, np.abs(estimate), label="validation record", **look)
    phase.semilogx(omega, np.rad2deg(np.unwrap(np.angle(estimate))), **look)
