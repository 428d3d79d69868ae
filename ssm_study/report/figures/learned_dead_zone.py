"""What the network learned of the motor: S_u scaled to volts over the true dead-zone (left), and its local slope inside
the certified interval (right). Coulomb friction widens the dead-zone seen at rest; the dotted line includes it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.models.identified import SSM
from ssm_study.report import style
from ssm_study.report.study_folder import Study

SCALED_REACH = 3.0  # how far to draw, in input scales (standard deviations of the training input)


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.model is None:
        return style.message("No run left a model.", style.PAGE_IN)
    if run.model.scaffold_in.inputs != 1:
        return style.message("S$_u$ has several inputs: there is no curve to draw.", style.PAGE_IN)
    slopes = (run.record.get("input_slope_lower"), run.record.get("input_slope_upper"))
    return figure(run.model, run.config.get("plant") or {}, slopes)


def figure(model: SSM, plant: Mapping[str, Any], slopes: tuple[float | None, float | None]) -> Figure:
    fig = style.canvas(style.PAGE_IN, 2.5)
    value, slope = fig.subplots(1, 2)
    scale, rest = float(model.input_scale[0]), float(model.input_equilibrium[0])
    voltage = rest + np.linspace(-SCALED_REACH, SCALED_REACH, 801) * scale
    learned = model.lift(voltage[:, None])[:, 0]
    truth = _dead_zone(voltage, plant["dead_zone_v"]) if "dead_zone_v" in plant else None
    gain = 1.0 if truth is None else float(truth @ learned / (learned @ learned))
    value.plot(voltage, gain * learned, color=style.BLUE, label="learned S$_u$", zorder=3)
    _true_curves(value, voltage, plant)
    style.above(value)
    unit = "scaled to the true gain (V)" if truth is not None else "(scaled units)"
    value.set(xlabel="Input (V)" if truth is not None else "Input (physical unit)", ylabel=f"S$_u$ {unit}")
    _slopes(slope, model, voltage, slopes)
    if truth is not None:
        slope.plot(
            voltage, np.gradient(truth, voltage) * scale / gain, color=style.INK, lw=0.9, ls="--", label="dead-zone"
        )
    style.above(slope)
    slope.set(xlabel=value.get_xlabel(), ylabel="Local slope of S$_u$ (scaled units, –)")
    return fig


def _true_curves(axes: Axes, voltage: Float[np.ndarray, "N"], plant: Mapping[str, Any]) -> None:
    threshold = plant.get("dead_zone_v")
    if threshold is None:
        return
    axes.plot(voltage, _dead_zone(voltage, threshold), color=style.INK, lw=0.9, ls="--", label="true dead-zone")
    try:  # both shafts' friction, seen as volts at the armature at rest
        held = 2 * plant["coulomb_torque_nm"] * plant["resistance_ohm"] / plant["torque_constant_nm_per_a"]
    except KeyError:
        return
    axes.plot(voltage, _dead_zone(voltage, threshold + held), color=style.GREY, lw=0.9, ls=":", label="with friction")


def _dead_zone(voltage: Float[np.ndarray, "N"], threshold: float) -> Float[np.ndarray, "N"]:
    """`v - sgn(v) v_dz`, 0 inside (THEORY section 1)."""
    return np.sign(voltage) * np.maximum(np.abs(voltage) - threshold, 0.0)


def _slopes(axes: Axes, model: SSM, voltage: Float[np.ndarray, "N"], slopes: tuple[float | None, float | None]) -> None:
    scaled = (voltage - model.input_equilibrium[0]) / model.input_scale[0]
    local = [model.scaffold_in.jacobian(np.array([v]))[0, 0] for v in scaled]
    lower, upper = slopes
    if lower is not None and upper is not None:
        axes.axhspan(lower, upper, color=style.SKY, alpha=0.2, lw=0, label=f"certified [{lower:.3g}, {upper:.3g}]")
    axes.step(voltage, local, where="post", color=style.BLUE, label="learned", zorder=3)
