"""C code for the neurons in the model of an exported controller."""

import re
from collections.abc import Sequence

from ssm_study.export.device import DeviceController
from ssm_study.models.structured import NEURONS


def render_neurons(device: DeviceController, prefix: str) -> dict[str, str]:
    """C code for the neurons of a controller's model, keyed by placeholder; empty texts for a model
    without neurons.

    `include` is math.h, `neurons` their function, `read` its call where the observer's error is
    not known yet, `driven` the call where it is.
    """
    if device.controller.neurons is None:
        return dict.fromkeys(("include", "neurons", "read", "driven"), "")
    read = join_lines(_render_neuron_output(device, prefix))
    driven = join_lines(_render_neuron_update(device, prefix))
    lines = _render_neuron_function(device, prefix)
    neurons = "\n" + join_lines(lines)
    return {
        "read": read,
        "driven": driven,
        "neurons": neurons,
        "include": "#include <math.h> /* link with -lm */\n\n",
    }


def join_lines(lines: Sequence[str]) -> str:
    """Join lines of C code to one text."""
    return "".join(f"{line}\n" for line in lines)


def _render_neuron_function(device: DeviceController, prefix: str) -> list[str]:
    """Lines of C code of the function that computes the outputs of the neurons."""
    real = device.real
    neurons = device.controller.neurons
    assert neurons is not None
    states = len(neurons.into)
    count = len(neurons.kinds)
    f = ("x", states)
    g = ("lifted", neurons.g.shape[1])
    l_z = ("error", neurons.l_z.shape[1])
    arguments = {"f": f, "g": g, "l_z": l_z}
    parameters = ", ".join(f"const {real} *{vector}" for vector, _ in arguments.values())
    lines = [f"static inline void {prefix}_neurons({parameters}, {real} *w) {{"]
    lines.append(f"    {real} z;")
    lines.append(f"    for (int i = 0; i < {count}; ++i) w[i] = {prefix}_bias[i];")
    for matrix, (vector, size) in arguments.items():
        lines.append(f"    {prefix}_matvec({count}, {size}, {prefix}_{matrix}, {vector}, w);")
    for i, kind in enumerate(neurons.kinds):
        lines.append(f"    z = w[{i}];")
        lines.append(f"    w[{i}] = {_render_activation(kind, real)} - {prefix}_phi_bias[{i}];")
    return [*lines, "}"]


def _render_activation(activation: str, c_type: str) -> str:
    """C expression for the value of an activation function."""
    code = NEURONS[activation].c
    if c_type == "float":  # tanhf and 1.0f
        code = re.sub(r"([a-z]\w+)\(", r"\1f(", code)
        code = re.sub(r"(\d\.\d)", r"\1f", code)
    return code


def _render_neuron_output(device: DeviceController, prefix: str) -> list[str]:
    """Lines of C code that add the neurons' contribution to the predicted output."""
    real = device.real
    neurons = device.controller.neurons
    assert neurons is not None
    if not neurons.h.any():
        return []
    outputs, count = neurons.h.shape
    return [
        f"    const {real} none[{neurons.l_z.shape[1]}] = {{0}};",
        f"    {real} seen[{count}];",
        f"    {prefix}_neurons(state->x, lifted, none, seen);",
        f"    {prefix}_matvec({outputs}, {count}, {prefix}_h, seen, ybar);",
    ]


def _render_neuron_update(device: DeviceController, prefix: str) -> list[str]:
    """Lines of C code that add the neurons' contribution to the next state."""
    neurons = device.controller.neurons
    assert neurons is not None
    states, count = neurons.into.shape
    return [
        f"    {device.real} w[{count}];",
        f"    {prefix}_neurons(state->x, lifted, error, w);",
        f"    {prefix}_matvec({states}, {count}, {prefix}_into, w, next);",
    ]
