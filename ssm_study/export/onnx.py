"""The controller as an ONNX cell of one sample: `(y, state) -> (u, next_state)`, in doubles, any
batch size."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import PortableMap
from ssm_study.export.portable import PortableController, PortableNeurons

OPSET, IR_VERSION = 17, 8  # old enough for runtimes in the field


class _Graph:
    """Nodes in order; an array among the inputs of one becomes a constant. Rows of a signal are
    samples."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def apply(
        self, operator: str, *inputs: str | Float[np.ndarray, "..."], output: str = ""
    ) -> str:
        from onnx import helper, numpy_helper

        names = []
        for value in inputs:
            names.append(value if isinstance(value, str) else f"c{len(self.constants)}")
            if not isinstance(value, str):
                values = np.ascontiguousarray(value, dtype=np.float64)
                self.constants.append(numpy_helper.from_array(values, names[-1]))
        output = output or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [output]))
        return output

    def times(self, x: str, matrix: Float[np.ndarray, "r c"]) -> str:
        return self.apply("MatMul", x, matrix.T)

    def map(self, s: PortableMap, v: str) -> str:
        terms, d = [self.times(v, s.linear)], v
        for w, b, low, high in s.network.hidden() if s.network else ():
            z = self.apply("Add", self.times(d, w), b)
            above, below = (self.apply(half, z, np.zeros(1)) for half in ("Max", "Min"))
            bent = self.apply("Mul", above, high), self.apply("Mul", below, low)
            d = self.apply("Sum", *bent, -np.where(b >= 0, high, low) * b)  # phi(z) - phi(b)
        terms += [self.times(d, s.network.weights[-1])] if s.network else []
        return self.apply("Sum", *terms)

    def neurons(self, inner: PortableNeurons, x: str, lifted: str, error: str = "") -> str:
        """`phi(F x + G v + L_z e + b) - phi(b)`, the kinds side by side, each masked to its own
        neurons."""
        seen = [self.times(x, inner.f), self.times(lifted, inner.g)]
        seen += [self.times(error, inner.l_z)] if error else []
        z, parts = self.apply("Sum", *seen, inner.bias), []
        for kind in sorted(set(inner.kinds)):
            own = np.array([each == kind for each in inner.kinds], dtype=float)
            parts.append(self.apply("Mul", self.phi(kind, z), own))
        return self.apply("Sum", *parts, -inner.phi_bias)

    def phi(self, kind: str, z: str) -> str:
        """One kind, in operators that runtimes have for doubles."""
        if kind == "tanh":
            return self.apply("Tanh", z)
        above = self.apply("Max", z, np.zeros(1))
        if kind == "relu":
            return above
        if kind == "softplus":  # max(z, 0) + ln(1 + exp(-|z|))
            fading = self.apply("Exp", self.apply("Neg", self.apply("Abs", z)))
            return self.apply(
                "Add", above, self.apply("Log", self.apply("Add", fading, np.ones(1)))
            )
        clipped = self.apply("Min", self.apply("Max", z, -np.ones(1)), np.ones(1))
        if kind == "saturation":
            return clipped
        cubed = self.apply(
            "Mul", self.apply("Mul", clipped, clipped), self.apply("Div", clipped, np.full(1, 3.0))
        )
        # Clipped cubic: slope one beyond.
        return self.apply("Add", cubed, self.apply("Sub", z, clipped))


def onnx_model(controller: PortableController, about: str) -> Any:
    """The checked `onnx.ModelProto`. Needs the extra `export`."""
    import onnx
    from onnx import TensorProto, checker, helper

    graph, scale = _cell(controller), controller.scale
    widths = {
        "y": scale.outputs,
        "state": len(controller.a),
        "u": scale.inputs,
        "next_state": len(controller.a),
    }
    signals = [
        helper.make_tensor_value_info(n, TensorProto.DOUBLE, ["batch", width])
        for n, width in widths.items()
    ]
    made = helper.make_graph(
        graph.nodes, "controller", signals[:2], signals[2:], graph.constants, about
    )
    model: onnx.ModelProto = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version, model.producer_name = IR_VERSION, "ssm-study"
    checker.check_model(model, full_check=True)
    return model


# V = K xh is the scaled input; the rest as in PortableController.
def _cell(c: PortableController) -> _Graph:
    g, scale = _Graph(), c.scale
    v = g.times("state", c.k)
    g.apply("Add", g.apply("Mul", v, scale.input_scale), scale.input_equilibrium, output="u")
    lifted = g.map(c.s_in, v)
    read, inner = g.apply("Add", g.times("state", c.c), g.times(lifted, c.d)), c.neurons
    if inner and inner.h.any():
        read = g.apply("Add", read, g.times(g.neurons(inner, "state", lifted), inner.h))
    predicted = g.map(c.s_out, read)
    measured = g.apply("Div", g.apply("Sub", "y", scale.output_equilibrium), scale.output_scale)
    error = g.apply("Sub", predicted, measured)
    factors = {"state": c.a, lifted: c.b, error: c.l, measured: c.e}
    factors |= {g.neurons(inner, "state", lifted, error): inner.into} if inner else {}
    g.apply(
        "Sum", *(g.times(signal, matrix) for signal, matrix in factors.items()), output="next_state"
    )
    return g
