"""Export of the controller as C99 without dependencies: no allocation, no library, exact constants.

Every constant is written so that it reads back to the same float.
"""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssm_study.export import c_monitor
from ssm_study.export.c_maps import (
    render_set_point_functions,
    render_set_point_maps,
    render_static_map,
)
from ssm_study.export.c_monitor import MonitorConstants
from ssm_study.export.c_neurons import join_lines, render_neurons
from ssm_study.export.c_tables import read_template, render_array, render_number
from ssm_study.export.device import REALS, DeviceController
from ssm_study.refusal import require

_HEADER = read_template("controller.h.txt")
_REPLAY = read_template("replay.c.txt")
# The header's comment on use within limits, with set points and without them; `#` is the
# prefix, `@` the reason why there are none.
WITHIN = {
    True: """ * Within limits, to set points r:
 *     #_init(&state, y);             once: the estimate starts at rest at the first measurement
 *     #_track(&state, y, r, u);      every sample: u is clamped to the limits, the estimate \
knows it""",
    False: """ * Within limits, to rest. No set points: @.
 *     #_reset(&state);               once: the estimate starts at rest at the equilibrium
 *     #_input(&state, u), #_clamp(u), apply, #_advance(&state, y, u);      every sample""",
}
KEYWORDS = (
    "auto break case char const continue default do double else enum extern float for goto if "
    "inline int long register restrict return short signed sizeof static struct switch typedef "
    "union unsigned void volatile while"
)
REPLAYED = 200  # samples of the replay: some hundred times the states of a usual controller
# Of the largest input: what compilers that reorder or fuse may change.
AGREEMENT = {"double": 1e-9, "float": 1e-3}
REPLAY_SEED = 0
# Between letters, as in rad/s, a slash is no part of a comment's end.
LONELY_SLASH = r"(?<![A-Za-z0-9])/|/(?![A-Za-z0-9])"


def render_c_files(
    device: DeviceController,
    prefix: str = "controller",
    *,
    origin_text: str,
    signal_lines: Sequence[str] = (),
    certificate_digest: str = "",
    rate_lines: Sequence[str] = (),
    monitor: MonitorConstants | None = None,
) -> dict[str, str]:
    """Names and texts of the C files of a controller: header, source and replay program.

    The name of every symbol and file begins with `prefix`. Besides numbers the header says its
    origin, a line per signal, the digest of the certificate and the rates of the rounded numbers.
    Raises `BadRequest` for a name that C does not allow. Compiled with `-DMONITOR` the code has the
    `monitor`, or does not compile where there is none.
    """
    require_c_identifier(prefix)
    comments = {
        "about": escape_comment(origin_text),
        "digest": escape_comment(certificate_digest) or "none",
        "signals": _format_comment(signal_lines),
        "rates": _format_comment(rate_lines),
    }
    header = _render_header(device, comments, prefix, monitor)
    return {
        f"{prefix}.h": header,
        f"{prefix}.c": _render_source(prefix),
        f"{prefix}_replay.c": _render_replay_program(device, prefix),
    }


def require_c_identifier(prefix: str) -> None:
    """Raise `BadRequest` for a prefix that is no valid identifier in C."""
    is_identifier = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix) is not None
    allowed = is_identifier and prefix not in KEYWORDS.split()
    require(allowed, "prefix", prefix, "is no name in C", "use letters, digits and _")


def _format_comment(lines: Sequence[str]) -> str:
    """Format lines of text as lines of a C comment."""
    return "\n".join(f" * {escape_comment(line)}" for line in lines) or " *"


def _render_source(prefix: str) -> str:
    """Text of the C source file of a controller."""
    guard = prefix.upper()
    return (
        f"#ifndef {guard}_EXTERN\n"
        f"#define {guard}_EXTERN\n"
        "#endif\n"
        f"#define {guard}_IMPLEMENTATION\n"
        f'#include "{prefix}.h"\n'
    )


def _render_header(
    device: DeviceController,
    comments: dict[str, str],
    prefix: str,
    monitor: MonitorConstants | None,
) -> str:
    """Text of the C header of a controller, with all constants and functions."""
    real = device.real
    controller = device.controller
    tables = ""
    for label, values in device.constant_tables().items():
        tables += render_array(f"{prefix}_{label}", values, real)
    maps = render_static_map(f"{prefix}_s_in", controller.s_in, prefix, real)
    maps += render_static_map(f"{prefix}_s_out", controller.s_out, prefix, real)
    sizes = _template_values(device, prefix)
    declared = ""
    defined = ""
    points = device.set_point_maps
    has_set_points = points is not None
    if points is not None:
        maps += render_set_point_maps(points, prefix, real)
        defined = render_set_point_functions(points, sizes)
        declared = _function_prototypes(defined)
    texts = sizes | comments | render_neurons(device, prefix)
    texts["pushed"] = _render_disturbance_update(device, prefix)
    texts |= c_monitor.render_monitor(device, monitor, sizes)
    step_s = repr(float(f"{controller.step_s:.12g}"))  # a mean of times ends in rounding
    texts |= {
        "tables": tables,
        "maps": maps,
        "declared": declared,
        "defined": defined,
        "within": _render_limits_comment(device, has_set_points).replace("#", prefix),
        "resting": _render_ramp_stop(device),
        "step_s": step_s,
        "has_set_points": int(has_set_points),
        "bytes": _count_constants(tables + maps) * np.dtype(REALS[real]).itemsize,
        "multiplications": device.multiplication_count,
        "tiny": render_number(1e-12, real),
        "relative": render_number(1e-9 if real == "double" else 1e-6, real),
    }
    return _HEADER.substitute(texts)


