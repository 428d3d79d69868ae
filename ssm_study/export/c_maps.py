"""C functions of static maps, and of maps between set points and equilibria."""

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import InverseMap, PortableMap
from ssm_study.export.c_tables import read_template, render_array
from ssm_study.export.equilibrium_curve import PiecewiseLinear
from ssm_study.export.set_point_maps import SetPoints

_SET_POINTS = read_template("set_points.h.txt")
# Lines of it: what the model rests at for a set point, where it integrates and where it does not.
_REST = {
    True: read_template("rest_of_integrators.h.txt"),
    False: read_template("rest_within_limits.h.txt"),
}


def render_set_point_maps(points: SetPoints, prefix: str, c_type: str) -> str:
    """C functions that convert set points to equilibria of the controller's model."""
    inverses = {"s_in_inverse": points.inward, "s_out_inverse": points.outward}
    maps = ""
    for label, inverse in inverses.items():
        if inverse is not None:
            maps += _render_inverse_map(f"{prefix}_{label}", inverse, prefix, c_type)
    for label, part in points.equilibrium_maps.items():
        maps += _render_equilibrium_map(f"{prefix}_{label}", part, prefix, c_type)
    return maps


def render_set_point_functions(points: SetPoints, sizes: dict[str, object]) -> str:
    """C functions that start the controller at an output and steer to a set point."""
    equilibrium = _REST[points.inward is None]
    texts = sizes | {"coordinates": points.coordinates}
    return _SET_POINTS.substitute(texts, equilibrium=equilibrium.substitute(texts))


def render_static_map(function_name: str, static_map: PortableMap, prefix: str, c_type: str) -> str:
    """C function that evaluates a piecewise-linear static map, layer by layer. `out += linear v +
    N(v)`, `d = phi(W d + b) - phi(b)`."""
    tables = {"linear": static_map.linear}
    body = _render_product(prefix, "linear", static_map.linear, "v", "out")
    source = "v"
    layers = static_map.network.hidden_layers() if static_map.network else ()
    for i, (w, b, low, high) in enumerate(layers):
        width = len(b)
        tables[f"w{i}"] = w
        tables[f"b{i}"] = b
        tables[f"low{i}"] = low
        tables[f"high{i}"] = high
        tables[f"at_zero{i}"] = np.where(b >= 0, high, low) * b
        over_layer = f"    for (int i = 0; i < {width}; ++i)"
        bent = f"{prefix}_leaky(d{i}[i], #low{i}[i], #high{i}[i])"
        body += f"    {c_type} d{i}[{width}];\n"
        body += f"{over_layer} d{i}[i] = #b{i}[i];\n"
        body += _render_product(prefix, f"w{i}", w, source, f"d{i}")
        body += f"{over_layer}\n"
        body += f"        d{i}[i] = {bent} - #at_zero{i}[i];\n"
        source = f"d{i}"  # what the next layer takes
    if static_map.network:
        weights = static_map.network.weights
        tables["w_out"] = weights[-1]
        body += _render_product(prefix, "w_out", tables["w_out"], source, "out")
    return _render_function(function_name, "v", tables, body, c_type)


def _render_equilibrium_map(
    function_name: str,
    equilibrium_map: PiecewiseLinear | Float[np.ndarray, "r c"],
    prefix: str,
    c_type: str,
) -> str:
    """C function that adds the value of a linear or piecewise-linear map to the vector `out`. `out
    += part w`."""
    if not isinstance(equilibrium_map, PiecewiseLinear):
        product = _render_product(prefix, "linear", equilibrium_map, "w", "out")
        return _render_function(function_name, "w", {"linear": equilibrium_map}, product, c_type)
    count = len(equilibrium_map.points)
    width = equilibrium_map.slopes.shape[1]
    at = f"j * {width} + i"
    body = "    int j;\n"
    body += f"    for (j = 0; j < {count} && #at[j] <= w[0]; ++j) {{}}\n"
    body += f"    for (int i = 0; i < {width}; ++i)"
    body += f" out[i] = #slope[{at}] * w[0] + #offset[{at}];\n"
    tables = {
        "at": equilibrium_map.points,
        "slope": equilibrium_map.slopes,
        "offset": equilibrium_map.offsets,
    }
    return _render_function(function_name, "w", tables, body, c_type)


def _render_inverse_map(function_name: str, inverse: InverseMap, prefix: str, c_type: str) -> str:
    """C function that evaluates the inverse of a static map. `out = S^{-1}(w)`."""
    if inverse.matrix is not None:
        body = _render_product(prefix, "linear", inverse.matrix, "w", "out")
        return _render_function(function_name, "w", {"linear": inverse.matrix}, body, c_type)
    tables: dict[str, Float[np.ndarray, ...]] = {}
    body = "    int j;\n"
    for c, (points, slopes, offsets) in enumerate(inverse.channels):
        search = "j = 0;"
        if len(points):  # C has no array of size zero
            tables[f"at{c}"] = points
            search = f"for (j = 0; j < {len(points)} && #at{c}[j] <= w[{c}]; ++j) {{}}"
        tables[f"slope{c}"] = slopes
        tables[f"offset{c}"] = offsets
        body += f"    {search}\n    out[{c}] = #slope{c}[j] * w[{c}] + #offset{c}[j];\n"
    return _render_function(function_name, "w", tables, body, c_type)


def _render_function(
    function_name: str,
    argument: str,
    tables: dict[str, Float[np.ndarray, "..."]],
    body: str,
    c_type: str,
) -> str:
    """C function with one argument and one result, preceded by its constant arrays. `void
    name(argument, out)`.

    A constant is called `name_<label>` in C and `#label` in `body`.
    """
    constants = "".join(
        render_array(f"{function_name}_{label}", values, c_type) for label, values in tables.items()
    )
    code = body.replace("#", f"{function_name}_")
    head = f"static inline void {function_name}(const {c_type} *{argument}, {c_type} *out) {{"
    return f"\n{constants}{head}\n{code}}}\n"


def _render_product(
    prefix: str, matrix_name: str, matrix: Float[np.ndarray, "r c"], source: str, target: str
) -> str:
    """Line of C code that adds the product of a matrix and a vector to another vector."""
    rows, columns = matrix.shape
    return f"    {prefix}_matvec({rows}, {columns}, #{matrix_name}, {source}, {target});\n"
