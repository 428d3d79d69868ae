"""Export of one sample of the controller as an ONNX model, `(y, state) -> (u, next_state)`. With
measured disturbances it takes `(y, state, d)`.

In doubles, for any batch size.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import PortableMap
from ssm_study.export.portable import PortableController, PortableNeurons

OPSET = 17
IR_VERSION = 8  # old enough for runtimes in the field


class _GraphBuilder:
    """Builder of an ONNX graph that appends one operator after another.

    An array among the inputs of a node becomes a constant.
    """

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def append_operator(
        self, operator: str, *inputs: str | Float[np.ndarray, "..."], output: str = ""
    ) -> str:
        """Append an operator to the ONNX graph and return the name of its output."""
        from onnx import helper

        names = [value if isinstance(value, str) else self.add_constant(value) for value in inputs]
        output = output or f"t{len(self.nodes)}"
        node = helper.make_node(operator, names, [output])
        self.nodes.append(node)
        return output

    def add_constant(self, value: Float[np.ndarray, "..."]) -> str:
        """Add a constant to the ONNX graph and return its name."""
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        values = np.ascontiguousarray(value, dtype=np.float64)
        self.constants.append(numpy_helper.from_array(values, name))
        return name

    def append_product(self, signal: str, matrix: Float[np.ndarray, "r c"]) -> str:
        """Append to the ONNX graph the product of a signal and a transposed matrix."""
        return self.append_operator("MatMul", signal, matrix.T)

    def append_static_map(self, static_map: PortableMap, argument: str) -> str:
        """Append to the ONNX graph the evaluation of a static map, layer by layer. `phi(z) -
        phi(b)`."""
        terms = [self.append_product(argument, static_map.linear)]
        if static_map.network is None:
            return self.append_operator("Sum", *terms)
        d = argument
        zero = np.zeros(1)
        for w, b, low, high in static_map.network.hidden_layers():
            weighted = self.append_product(d, w)
            z = self.append_operator("Add", weighted, b)
            above = self.append_operator("Max", z, zero)
            below = self.append_operator("Min", z, zero)
            steep = self.append_operator("Mul", above, high)
            flat = self.append_operator("Mul", below, low)
            slopes_at_zero = np.where(b >= 0, high, low)
            d = self.append_operator("Sum", steep, flat, -slopes_at_zero * b)
        last_weight = static_map.network.weights[-1]
        terms.append(self.append_product(d, last_weight))
        return self.append_operator("Sum", *terms)

    def append_neurons(self, neurons: PortableNeurons, x: str, lifted: str, error: str = "") -> str:
        """Append to the ONNX graph the outputs of the model's neurons. `phi(F x + G v + L_z e + b)
        - phi(b)`.

        The kinds stand side by side, each masked to its own neurons.
        """
        from_state = self.append_product(x, neurons.f)
        from_input = self.append_product(lifted, neurons.g)
        terms = [from_state, from_input]
        if error:
            terms.append(self.append_product(error, neurons.l_z))
        z = self.append_operator("Sum", *terms, neurons.bias)
        parts = []
        for kind in sorted(set(neurons.kinds)):
            is_of_kind = np.array([each == kind for each in neurons.kinds], dtype=float)
            activated = self.append_activation(kind, z)
            parts.append(self.append_operator("Mul", activated, is_of_kind))
        return self.append_operator("Sum", *parts, -neurons.phi_bias)

    def append_activation(self, activation: str, argument: str) -> str:
        """Append an activation function to the ONNX graph, by operators that runtimes support for
        doubles."""
        if activation == "tanh":
            return self.append_operator("Tanh", argument)
        above = self.append_operator("Max", argument, np.zeros(1))
        if activation == "relu":
            return above
        if activation == "softplus":  # max(z, 0) + ln(1 + exp(-|z|))
            magnitude = self.append_operator("Abs", argument)
            negative = self.append_operator("Neg", magnitude)
            fading = self.append_operator("Exp", negative)
            increment = self._append_plus_one(fading)
            logarithm = self.append_operator("Log", increment)
            return self.append_operator("Add", above, logarithm)
        one = np.ones(1)
        from_below = self.append_operator("Max", argument, -one)
        clipped = self.append_operator("Min", from_below, one)
        if activation == "saturation":
            return clipped
        square = self.append_operator("Mul", clipped, clipped)
        third = self.append_operator("Div", clipped, np.full(1, 3.0))
        cubed = self.append_operator("Mul", square, third)
        # Clipped cubic: slope one beyond.
        beyond = self.append_operator("Sub", argument, clipped)
        return self.append_operator("Add", cubed, beyond)

    def _append_plus_one(self, x: str) -> str:
        """Append to the ONNX graph the addition of one to a signal."""
        return self.append_operator("Add", x, np.ones(1))


def build_onnx_model(controller: PortableController, description: str) -> Any:
    """Build and check the ONNX model of a controller."""
    import onnx
    from onnx import TensorProto, checker, helper

    graph = _build_controller_graph(controller)
    states = len(controller.a)

    def declare_signal(name: str, width: int) -> Any:
        """Declaration of an input or output of an ONNX graph."""
        return helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["batch", width])

    scale = controller.scale
    inputs = [declare_signal("y", scale.outputs), declare_signal("state", states)]
    if scale.disturbances:
        inputs.append(declare_signal("d", scale.disturbances))
    outputs = [declare_signal("u", scale.inputs), declare_signal("next_state", states)]
    onnx_graph = helper.make_graph(
        graph.nodes, "controller", inputs, outputs, graph.constants, description
    )
    opset = helper.make_opsetid("", OPSET)
    model: onnx.ModelProto = helper.make_model(onnx_graph, opset_imports=[opset])
    model.ir_version = IR_VERSION
    model.producer_name = "ssm-study"
    checker.check_model(model, full_check=True)
    return model


def _build_controller_graph(controller: PortableController) -> _GraphBuilder:
    """Build the ONNX graph that computes one sample of the controller. `V = K xh` is the scaled
    input, the others as in PortableController."""
    graph = _GraphBuilder()
    scale = controller.scale
    neurons = controller.neurons
    v = graph.append_product("state", controller.k)
    physical = graph.append_operator("Mul", v, scale.input_scale)
    graph.append_operator("Add", physical, scale.input_equilibrium, output="u")
    lifted = graph.append_static_map(controller.s_in, v)
    from_state = graph.append_product("state", controller.c)
    from_input = graph.append_product(lifted, controller.d)
    read = graph.append_operator("Add", from_state, from_input)
    if neurons and neurons.h.any():
        neuron_outputs = graph.append_neurons(neurons, "state", lifted)
        from_neurons = graph.append_product(neuron_outputs, neurons.h)
        read = graph.append_operator("Add", read, from_neurons)
    predicted = graph.append_static_map(controller.s_out, read)
    shifted = graph.append_operator("Sub", "y", scale.output_equilibrium)
    measured = graph.append_operator("Div", shifted, scale.output_scale)
    error = graph.append_operator("Sub", predicted, measured)
    factors = {
        "state": controller.a,
        lifted: controller.b,
        error: controller.l,
        measured: controller.e,
    }
    if scale.disturbances:
        moved = graph.append_operator("Sub", "d", scale.disturbance_equilibrium)
        disturbance = graph.append_operator("Div", moved, scale.disturbance_scale)
        factors[disturbance] = controller.b_d
    if neurons:
        corrected_outputs = graph.append_neurons(neurons, "state", lifted, error)
        factors[corrected_outputs] = neurons.into
    terms = [graph.append_product(signal, matrix) for signal, matrix in factors.items()]
    graph.append_operator("Sum", *terms, output="next_state")
    return graph
