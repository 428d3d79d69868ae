"""Export of the controller as an ONNX model of one sample, `(y, state) -> (u, next_state)`. With
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


class _Graph:
    """Builder of an ONNX graph with its nodes in order; rows of a signal are samples.

    An array among the inputs of a node becomes a constant.
    """

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def apply(
        self, operator: str, *inputs: str | Float[np.ndarray, "..."], output: str = ""
    ) -> str:
        """Append an operator to the graph and return the name of its output."""
        from onnx import helper

        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        output = output or f"t{len(self.nodes)}"
        node = helper.make_node(operator, names, [output])
        self.nodes.append(node)
        return output

    def constant(self, value: Float[np.ndarray, "..."]) -> str:
        """Add a constant to the graph and return its name."""
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        values = np.ascontiguousarray(value, dtype=np.float64)
        self.constants.append(numpy_helper.from_array(values, name))
        return name

    def times(self, x: str, matrix: Float[np.ndarray, "r c"]) -> str:
        """Append the product of a signal and a transposed matrix."""
        return self.apply("MatMul", x, matrix.T)

    def map(self, s: PortableMap, v: str) -> str:
        """Append the output of the map S, layer by layer: `phi(z) - phi(b)`."""
        terms = [self.times(v, s.linear)]
        if s.network is None:
            return self.apply("Sum", *terms)
        d = v
        for w, b, low, high in s.network.hidden():
            z = self.apply("Add", self.times(d, w), b)
            above = self.apply("Max", z, np.zeros(1))
            below = self.apply("Min", z, np.zeros(1))
            steep = self.apply("Mul", above, high)
            flat = self.apply("Mul", below, low)
            d = self.apply("Sum", steep, flat, -np.where(b >= 0, high, low) * b)
        weights = s.network.weights
        terms.append(self.times(d, weights[-1]))
        return self.apply("Sum", *terms)

    def neurons(self, neurons: PortableNeurons, x: str, lifted: str, error: str = "") -> str:
        """Append the outputs of the neurons, `phi(F x + G v + L_z e + b) - phi(b)`.

        The kinds stand side by side, each masked to its own neurons.
        """
        terms = [self.times(x, neurons.f), self.times(lifted, neurons.g)]
        if error:
            terms.append(self.times(error, neurons.l_z))
        z = self.apply("Sum", *terms, neurons.bias)
        parts = []
        for kind in sorted(set(neurons.kinds)):
            own = np.array([each == kind for each in neurons.kinds], dtype=float)
            parts.append(self.apply("Mul", self.phi(kind, z), own))
        return self.apply("Sum", *parts, -neurons.phi_bias)

    def phi(self, kind: str, z: str) -> str:
        """Append one kind of activation function, in operators that runtimes have for doubles."""
        if kind == "tanh":
            return self.apply("Tanh", z)
        above = self.apply("Max", z, np.zeros(1))
        if kind == "relu":
            return above
        if kind == "softplus":  # max(z, 0) + ln(1 + exp(-|z|))
            negative = self.apply("Neg", self.apply("Abs", z))
            fading = self.apply("Exp", negative)
            return self.apply("Add", above, self.apply("Log", self._plus_one(fading)))
        from_below = self.apply("Max", z, -np.ones(1))
        clipped = self.apply("Min", from_below, np.ones(1))
        if kind == "saturation":
            return clipped
        square = self.apply("Mul", clipped, clipped)
        third = self.apply("Div", clipped, np.full(1, 3.0))
        cubed = self.apply("Mul", square, third)
        # Clipped cubic: slope one beyond.
        return self.apply("Add", cubed, self.apply("Sub", z, clipped))

    def _plus_one(self, x: str) -> str:
        """Append the sum of a signal and one."""
        return self.apply("Add", x, np.ones(1))


def onnx_model(controller: PortableController, about: str) -> Any:
    """Checked `onnx.ModelProto` of the controller; needs the extra `export`."""
    import onnx
    from onnx import TensorProto, checker, helper

    graph = _cell(controller)
    states = len(controller.a)

    def signal(name: str, width: int) -> Any:
        """Declaration of an input or output of the graph."""
        return helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["batch", width])

    outputs = controller.scale.outputs
    inputs = [signal("y", outputs), signal("state", states)]
    if controller.scale.disturbances:
        disturbances = controller.scale.disturbances
        inputs.append(signal("d", disturbances))
    made = helper.make_graph(
        graph.nodes,
        "controller",
        inputs,
        [signal("u", controller.scale.inputs), signal("next_state", states)],
        graph.constants,
        about,
    )
    opset_imports = [helper.make_opsetid("", OPSET)]
    model: onnx.ModelProto = helper.make_model(made, opset_imports=opset_imports)
    model.ir_version = IR_VERSION
    model.producer_name = "ssm-study"
    checker.check_model(model, full_check=True)
    return model


def _cell(controller: PortableController) -> _Graph:
    """ONNX graph of one sample of the controller. `V = K xh` is the scaled input, the others as in
    PortableController."""
    graph = _Graph()
    scale = controller.scale
    neurons = controller.neurons
    v = graph.times("state", controller.k)
    physical = graph.apply("Mul", v, scale.input_scale)
    graph.apply("Add", physical, scale.input_equilibrium, output="u")
    lifted = graph.map(controller.s_in, v)
    from_state = graph.times("state", controller.c)
    read = graph.apply("Add", from_state, graph.times(lifted, controller.d))
    if neurons and neurons.h.any():
        within = graph.neurons(neurons, "state", lifted)
        read = graph.apply("Add", read, graph.times(within, neurons.h))
    predicted = graph.map(controller.s_out, read)
    shifted = graph.apply("Sub", "y", scale.output_equilibrium)
    measured = graph.apply("Div", shifted, scale.output_scale)
    error = graph.apply("Sub", predicted, measured)
    factors = {
        "state": controller.a,
        lifted: controller.b,
        error: controller.l,
        measured: controller.e,
    }
    if scale.disturbances:
        moved = graph.apply("Sub", "d", scale.disturbance_equilibrium)
        factors[graph.apply("Div", moved, scale.disturbance_scale)] = controller.b_d
    if neurons:
        factors[graph.neurons(neurons, "state", lifted, error)] = neurons.into
    terms = [graph.times(signal, matrix) for signal, matrix in factors.items()]
    graph.apply("Sum", *terms, output="next_state")
    return graph
