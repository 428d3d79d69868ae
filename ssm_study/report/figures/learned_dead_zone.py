"""Input map S_u that the model learned (left) and its slope at each input (right). The certificate
holds for every map whose slopes lie in the shaded interval. For the simulated motor, the dashed
lines are the true dead zone and its slope. The records determine S_u only up to a factor; on the
left it has the factor that fits the dead zone best. At standstill friction widens the dead zone, as
the dotted line shows."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.models.identified import SSM
from ssm_study.report.study_folder import NothingToDraw, StudyFolder

# how far to draw: far enough for the straight part, near enough to see the dead zone
REACH_IN_DEAD_ZONES = 8
# how far training reached, in input scales: where the gain is compared, and drawn otherwise
REACH_IN_SCALES = 2.0
FRICTION = ("coulomb_torque_nm", "resistance_ohm", "torque_constant_nm_per_a")
POINTS = 401  # of the curves
FLAT = 0.1  # share of the outer slope below which the middle is flat
STEEP = 0.9  # and from which on it is not flatter than the rest
TRUE_LINE: dict[str, Any] = {"color": style.INK, "lw": 0.9, "ls": "--"}
Range = Float[np.ndarray, "N"]


def draw(study: StudyFolder) -> Figure:
    """Draw the best run's learned input map beside the motor's true dead zone, and the slope of the
    map."""
    reason = "No run left a model without neurons."
    model, record, config = study.read_from_best("model", "record", "config", otherwise=reason)
    if model.scaffold_in.inputs != 1:
        raise NothingToDraw("S$_u$ has several inputs: there is no curve to draw.")
    fig = style.new_figure(style.PAGE_IN, 2.5)
    value, slope = fig.subplots(1, 2)
    threshold, friction_v = known_dead_zone(config)
    scale = float(model.scale.input_scale[0])
    if threshold is None:
        reach = REACH_IN_SCALES * scale
        gain = 1.0
    else:
        reach = REACH_IN_DEAD_ZONES * threshold
        gain = _dead_zone_scale_factor(model, threshold)
    voltage = _drawn_voltages(model, reach)
    learned = gain * _input_map_values(model, voltage)
    value.plot(voltage, learned, color=style.BLUE, label="learned S$_u$", zorder=3)
    _draw_slopes(slope, model, voltage, record)
    if threshold is not None:
        value.plot(
            voltage, _apply_dead_zone(voltage, threshold), label="true dead zone", **TRUE_LINE
        )
        true_slope = np.where(np.abs(voltage) < threshold, 0.0, scale / gain)
        slope.step(voltage, true_slope, where="mid", label="true dead zone", **TRUE_LINE)
        sentence = _dead_zone_sentence(model, voltage, threshold)
        fig.suptitle(sentence, size=8, x=0.01, ha="left")
        if friction_v:
            widened = _apply_dead_zone(voltage, threshold + friction_v)
            value.plot(
                voltage, widened, color=style.GREY, lw=0.9, ls=":", label="true, at standstill"
            )
    _label_axes(value, slope, threshold is not None)
    return fig


def _label_axes(value: Axes, slope: Axes, is_motor: bool) -> None:
    """Label the axes of an input map and its slope, in volts if the motor's constants are known."""
    for axes in (value, slope):
        style.place_legend_above(axes)
        axes.set_xlabel("Armature voltage (V)" if is_motor else "Input (physical unit)")
    scaled_to_gain = "S$_u$ scaled to the true gain (V)"
    value.set_ylabel(scaled_to_gain if is_motor else "S$_u$ (scaled units, –)")
    slope.set_ylabel("Local slope of S$_u$ (scaled units, –)")


def known_dead_zone(config: Mapping[str, Any]) -> tuple[float | None, float]:
    """Dead zone of a simulated motor in volts, and the voltage that Coulomb friction adds to it
    when the motor stands still.

    None for a recording, beside which the group's default plant stands.
    """
    data = config.get("data") or {}
    kind = str(data.get("_target_", ""))
    plant = config.get("plant") or {}
    if not kind.endswith(".SimulatedData"):
        plant = {}
    torque, resistance, constant = (plant.get(name, 0.0) for name in FRICTION)
    friction_v = 2 * torque * resistance / constant if constant else 0.0
    return plant.get("dead_zone_v"), friction_v


def _drawn_voltages(model: SSM, half_width: float) -> Range:
    """Input voltages around the equilibrium at which the learned input map is drawn."""
    deviations = np.linspace(-half_width, half_width, POINTS)
    return model.scale.input_equilibrium[0] + deviations


def _input_map_values(model: SSM, voltage: Range) -> Range:
    """Output values of the learned input map at given physical voltages."""
    mapped = model.map_input(voltage[:, None])
    return mapped[:, 0]


def _dead_zone_sentence(model: SSM, voltage: Range, threshold: float) -> str:
    """Sentence on how much of the motor's true dead zone the learned input map reproduces. Zero
    would be all of it."""
    rise = np.diff(_input_map_values(model, voltage)) / np.diff(voltage)  # per volt
    middles = (voltage[1:] + voltage[:-1]) / 2
    is_inside = np.abs(middles) < threshold
    share = float(rise[is_inside].mean() / rise[~is_inside].mean())
    if share < FLAT:
        learned = "a dead zone"
    elif share < STEEP:
        learned = "no dead zone, only a flatter middle"
    else:
        learned = "no dead zone"
    percent = f"{100 * share:.0f} %"
    return f"Learned: {learned}. Mean slope inside the true dead zone: {percent} of that outside."


def _dead_zone_scale_factor(model: SSM, threshold: float) -> float:
    """Least-squares factor that fits a learned input map to the dead zone. S_u is determined only
    up to a factor, which B compensates."""
    scale = float(model.scale.input_scale[0])
    voltage = _drawn_voltages(model, REACH_IN_SCALES * scale)
    learned = _input_map_values(model, voltage)
    true = _apply_dead_zone(voltage, threshold)
    return float(true @ learned / (learned @ learned))


def _apply_dead_zone(voltage: Range, threshold: float) -> Range:
    """True dead-zone characteristic of the motor: zero inside, the voltage minus the threshold
    outside."""
    beyond = np.maximum(np.abs(voltage) - threshold, 0.0)
    return np.sign(voltage) * beyond


def _draw_slopes(axes: Axes, model: SSM, voltage: Range, record: Mapping[str, Any]) -> None:
    """Draw the slope of the learned input map and the interval of slopes that the certificate
    assumes."""
    deviations = voltage - model.scale.input_equilibrium[0]
    scaled = deviations / model.scale.input_scale[0]
    jacobians = [model.scaffold_in.jacobian(np.array([v])) for v in scaled]
    local = [jacobian[0, 0] for jacobian in jacobians]
    lower = record.get("input_slope_lower")
    upper = record.get("input_slope_upper")
    if lower is not None and upper is not None:
        label = f"certified [{lower:.3g}, {upper:.3g}]"
        axes.axhspan(lower, upper, color=style.SKY, alpha=0.2, lw=0, label=label)
    axes.step(voltage, local, where="post", color=style.BLUE, label="learned", zorder=3)
