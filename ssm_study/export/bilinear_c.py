"""Export of a bilinear controller as C99: one header with the controller, and a program that
replays measurements."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssm_study.export.c import AGREEMENT, escape_comment, require_c_identifier
from ssm_study.export.c_tables import read_template, render_array, render_number
from ssm_study.export.set_point_maps import REALS
from ssm_study.loop.bilinear_feedback import BilinearFeedback
from ssm_study.refusal import require_one_of

HEADER = read_template("bilinear.h.txt")
REPLAY = read_template("bilinear_replay.c.txt")
REPLAYED = 200  # samples


def render_bilinear_c(
    controller: BilinearFeedback,
    prefix: str,
    c_type: str,
    comment_lines: Sequence[str],
    certificate_digest: str,
) -> dict[str, str]:
    """Names and texts of the C files of a bilinear controller: a header, and a program that replays
    measurements.

    `comment_lines` are lines of the header's comment. Raises `BadRequest` for a name that C does
    not allow and for an unknown type of number.
    """
    require_c_identifier(prefix)
    require_one_of(tuple(REALS), "real", c_type)
    model = controller.model
    scale = model.scale
    texts: dict[str, object] = {"name": prefix, "guard": prefix.upper(), "real": c_type}
    texts["n"] = model.order
    texts["q"] = len(model.nodes)
    texts["p"] = len(model.c)
    texts["step_s"] = repr(model.step_s)
    texts["input_scale"] = render_number(scale.input_scale[0], c_type)
    texts["input_equilibrium"] = render_number(scale.input_equilibrium[0], c_type)
    lines = [f" * {escape_comment(line)}" for line in comment_lines]
    texts["about"] = "\n".join(lines)
    texts["digest"] = escape_comment(certificate_digest)
    texts["tables"] = render_tables(controller, prefix, c_type)
    texts |= render_replayed_signals(controller, c_type)
    header = HEADER.substitute(texts)
    replay = REPLAY.substitute(texts)
    return {f"{prefix}.h": header, f"{prefix}_replay.c": replay}


def render_tables(controller: BilinearFeedback, prefix: str, c_type: str) -> str:
    """C definitions of all constant arrays of a bilinear controller."""
    model = controller.model
    scale = model.scale
    arrays = {"nodes": model.nodes, "a": model.a, "b": model.b, "c": model.c}
    arrays["k"] = controller.k
    arrays["l"] = controller.l_nodes
    arrays["output_scale"] = scale.output_scale
    arrays["output_equilibrium"] = scale.output_equilibrium
    tables = ""
    for label, part in arrays.items():
        tables += render_array(f"{prefix}_{label}", part, c_type)
    return tables


def render_replayed_signals(controller: BilinearFeedback, c_type: str) -> dict[str, object]:
    """C texts of the signals of the replay program: measured outputs, expected inputs, and the
    tolerance."""
    y, u = simulate_replayed_signals(controller)
    measured = [render_number(value, c_type) for value in y.ravel()]
    expected = [render_number(value, c_type) for value in u.ravel()]
    texts: dict[str, object] = {"samples": len(u)}
    texts["measured"] = ", ".join(measured)
    texts["expected"] = ", ".join(expected)
    texts["tolerance"] = render_number(AGREEMENT[c_type], "double")
    return texts


def simulate_replayed_signals(
    controller: BilinearFeedback,
) -> tuple[Float[np.ndarray, "T p"], Float[np.ndarray, "T 1"]]:
    """Random measured outputs for the replay program, and the inputs that a bilinear controller
    computes from them."""
    rng = np.random.default_rng(0)
    scale = controller.model.scale
    levels = rng.uniform(-3.0, 3.0, (REPLAYED // 10, scale.outputs))
    scaled = np.repeat(levels, 10, axis=0)
    y = scale.physical_output(scaled)
    memory = controller.initial_memory(1)
    none = np.zeros(0)
    inputs = []
    for row in y[:, None]:
        u = controller.input(memory, row, none)
        memory = controller.next_memory(memory, u, row, none)
        inputs.append(u[0])
    return y, np.stack(inputs)
