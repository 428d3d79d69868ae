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

REACH_IN_DEAD_ZONES = 8  # how far to draw: far enough for the straight part, near enough to see the dead-zone
REACH_IN_SCALES = 2.0  # how far training reached, in input scales: where the gain is compared, and drawn otherwise


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.model is None:
        return style.message("No run left a model.", style.PAGE_IN)
    if run.model.scaffold_in.inputs != 1:
        return style.message("S$_u$ has several inputs: there is no curve to draw.", style.PAGE_IN)
    slopes = (run.record.get("input_slope_lower"), run.record.get("input_slope_upper"))
    return figure(run.model, _known_plant(run.config), slopes)


def _known_plant(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The numbers of the plant that was simulated; none for a recording, beside which the group's default stands."""
    simulated = str((config.get("data") or {}).get("_target_", "")).endswith(".SimulatedData")
    return (config.get("plant") or {}) if simulated else {}


def figure(model: SSM, plant: Mapping[str, Any], slopes: tuple[float | None, float | None]) -> Figure:
    fig = style.canvas(style.PAGE_IN, 2.5)
    value, slope = fig.subplots(1, 2)
    threshold, scale = plant.get("dead_zone_v"), float(model.input_scale[0])
    gain = 1.0 if threshold is None else _gain_to_volts(model, threshold)
    reach = REACH_IN_SCALES * scale if threshold is None else REACH_IN_DEAD_ZONES * threshold
    voltage = model.input_equilibrium[0] + np.linspace(-reach, reach, 401)
    value.plot(voltage, gain * model.lift(voltage[:, None])[:, 0], color=style.BLUE, label="learned S$_u$", zorder=3)
    _true_curves(value, voltage, plant)
    _slopes(slope, model, voltage, slopes)
    if threshold is not None:
        true_slope = np.where(np.abs(voltage) < threshold, 0.0, scale / gain)
        slope.step(voltage, true_slope, where="mid", color=style.INK, lw=0.9, ls="--", label="dead-zone")
    for axes in (value, slope):
        style.above(axes)
        axes.set_xlabel("Input (physical unit)" if threshold is None else "Armature voltage (V)")
    value.set_ylabel("S$_u$ (scaled units, –)" if threshold is None else "S$_u$ scaled to the true gain (V)")
    slope.set_ylabel("Local slope of S$_u$ (scaled units, –)")
    return fig


def _gain_to_volts(model: SSM, threshold: float) -> float:
    """S_u is free up to a factor that B takes up: the factor that brings it nearest to the dead-zone, least squares."""
    reach = REACH_IN_SCALES * float(model.input_scale[0])
    voltage = model.input_equilibrium[0] + np.linspace(-reach, reach, 401)
    learned = model.lift(voltage[:, None])[:, 0]
    return float(_dead_zone(voltage, threshold) @ learned / (learned @ learned))


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
