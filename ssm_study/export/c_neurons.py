"""C code for the neurons of a controller's model."""

import re
from collections.abc import Sequence

from ssm_study.export.device import Device
from ssm_study.models.structured import NEURONS


def render_neurons(device: Device, name: str) -> dict[str, str]:
    """C code for the neurons of the model, keyed by its place in the header; empty texts for a
    model without neurons.

    `include` is math.h, `neurons` their function, `read` its call where the observer's error is
    not known yet, `driven` the call where it is.
    """
    if device.controller.neurons is None:
        return dict.fromkeys(("include", "neurons", "read", "driven"), "")
    read = join_lines(_render_neuron_output(device, name))
    driven = join_lines(_render_neuron_update(device, name))
    lines = _render_neuron_function(device, name)
    neurons = "\n" + join_lines(lines)
    return {
        "read": read,
        "driven": driven,
        "neurons": neurons,
        "include": "#include <math.h> /* link with -lm */\n\n",
    }


def join_lines(lines: Sequence[str]) -> str:
    """Join lines of code to one text."""
    return "".join(f"{line}\n" for line in lines)


def _render_neuron_function(device: Device, name: str) -> list[str]:
    """C function that computes the outputs of the neurons."""
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
    lines = [f"static inline void {name}_neurons({parameters}, {real} *w) {{"]
    lines.append(f"    {real} z;")
    lines.append(f"    for (int i = 0; i < {count}; ++i) w[i] = {name}_bias[i];")
    for matrix, (vector, size) in arguments.items():
        lines.append(f"    {name}_matvec({count}, {size}, {name}_{matrix}, {vector}, w);")
    for i, kind in enumerate(neurons.kinds):
        lines.append(f"    z = w[{i}];")
        lines.append(f"    w[{i}] = {_render_activation(kind, real)} - {name}_phi_bias[{i}];")
    return [*lines, "}"]


def _render_activation(kind: str, real: str) -> str:
    """C expression of an activation function."""
    code = NEURONS[kind].c
    if real == "float":  # tanhf and 1.0f
        code = re.sub(r"([a-z]\w+)\(", r"\1f(", code)
        code = re.sub(r"(\d\.\d)", r"\1f", code)
    return code


def _render_neuron_output(device: Device, name: str) -> list[str]:
    """C code that adds the neurons' contribution to the predicted output."""
    real = device.real
    neurons = device.controller.neurons
    assert neurons is not None
    if not neurons.h.any():
        return []
    outputs, count = neurons.h.shape
    return [
        f"    const {real} none[{neurons.l_z.shape[1]}] = {{0}};",
        f"    {real} seen[{count}];",
        f"    {name}_neurons(state->x, lifted, none, seen);",
        f"    {name}_matvec({outputs}, {count}, {name}_h, seen, ybar);",
    ]


def _render_neuron_update(device: Device, name: str) -> list[str]:
    """C code that adds the neurons' contribution to the next state."""
    neurons = device.controller.neurons
    assert neurons is not None
    states, count = neurons.into.shape
    return [
        f"    {device.real} w[{count}];",
        f"    {name}_neurons(state->x, lifted, error, w);",
        f"    {name}_matvec({states}, {count}, {name}_into, w, next);",
    ]
