"""Nonlinearity that the network learned of the motor: S_u scaled to volts over the true dead-zone
(left), and its local slope inside the certified interval (right). Coulomb friction widens the
dead-zone seen at rest; the dotted line includes it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.models.identified import SSM
from ssm_study.report.study_folder import NothingToDraw, StudyFolder

REACH_IN_DEAD_ZONES = (
    8  # how far to draw: far enough for the straight part, near enough to see the dead-zone
)
# how far training reached, in input scales: where the gain is compared, and drawn otherwise
REACH_IN_SCALES = 2.0
FRICTION = ("coulomb_torque_nm", "resistance_ohm", "torque_constant_nm_per_a")
Range = Float[np.ndarray, "N"]


def draw(study: StudyFolder) -> Figure:
    """Draw the learned input map beside the motor's true dead zone, and the slope of the map."""
    model, record, config = study.read_from_best(
        "model", "record", "config", otherwise="No run left a model without neurons."
    )
    if model.scaffold_in.inputs != 1:
        raise NothingToDraw("S$_u$ has several inputs: there is no curve to draw.")
    fig = style.new_figure(style.PAGE_IN, 2.5)
    value, slope = fig.subplots(1, 2)
    (threshold, held), scale = known_dead_zone(config), float(model.scale.input_scale[0])
    voltage = _voltage_range(
        model, REACH_IN_SCALES * scale if threshold is None else REACH_IN_DEAD_ZONES * threshold
    )
    gain = 1.0 if threshold is None else _gain_to_volts(model, threshold)
    value.plot(
        voltage,
        gain * _mapped_voltage(model, voltage),
        color=style.BLUE,
        label="learned S$_u$",
        zorder=3,
    )
    _draw_slopes(slope, model, voltage, record)
    if threshold is not None:
        true = np.where(np.abs(voltage) < threshold, 0.0, scale / gain)
        line = {"color": style.INK, "lw": 0.9}
        value.plot(voltage, _dead_zone(voltage, threshold), ls="--", label="true dead-zone", **line)
        slope.step(voltage, true, where="mid", ls="--", label="dead-zone", **line)
        fig.suptitle(_dead_zone_sentence(model, voltage, threshold), size=8, x=0.01, ha="left")
    if threshold is not None and held:
        widened = _dead_zone(voltage, threshold + held)
        value.plot(voltage, widened, color=style.GREY, lw=0.9, ls=":", label="with friction")
    for axes in (value, slope):
        style.place_legend_above(axes)
        axes.set_xlabel("Input (physical unit)" if threshold is None else "Armature voltage (V)")
    value.set_ylabel(
        "S$_u$ (scaled units, –)" if threshold is None else "S$_u$ scaled to the true gain (V)"
    )
    slope.set_ylabel("Local slope of S$_u$ (scaled units, –)")
    return fig


def known_dead_zone(config: Mapping[str, Any]) -> tuple[float | None, float]:
    """Dead zone of the simulated plant, V, and the voltage by which the friction of both shafts
    widens it at rest.

    None for a recording, beside which the group's default plant stands.
    """
    simulated = str((config.get("data") or {}).get("_target_", "")).endswith(".SimulatedData")
    plant = (config.get("plant") or {}) if simulated else {}
    torque, resistance, constant = (plant.get(name, 0.0) for name in FRICTION)
    return plant.get("dead_zone_v"), 2 * torque * resistance / constant if constant else 0.0


def _voltage_range(model: SSM, reach: float) -> Range:
    """Input voltages around the equilibrium at which the map is drawn."""
    return model.scale.input_equilibrium[0] + np.linspace(-reach, reach, 401)


def _mapped_voltage(model: SSM, voltage: Range) -> Range:
    """Values of the learned input map at given physical voltages."""
    return model.map_input(voltage[:, None])[:, 0]


def _dead_zone_sentence(model: SSM, voltage: Range, threshold: float) -> str:
    """Sentence on how much of the true dead zone the input map has learned. Zero would be all of
    it."""
    rise = np.diff(_mapped_voltage(model, voltage)) / np.diff(voltage)  # per volt
    inside = np.abs(voltage[1:] + voltage[:-1]) / 2 < threshold
    share = float(rise[inside].mean() / rise[~inside].mean())
    learned = (
        "a dead-zone"
        if share < 0.1
        else "no dead-zone, only a flatter middle"
        if share < 0.9
        else "no dead-zone"
    )
    return (
        f"Learned: {learned}. Inside the true one the slope is {100 * share:.0f} % of that outside."
    )


def _gain_to_volts(model: SSM, threshold: float) -> float:
    """Factor that brings the input map closest to the dead zone, by least squares. S_u is
    determined only up to a factor, which B compensates."""
    voltage = _voltage_range(model, REACH_IN_SCALES * float(model.scale.input_scale[0]))
    learned = _mapped_voltage(model, voltage)
    return float(_dead_zone(voltage, threshold) @ learned / (learned @ learned))


def _dead_zone(voltage: Range, threshold: float) -> Range:
    """True dead zone of the motor: zero inside, the voltage minus the threshold outside."""
    return np.sign(voltage) * np.maximum(np.abs(voltage) - threshold, 0.0)


def _draw_slopes(axes: Axes, model: SSM, voltage: Range, record: Mapping[str, Any]) -> None:
    """Draw the slope of the learned input map and the interval that the certificate assumes."""
    scaled = (voltage - model.scale.input_equilibrium[0]) / model.scale.input_scale[0]
    local = [model.scaffold_in.jacobian(np.array([v]))[0, 0] for v in scaled]
    lower = record.get("input_slope_lower")
    upper = record.get("input_slope_upper")
    if lower is not None and upper is not None:
        axes.axhspan(
            lower,
            upper,
            color=style.SKY,
            alpha=0.2,
            lw=0,
            label=f"certified [{lower:.3g}, {upper:.3g}]",
        )
    axes.step(voltage, local, where="post", color=style.BLUE, label="learned", zorder=3)
