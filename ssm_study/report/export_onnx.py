"""The controller as an ONNX cell of one sample: `(y, state) -> (u, next_state)`, in doubles, any batch size."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.report.portable import PortableController, PortableMap

OPSET, IR_VERSION = 17, 8  # old enough for runtimes in the field


class _Graph:
    """Nodes in order and constants by name, `x @ w` style."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, values: Float[np.ndarray, "..."]) -> str:
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(values, dtype=np.float64), name))
        return name

    def apply(self, operator: str, *inputs: str, output: str | None = None) -> str:
        from onnx import helper

        output = output or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, list(inputs), [output]))
        return output

    def times(self, x: str, matrix: Float[np.ndarray, "r c"]) -> str:
        """`x M^T`, rows of x being samples."""
        return self.apply("MatMul", x, self.constant(matrix.T))

    def total(self, *terms: str, output: str | None = None) -> str:
        result = terms[0]
        for i, term in enumerate(terms[1:], start=2):
            result = self.apply("Add", result, term, output=output if i == len(terms) else None)
        return result

    def leaky(self, z: str, low: Float[np.ndarray, "h"], high: Float[np.ndarray, "h"]) -> str:
        zero = self.constant(np.zeros(1))
        positive, negative = self.apply("Max", z, zero), self.apply("Min", z, zero)
        terms = ((positive, high), (negative, low))
        return self.total(*(self.apply("Mul", part, self.constant(slope)) for part, slope in terms))

    def map(self, s: PortableMap, v: str) -> str:
        straight = self.times(v, s.linear)
        if s.network is None:
            return straight
        net, d = s.network, v
        hidden = zip(net.weights[:-1], net.biases, net.negative_slopes, net.positive_slopes, strict=True)
        for w, b, low, high in hidden:
            z = self.total(self.times(d, w), self.constant(b))
            d = self.apply("Sub", self.leaky(z, low, high), self.constant(np.where(b >= 0, high, low) * b))
        return self.total(straight, self.times(d, net.weights[-1]))


def onnx_model(controller: PortableController, about: str) -> Any:
    """The checked `onnx.ModelProto`. Needs the extra `export`."""
    import onnx
    from onnx import TensorProto, checker, helper

    graph = _cell(controller)
    n, m, p = controller.a.shape[0], len(controller.input_scale), len(controller.output_scale)

    def signal(name: str, width: int) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["batch", width])

    ends = [signal("y", p), signal("state", n)], [signal("u", m), signal("next_state", n)]
    made = helper.make_graph(graph.nodes, "controller", *ends, initializer=graph.constants, doc_string=about)
    model: onnx.ModelProto = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version, model.producer_name = IR_VERSION, "ssm-study"
    checker.check_model(model, full_check=True)
    return model


def _cell(c: PortableController) -> _Graph:
    """`v = K xh` is the scaled input; the rest as in `PortableController`."""
    g = _Graph()
    v = g.times("state", c.k)
    g.total(g.apply("Mul", v, g.constant(c.input_scale)), g.constant(c.input_equilibrium), output="u")
    lifted = g.map(c.s_in, v)
    predicted = g.map(c.s_out, g.total(g.times("state", c.c), g.times(lifted, c.d)))
    measured = g.apply("Div", g.apply("Sub", "y", g.constant(c.output_equilibrium)), g.constant(c.output_scale))
    innovation = g.apply("Sub", predicted, measured)
    g.total(
        g.times("state", c.a),
        g.times(lifted, c.b),
        g.times(innovation, c.l),
        g.times(measured, c.e),
        output="next_state",
    )
    return g
