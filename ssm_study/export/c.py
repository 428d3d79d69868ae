"""The controller as dependency-free C99: no allocation, no library, constants that read back
exactly."""

import re
from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.bounds.network import Inverse, PortableMap
from ssm_study.export.device import REALS, Device
from ssm_study.export.rest_points import Joined
from ssm_study.models.structured import NEURONS
from ssm_study.refusal import require

_HEADER, _SET_POINTS, _REPLAY = (
    Template(Path(__file__).with_name(name).read_text(encoding="utf-8"))
    for name in ("controller.h.txt", "set_points.h.txt", "replay.c.txt")
)
# The header's comment on use within limits, with set points and without them; `#` is the prefix.
WITHIN = {
    True: """ * Within limits, to set points r:
 *     #_init(&state, y);             once: the estimate starts at rest at the first measurement
 *     #_track(&state, y, r, u);      every sample: u is clamped to the limits, the estimate knows it""",
    False: """ * Within limits, to rest. No set points: the model integrates, a map couples channels, no constant input
 * reaches every output, or neurons stand between several inputs or outputs.
 *     #_reset(&state);               once: the estimate starts at rest at the equilibrium
 *     #_input(&state, u), #_clamp(u), apply, #_advance(&state, y, u);      every sample""",
}
KEYWORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while"
)
REPLAYED = 200  # samples of the replay: some hundred times the states of a usual controller
# Of the largest input: what compilers that reorder or fuse may change.
AGREEMENT = {"double": 1e-9, "float": 1e-3}
REPLAY_SEED = 0


def c_files(
    device: Device,
    name: str = "controller",
    *,
    about: str,
    signals: Sequence[str] = (),
    digest: str = "",
    rates: Sequence[str] = (),
) -> dict[str, str]:
    """File name and text: header, source, and a replay with its own `main`.

    `name` prefixes every symbol and file. Besides numbers the header says its origin, a line per
    signal, the digest of
    the certificate and the rates of the rounded numbers. Raises `BadRequest` for a name that C does
    not allow.
    """
    allowed = (
        re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) is not None and name not in KEYWORDS.split()
    )
    require(allowed, "prefix", name, "is no name in C", "use letters, digits and _")
    guard = name.upper()
    source = (
        f"#ifndef {guard}_EXTERN\n#define {guard}_EXTERN\n#endif\n#define {guard}_IMPLEMENTATION\n"
    )
    told = {"about": harmless(about), "digest": harmless(digest) or "none"}
    for label, lines in (("signals", signals), ("rates", rates)):
        told[label] = "\n".join(f" * {harmless(line)}" for line in lines) or " *"
    files = {
        f"{name}.h": _header(device, told, name),
        f"{name}.c": f'{source}#include "{name}.h"\n',
    }
    return files | {f"{name}_replay.c": _replay(device, name)}


def _header(device: Device, told: dict[str, str], name: str) -> str:
    real, c, points = device.real, device.controller, device.set_points
    tables = "".join(
        _array(f"{name}_{label}", values, real) for label, values in device.tables().items()
    )
    maps = _map(f"{name}_s_in", c.s_in, name, real) + _map(f"{name}_s_out", c.s_out, name, real)
    sizes, declared, defined = _sizes(device, name), "", ""
    if points is not None:
        maps += _inverse(f"{name}_s_in_inverse", points.inward, name, real)
        maps += _inverse(f"{name}_s_out_inverse", points.outward, name, real)
        maps += "".join(
            _reached(f"{name}_{label}", part, name, real) for label, part in points.maps.items()
        )
        defined = _SET_POINTS.substitute(sizes)
        declared = "".join(
            f"{line.removesuffix(' {')};\n" for line in defined.splitlines() if "_API void" in line
        )
    # A ramp's model rests while a limit acts; integrators do so by themselves, oscillators go on.
    rests = f"    else for (int i = {c.resting.start}; i < {c.resting.stop}; ++i) next[i] = state->x[i];\n"
    constants = sum(
        int(count) for count in re.findall(r"static const \w+ \w+\[(\d+)\]", tables + maps)
    )
    return _HEADER.substitute(
        sizes | told | _inner(device, name), tables=tables, maps=maps, declared=declared, defined=defined,
        within=WITHIN[points is not None].replace("#", name), resting=rests if c.resting.stop > c.resting.start else "",
        step_s=repr(c.step_s), has_set_points=int(points is not None),
        bytes=constants * np.dtype(REALS[real]).itemsize, multiplications=device.multiplications,
        tiny=_number(1e-12, real), relative=_number(1e-9 if real == "double" else 1e-6, real),
    )  # fmt: skip