def _function_prototypes(c_code: str) -> str:
    """C prototypes of the public functions in a text of C code."""
    lines = c_code.splitlines()
    opened = [line for line in lines if "_API void" in line]
    return "".join(f"{line.removesuffix(' {')};\n" for line in opened)


def _render_ramp_stop(device: DeviceController) -> str:
    """Line of C code that keeps the ramp states of the internal model constant while an input limit
    is active; empty without such states. Integrators do so by themselves, and oscillators go on."""
    rows = device.controller.frozen_state_range
    if rows.stop <= rows.start:
        return ""
    return f"    else for (int i = {rows.start}; i < {rows.stop}; ++i) next[i] = state->x[i];\n"


def _count_constants(c_code: str) -> int:
    """Total number of elements in the constant arrays of a C source text."""
    counts = re.findall(r"static const \w+ \w+\[(\d+)\]", c_code)
    return sum(int(count) for count in counts)


def escape_comment(text: str) -> str:
    """Replace characters of a text that would end a C comment or continue it on the next line. The
    text may contain any name that a user gave a study."""
    return re.sub(rf"[^A-Za-z0-9 .,:;()\[\]%+=_'^/-]|\.\.\.|{LONELY_SLASH}", "_", text)


def _template_values(device: DeviceController, prefix: str) -> dict[str, object]:
    """Values for the placeholders of a template of C code: names, number type and dimensions."""
    controller = device.controller
    states, lifted = controller.b.shape
    disturbances = controller.scale.disturbances
    taking = f", const {device.real} d[{disturbances}]" if disturbances else ""
    passing = ", d" if disturbances else ""
    guard = prefix.upper()
    q = len(controller.c)
    m = controller.scale.inputs
    p = controller.scale.outputs
    return {
        "taking": taking,
        "passing": passing,
        "name": prefix,
        "guard": guard,
        "real": device.real,
        "n": states,
        "k": lifted,
        "q": q,
        "m": m,
        "p": p,
    }


def _render_limits_comment(device: DeviceController, has_set_points: bool) -> str:
    """C comment that says how to use the exported controller within input limits. Measured
    disturbances are the last argument."""
    comment = WITHIN[has_set_points].replace("@", device.no_set_points_reason)
    if not device.controller.scale.disturbances:
        return comment
    return comment.replace("y, r, u)", "y, r, u, d)").replace("y, u);   ", "y, u, d);")


def _render_disturbance_update(device: DeviceController, prefix: str) -> str:
    """C code that adds the effect of measured disturbances to the next state; empty without
    disturbances."""
    disturbances = device.controller.scale.disturbances
    if not disturbances:
        return ""
    states = len(device.controller.a)
    scaled = f"(d[i] - {prefix}_disturbance_equilibrium[i]) / {prefix}_disturbance_scale[i]"
    lines = [
        f"    {device.real} load[{disturbances}];",
        f"    for (int i = 0; i < {disturbances}; ++i) load[i] = {scaled};",
        f"    {prefix}_matvec({states}, {disturbances}, {prefix}_b_d, load, next);",
    ]
    return join_lines(lines)


def _render_replay_program(device: DeviceController, prefix: str) -> str:
    """C program that replays measurements and compares the controller's inputs with expected ones.
    The measurements are levels within two scales of rest, also beyond the limits, with noise on
    top; set points change in between."""
    scale = device.controller.scale
    rng = np.random.default_rng(REPLAY_SEED)
    steps = rng.uniform(-2, 2, (2, REPLAYED // 20, scale.outputs))
    levels = steps.repeat(20, axis=1)
    white_noise = rng.standard_normal(levels[0].shape)
    noisy = levels[0] + 0.05 * white_noise  # scaled
    measured = scale.physical_output(noisy)
    set_points = scale.physical_output(np.roll(levels[1], 7, axis=0))
    signals = {"measured": measured}
    disturbance = None
    if scale.disturbances:
        shape = (REPLAYED // 20, scale.disturbances)
        disturbance = scale.disturbance_equilibrium + scale.disturbance_scale * rng.uniform(
            -2, 2, shape
        ).repeat(20, axis=0)
        signals["disturbance"] = disturbance
    applied = device.recomputed_inputs(measured, set_points, disturbance)
    passed = "" if disturbance is None else ", disturbance[k]"

    signals["expected"] = applied
    begin = f"{prefix}_reset(&state);"
    act = (
        f"{prefix}_input(&state, u);\n"
        f"        {prefix}_clamp(u);\n"
        f"        {prefix}_advance(&state, measured[k], u{passed});"
    )
    if device.set_point_maps is not None:
        signals["wanted"] = set_points
        begin = f"{prefix}_init(&state, measured[0]);"
        act = f"{prefix}_track(&state, measured[k], wanted[k], u{passed});"

    texts = {"wanted": ""} | _template_values(device, prefix) | {"begin": begin, "act": act}
    for label, values in signals.items():
        texts[label] = _render_signal_table(label, values, device.real)
    if disturbance is not None:
        texts["wanted"] = f"{texts['wanted']}\n{texts['disturbance']}"
    largest = float(np.abs(applied).max())
    tolerance = AGREEMENT[device.real] * max(1.0, largest)
    return _REPLAY.substitute(texts, samples=REPLAYED, tolerance=repr(tolerance))


def _render_signal_table(array_name: str, values: Float[np.ndarray, "T w"], c_type: str) -> str:
    """C definition of a two-dimensional array with a signal, one row for each sample."""
    rows = []
    for row in values:
        numbers = ", ".join(render_number(value, c_type) for value in row)
        rows.append(f"{{{numbers}}}")
    width = values.shape[1]
    return f"static const {c_type} {array_name}[{REPLAYED}][{width}] = {{{', '.join(rows)}}};"
