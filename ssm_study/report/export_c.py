"""The controller as dependency-free C99: one header, no allocation, no library, doubles that read back exactly."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ssm_study.report.portable import ARRAYS, PortableController, PortableMap

_HEAD = """/* {about}
 *
 * One sample, every {step_s!r} s:
 *     {name}_step(&state, y, u);      y: {p} measured output(s), u: {m} input(s) to hold until the next sample
 * or, where an actuator limits the input, {name}_input(&state, u), apply, {name}_advance(&state, y, u_applied).
 * Start with {name}_reset(&state). Physical units; generated, do not edit.
 */
#ifndef {guard}
#define {guard}

typedef struct {{ double x[{n}]; }} {name}_state;
"""

_TAIL = """
static inline void {name}_matvec(int rows, int columns, const double *a, const double *x, double *y) {{
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns; ++j) y[i] += a[i * columns + j] * x[j];
}}

static inline double {name}_leaky(double z, double low, double high) {{ return z >= 0.0 ? high * z : low * z; }}
{maps}
static inline void {name}_reset({name}_state *state) {{
    for (int i = 0; i < {n}; ++i) state->x[i] = 0.0;
}}

static inline void {name}_input(const {name}_state *state, double u[{m}]) {{
    double v[{m}] = {{0.0}};
    {name}_matvec({m}, {n}, {name}_k, state->x, v);
    for (int i = 0; i < {m}; ++i) u[i] = {name}_input_equilibrium[i] + {name}_input_scale[i] * v[i];
}}

static inline void {name}_advance({name}_state *state, const double y[{p}], const double u[{m}]) {{
    double v[{m}], lifted[{k}] = {{0.0}}, ybar[{q}] = {{0.0}}, error[{p}] = {{0.0}}, measured[{p}], next[{n}] = {{0.0}};
    double asked[{m}];
    int as_asked = 1; /* integrators rest while a limit keeps the input from what was asked */
    {name}_input(state, asked);
    for (int i = 0; i < {m}; ++i) {{
        double missed = u[i] - asked[i], allowed = 1e-12 + 1e-9 * (asked[i] < 0.0 ? -asked[i] : asked[i]);
        if (missed > allowed || missed < -allowed) as_asked = 0;
    }}
    for (int i = 0; i < {m}; ++i) v[i] = (u[i] - {name}_input_equilibrium[i]) / {name}_input_scale[i];
    {name}_s_in(v, lifted);
    {name}_matvec({q}, {n}, {name}_c, state->x, ybar);
    {name}_matvec({q}, {k}, {name}_d, lifted, ybar);
    {name}_s_out(ybar, error);
    for (int i = 0; i < {p}; ++i) {{
        measured[i] = (y[i] - {name}_output_equilibrium[i]) / {name}_output_scale[i];
        error[i] -= measured[i];
    }}
    {name}_matvec({n}, {n}, {name}_a, state->x, next);
    {name}_matvec({n}, {k}, {name}_b, lifted, next);
    {name}_matvec({n}, {p}, {name}_l, error, next);
    if (as_asked) {name}_matvec({n}, {p}, {name}_e, measured, next);
    for (int i = 0; i < {n}; ++i) state->x[i] = next[i];
}}

static inline void {name}_step({name}_state *state, const double y[{p}], double u[{m}]) {{
    {name}_input(state, u);
    {name}_advance(state, y, u);
}}

#endif
"""


def c_header(controller: PortableController, about: str, name: str = "controller") -> str:
    """The text of `controller.h`; `name` prefixes every symbol, so that several controllers fit in one program."""
    (n, k), (q, _) = controller.b.shape, controller.c.shape
    sizes = {"n": n, "k": k, "q": q, "m": len(controller.input_scale), "p": len(controller.output_scale)}
    words = {"name": name, "guard": f"{name.upper()}_H", "about": about.replace("*/", ""), "step_s": controller.step_s}
    constants = "".join(_array(f"{name}_{label}", getattr(controller, label)) for label in ARRAYS)
    maps = _map(f"{name}_s_in", controller.s_in, name) + _map(f"{name}_s_out", controller.s_out, name)
    return _HEAD.format(**words, **sizes) + constants + _TAIL.format(**words, **sizes, maps=maps)


def _array(name: str, values: Float[np.ndarray, "..."]) -> str:
    numbers = ", ".join(repr(float(value)) for value in values.ravel())
    return f"static const double {name}[{values.size}] = {{{numbers}}};\n"


def _map(name: str, portable: PortableMap, prefix: str) -> str:
    """`out += linear v + N(v)`, layer by layer: `d = phi(W d + b) - phi(b)`."""
    outputs, inputs = portable.linear.shape
    layers = list(_layers(name, portable, prefix))
    constants = _array(f"{name}_linear", portable.linear) + "".join(constant for constant, _ in layers)
    straight = f"    {prefix}_matvec({outputs}, {inputs}, {name}_linear, v, out);\n"
    body = straight + "".join(code for _, code in layers)
    return f"\n{constants}static inline void {name}(const double *v, double *out) {{\n{body}}}\n"


def _layers(name: str, portable: PortableMap, prefix: str) -> Iterator[tuple[str, str]]:
    """Constants and statements of each layer."""
    if portable.network is None:
        return
    net, source = portable.network, "v"
    hidden = zip(net.weights[:-1], net.biases, net.negative_slopes, net.positive_slopes, strict=True)
    for i, (w, b, low, high) in enumerate(hidden):
        rows, columns = w.shape
        parts = {"w": w, "b": b, "low": low, "high": high, "at_zero": np.where(b >= 0, high, low) * b}
        code = (
            f"    double d{i}[{rows}];\n"
            f"    for (int i = 0; i < {rows}; ++i) d{i}[i] = {name}_b{i}[i];\n"
            f"    {prefix}_matvec({rows}, {columns}, {name}_w{i}, {source}, d{i});\n"
            f"    for (int i = 0; i < {rows}; ++i)\n"
            f"        d{i}[i] = {prefix}_leaky(d{i}[i], {name}_low{i}[i], {name}_high{i}[i]) - {name}_at_zero{i}[i];\n"
        )
        yield "".join(_array(f"{name}_{label}{i}", values) for label, values in parts.items()), code
        source = f"d{i}"
    rows, columns = net.weights[-1].shape
    code = f"    {prefix}_matvec({rows}, {columns}, {name}_w_out, {source}, out);\n"
    yield _array(f"{name}_w_out", net.weights[-1]), code