def harmless(text: str) -> str:
    """Text that can neither end a C comment nor go on beyond its line, whatever somebody named a
    study."""
    # Between letters, as in rad/s, a slash is no part of a comment's end.
    alone = r"(?<![A-Za-z0-9])/|/(?![A-Za-z0-9])"
    return re.sub(rf"[^A-Za-z0-9 .,:;()\[\]%+=_'^/-]|\.\.\.|{alone}", "_", text)


def _sizes(device: Device, name: str) -> dict[str, object]:
    (n, k), (q, _), scale = (
        device.controller.b.shape,
        device.controller.c.shape,
        device.controller.scale,
    )
    sizes = {"n": n, "k": k, "q": q, "m": scale.inputs, "p": scale.outputs}
    return {"name": name, "guard": name.upper(), "real": device.real, **sizes}


def _inner(device: Device, name: str) -> dict[str, str]:
    """What neurons add to the header: math.h, their function, and its calls where the error is and
    is not known."""
    if (neurons := device.controller.neurons) is None:
        return dict.fromkeys(("include", "neurons", "read", "driven"), "")
    (n, r), real, (q, _) = neurons.into.shape, device.real, neurons.h.shape
    arguments = {
        "f": ("x", n),
        "g": ("lifted", neurons.g.shape[1]),
        "l_z": ("error", neurons.l_z.shape[1]),
    }
    given = ", ".join(f"const {real} *{vector}" for vector, _ in arguments.values())
    lines = [f"static inline void {name}_neurons({given}, {real} *w) {{", f"    {real} z;"]
    lines += [f"    for (int i = 0; i < {r}; ++i) w[i] = {name}_bias[i];"]
    lines += [
        f"    {name}_matvec({r}, {size}, {name}_{m}, {vector}, w);"
        for m, (vector, size) in arguments.items()
    ]
    for i, kind in enumerate(neurons.kinds):
        c = NEURONS[kind].c
        if real == "float":  # tanhf and 1.0f
            c = re.sub(r"(\d\.\d)", r"\1f", re.sub(r"([a-z]\w+)\(", r"\1f(", c))
        lines += [f"    z = w[{i}];", f"    w[{i}] = {c} - {name}_phi_bias[{i}];"]
    read = [f"    const {real} none[{neurons.l_z.shape[1]}] = {{0}};", f"    {real} seen[{r}];"]
    read += [f"    {name}_neurons(state->x, lifted, none, seen);"]
    read += [f"    {name}_matvec({q}, {r}, {name}_h, seen, ybar);"]
    driven = [f"    {real} w[{r}];", f"    {name}_neurons(state->x, lifted, error, w);"]
    driven += [f"    {name}_matvec({n}, {r}, {name}_into, w, next);"]
    parts = {"neurons": [*lines, "}"], "read": read if neurons.h.any() else [], "driven": driven}
    text = {label: "".join(f"{line}\n" for line in part) for label, part in parts.items()}
    return text | {
        "neurons": f"\n{text['neurons']}",
        "include": "#include <math.h> /* link with -lm */\n\n",
    }


