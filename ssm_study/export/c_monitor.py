"""Monitor in the exported C code, which checks that the model error stays within the certified
bound.

With the model's own output m for the input that is applied, from rest, and `e = y - m`, noise and
initial state included, the device keeps

    g  <-  max(0, g + |e - c m|^2 - kappa^2 (floor^2 |m|^2 + |W m|^2 + |V u|^2) - allowance)

and raises a flag where g exceeds `limit`, which the first output fixes. Until then what was added
since the start is at most `limit`, so the inequality of `measured_discs`, summed along the loop's
own signals, bounds their energy, whatever the plant is: `delta sum |eta|^2 <= V(0) + limit + T
allowance`. Scope: regulation to rest, while no input limit acts. Source: docs/trust.md,
"Monitored".
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np
import scipy
from jaxtyping import Float

from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.export.c_tables import render_array, render_number
from ssm_study.export.device import DeviceController
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model
from ssm_study.systems import StateSpace

_WATCH = Path(__file__).with_name("monitor.h.txt")
BAND = 0.05  # of the output's scale: an error that stays below it is no alarm
START = 0.5  # of the output's scale: a decay from there is no alarm
ROOM = 1.5  # times the first measured output, from where a decay is no alarm either
UNMONITORED = "the certificate covers no mismatch, or not that of this kind of model"


@dataclass(frozen=True, kw_only=True)
class WeightingFilter:
    """Frequency weighting filter of one channel, as a difference equation. Its state is `x_0 <-
    entering + a x`, the others shifted by one; it gives `c x + d entering`, kappa included."""

    a: Float[np.ndarray, "o"]
    c: Float[np.ndarray, "o"]
    d: float

    @classmethod
    def from_matrices(
        cls, filter_matrix: Float[np.ndarray, "v v"], disc_radius: float
    ) -> "WeightingFilter | None":
        """Convert state-space matrices in controller canonical form to a weighting filter; None for
        matrices in any other form. `[A, B; C, D]`."""
        order = len(filter_matrix) - 1
        shift = np.eye(order, k=-1)[1:]
        first = np.eye(order)[:, :1]
        is_shift = np.array_equal(filter_matrix[1:order, :order], shift)
        if order and not (is_shift and np.array_equal(filter_matrix[:order, order:], first)):
            return None
        c = disc_radius * filter_matrix[order, :order]
        return cls(
            a=filter_matrix[:1, :order].ravel()[:order],
            c=c,
            d=float(disc_radius * filter_matrix[-1, -1]),
        )


@dataclass(frozen=True, kw_only=True)
class MonitorConstants:
    """Constants of the monitor in the exported C code, in scaled units: centre of the disc of model
    errors, frequency weights and alarm limits. Kappa is included. `states` of the model come first
    among the controller's."""

    states: int
    centre: float
    floor: float
    output: WeightingFilter
    input: WeightingFilter
    allowance: float
    limit: float

    @classmethod
    def for_design(cls, model: Model, design: Design) -> "MonitorConstants | None":
        """Constants of the monitor for a design whose certificate holds for the recorded model
        error; None for any other design.

        The allowance is a standing error of the settling band in every output; the limit the energy
        with which the model comes to rest from outputs half their scale away. A loop that starts
        from afar has a larger one (`alarm_limit`).
        """
        part = design.extra_certificates.get(MeasuredDiscs.part)
        is_proved = isinstance(part, MeasuredDiscs) and part.certified
        if not is_proved or not isinstance(model, SSM) or model.scale.disturbances:
            return None
        assert isinstance(part, MeasuredDiscs)
        output = WeightingFilter.from_matrices(part.weight_output, part.kappa)
        into = WeightingFilter.from_matrices(part.weight_input, part.kappa)
        if output is None or into is None:
            return None
        return cls(
            states=model.order,
            centre=part.centre,
            floor=part.kappa * part.floor,
            output=output,
            input=into,
            allowance=BAND**2 * model.scale.outputs,
            limit=START**2 * free_decay_energy(model.linear),
        )

    def alarm_limit(self, first_output: Float[np.ndarray, "p"]) -> float:
        """Alarm limit for the monitor's running sum, for a given first measured output. It is the
        energy of the decay from half a scale, or from `ROOM` times that output."""
        farther = (ROOM / START) ** 2 * float((first_output**2).sum())
        return self.limit * max(1.0, farther)


def free_decay_energy(system: StateSpace) -> float:
    """Sum of the output energies `sum |y|^2` of a linear system released from each equilibrium at
    which one output is one and the others are zero."""
    rest, _, gain = system.equilibrium_basis()
    starts = rest @ np.linalg.pinv(gain)
    observability = scipy.linalg.solve_discrete_lyapunov(system.a.T, system.c.T @ system.c)
    return float(np.trace(starts.T @ observability @ starts))


MEMBERS = """
#ifdef MONITOR
    $real model[$states], of_output[$output_states], of_input[$input_states], excess, limit;
    int flag; /* the plant has left what the certificate covers */
#endif
"""
RESET = """#ifdef MONITOR
    for (int i = 0; i < $states; ++i) state->model[i] = 0;
    for (int i = 0; i < $output_states; ++i) state->of_output[i] = 0;
    for (int i = 0; i < $input_states; ++i) state->of_input[i] = 0;
    state->excess = 0;
    state->limit = 0;
    state->flag = 0;
#endif
"""
CALL = """#ifdef MONITOR
    {
        $real whole[$p];
        for (int i = 0; i < $p; ++i) whole[i] = measured[i] + aimed[i];
        ${name}_watch(state, v, lifted, whole);
    }
#endif
"""
REFUSED = f"""
#ifdef MONITOR
#error "no monitor: {UNMONITORED}"
#endif
"""


def render_monitor(
    device: DeviceController,
    monitor: MonitorConstants | None,
    template_values: Mapping[str, object],
) -> dict[str, str]:
    """C code of the monitor, keyed by the placeholders of the template. Without a monitor, its
    switch in the header leads to a compiler error.
    """
    if monitor is None:
        none = dict.fromkeys(("monitor_members", "monitor_call", "monitor_reset"), "")
        return none | {"monitor_watch": REFUSED}
    real = device.real
    controller = device.controller
    states = monitor.states
    tables = {"model_a": controller.a[:states, :states], "model_c": controller.c[:, :states]}
    texts: dict[str, object] = {"states": states, "beyond": render_number(1 + monitor.centre, real)}
    texts["farther"] = render_number((ROOM / START) ** 2, real)
    for label in ("floor", "limit", "allowance"):
        texts[label] = render_number(getattr(monitor, label), real)
    channels = {"output": controller.scale.outputs, "input": controller.scale.inputs}
    for side, count in channels.items():
        weight: WeightingFilter = getattr(monitor, side)
        order = len(weight.a)
        texts[f"{side}_order"] = order
        texts[f"{side}_states"] = max(order * count, 1)  # C has no array of size zero
        texts[f"{side}_d"] = render_number(weight.d, real)
        tables[f"{side}_a"] = weight.a if order else np.zeros(1)
        tables[f"{side}_c"] = weight.c if order else np.zeros(1)
    texts["tables"] = "".join(
        render_array(f"{template_values['name']}_{label}", values, real)
        for label, values in tables.items()
    )
    texts |= template_values
    parts = {
        "monitor_members": MEMBERS,
        "monitor_watch": _WATCH.read_text(encoding="utf-8"),
        "monitor_call": CALL,
        "monitor_reset": RESET,
    }
    return {label: Template(text).substitute(texts) for label, text in parts.items()}