def _replay(device: Device, name: str) -> str:
    """Levels within two scales of rest, also beyond the limits, noise on top; set points change in
    between."""
    scale, rng = device.controller.scale, np.random.default_rng(REPLAY_SEED)
    levels = rng.uniform(-2, 2, (2, REPLAYED // 20, scale.outputs)).repeat(20, axis=1)
    noisy = levels[0] + 0.05 * rng.standard_normal(levels[0].shape)  # scaled
    y, r = (scale.physical_output(values) for values in (noisy, np.roll(levels[1], 7, axis=0)))
    u = device.replay(y, r)
    points = device.set_points is not None
    begin = f"{name}_init(&state, measured[0]);" if points else f"{name}_reset(&state);"
    act = f"{name}_track(&state, measured[k], wanted[k], u);"
    if not points:
        act = f"{name}_input(&state, u);\n        {name}_clamp(u);\n        {name}_advance(&state, measured[k], u);"
    tables, wanted = {"begin": begin, "act": act}, {"wanted": r} if points else {}
    for label, values in ({"measured": y, "expected": u} | wanted).items():
        rows = (", ".join(_number(value, device.real) for value in row) for row in values)
        listed = ", ".join(f"{{{row}}}" for row in rows)
        width = values.shape[1]
        tables[label] = f"static const {device.real} {label}[{REPLAYED}][{width}] = {{{listed}}};"
    tolerance = repr(AGREEMENT[device.real] * max(1.0, float(np.abs(u).max())))
    return _REPLAY.substitute(
        {"wanted": ""} | _sizes(device, name) | tables, samples=REPLAYED, tolerance=tolerance
    )


# The shortest text that reads back to the same float.
def _number(value: float | np.floating[Any], real: str) -> str:
    return np.format_float_scientific(REALS[real](value), trim="0") + (
        "f" if real == "float" else ""
    )


def _array(name: str, values: Float[np.ndarray, "..."], real: str) -> str:
    numbers = ", ".join(_number(value, real) for value in values.ravel())
    return f"static const {real} {name}[{values.size}] = {{{numbers}}};\n"


def _function(
    name: str, argument: str, tables: dict[str, Float[np.ndarray, "..."]], body: str, real: str
) -> str:
    """`void name(argument, out)` behind its constants, called `name_<label>` there and `#label` in
    `body`."""
    constants = "".join(_array(f"{name}_{label}", values, real) for label, values in tables.items())
    code = body.replace("#", f"{name}_")
    return f"\n{constants}static inline void {name}(const {real} *{argument}, {real} *out) {{\n{code}}}\n"


def _product(
    prefix: str, label: str, matrix: Float[np.ndarray, "r c"], source: str, target: str
) -> str:
    rows, columns = matrix.shape
    return f"    {prefix}_matvec({rows}, {columns}, #{label}, {source}, {target});\n"


def _map(name: str, portable: PortableMap, prefix: str, real: str) -> str:
    """`out += linear v + N(v)`, layer by layer: `d = phi(W d + b) - phi(b)`."""
    tables, source = {"linear": portable.linear}, "v"
    body = _product(prefix, "linear", portable.linear, "v", "out")
    for i, (w, b, low, high) in enumerate(portable.network.hidden() if portable.network else ()):
        at_zero = np.where(b >= 0, high, low) * b
        tables |= {f"w{i}": w, f"b{i}": b, f"low{i}": low, f"high{i}": high, f"at_zero{i}": at_zero}
        body += f"    {real} d{i}[{len(b)}];\n    for (int i = 0; i < {len(b)}; ++i) d{i}[i] = #b{i}[i];\n"
        body += (
            _product(prefix, f"w{i}", w, source, f"d{i}")
            + f"    for (int i = 0; i < {len(b)}; ++i)\n"
        )
        body += f"        d{i}[i] = {prefix}_leaky(d{i}[i], #low{i}[i], #high{i}[i]) - #at_zero{i}[i];\n"
        source = f"d{i}"  # what the next layer takes
    if portable.network:
        tables["w_out"] = portable.network.weights[-1]
        body += _product(prefix, "w_out", tables["w_out"], source, "out")
    return _function(name, "v", tables, body, real)


def _reached(name: str, part: Joined | Float[np.ndarray, "r c"], prefix: str, real: str) -> str:
    """`out += part w`, or `out` between stored points."""
    if not isinstance(part, Joined):
        return _function(
            name, "w", {"linear": part}, _product(prefix, "linear", part, "w", "out"), real
        )
    h, r = len(part.points), part.slopes.shape[1]
    body = f"    int j;\n    for (j = 0; j < {h} && #at[j] <= w[0]; ++j) {{}}\n"
    body += f"    for (int i = 0; i < {r}; ++i) out[i] = #slope[j * {r} + i] * w[0] + #offset[j * {r} + i];\n"
    return _function(
        name, "w", {"at": part.points, "slope": part.slopes, "offset": part.offsets}, body, real
    )


def _inverse(name: str, inverse: Inverse, prefix: str, real: str) -> str:
    """`out = S^{-1}(w)`: a product, or the piece of each channel."""
    if inverse.matrix is not None:
        body = _product(prefix, "linear", inverse.matrix, "w", "out")
        return _function(name, "w", {"linear": inverse.matrix}, body, real)
    tables: dict[str, Float[np.ndarray, ...]] = {}
    body = "    int j;\n"
    for c, (points, slopes, offsets) in enumerate(inverse.channels):
        tables |= {f"at{c}": points} if len(points) else {}  # C has no array of size zero
        tables |= {f"slope{c}": slopes, f"offset{c}": offsets}
        search = (
            f"for (j = 0; j < {len(points)} && #at{c}[j] <= w[{c}]; ++j) {{}}"
            if len(points)
            else "j = 0;"
        )
        body += f"    {search}\n    out[{c}] = #slope{c}[j] * w[{c}] + #offset{c}[j];\n"
    return _function(name, "w", tables, body, real)
