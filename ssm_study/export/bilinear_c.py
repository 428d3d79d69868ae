"""Export of a bilinear controller as C99: one header, and a program that replays it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssm_study.export.c import AGREEMENT, escape_comment, read_template, refuse_c_keyword
from ssm_study.export.c_tables import render_array, render_number
from ssm_study.export.device import REALS
from ssm_study.loop.bilinear_feedback import BilinearFeedback
from ssm_study.refusal import require_one_of

HEADER = read_template("bilinear.h.txt")
REPLAY = read_template("bilinear_replay.c.txt")
REPLAYED = 200  # samples


def render_bilinear_c(
    controller: BilinearFeedback, name: str, real: str, about: Sequence[str], digest: str
) -> dict[str, str]:
    """Names and texts of the C files of a bilinear controller: header and replay program.

    `about` are lines of the header's comment. Raises `BadRequest` for a name that C does not allow
    and for an unknown type of number.
    """
    refuse_c_keyword(name)
    require_one_of(tuple(REALS), "real", real)
    model = controller.model
    scale = model.scale
    texts: dict[str, object] = {"name": name, "guard": name.upper(), "real": real}
    texts["n"] = model.order
    texts["q"] = len(model.nodes)
    texts["p"] = len(model.c)
    texts["step_s"] = repr(model.step_s)
    texts["input_scale"] = render_number(scale.input_scale[0], real)
    texts["input_equilibrium"] = render_number(scale.input_equilibrium[0], real)
    lines = [f" * {escape_comment(line)}" for line in about]
    texts["about"] = "\n".join(lines)
    texts["digest"] = escape_comment(digest)
    texts["tables"] = render_tables(controller, name, real)
    texts |= render_replayed_signals(controller, real)
    header = HEADER.substitute(texts)
    replay = REPLAY.substitute(texts)
    return {f"{name}.h": header, f"{name}_replay.c": replay}


def render_tables(controller: BilinearFeedback, name: str, real: str) -> str:
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
        tables += render_array(f"{name}_{label}", part, real)
    return tables


def render_replayed_signals(controller: BilinearFeedback, real: str) -> dict[str, object]:
    """C texts of the signals of a replay: measured outputs, expected inputs, and the tolerance."""
    y, u = replayed_signals(controller)
    measured = [render_number(value, real) for value in y.ravel()]
    expected = [render_number(value, real) for value in u.ravel()]
    texts: dict[str, object] = {"samples": len(u)}
    texts["measured"] = ", ".join(measured)
    texts["expected"] = ", ".join(expected)
    texts["tolerance"] = render_number(AGREEMENT[real], "double")
    return texts


def replayed_signals(
    controller: BilinearFeedback,
) -> tuple[Float[np.ndarray, "T p"], Float[np.ndarray, "T 1"]]:
    """Measured outputs of a replay, and the inputs with which the controller responds."""
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
        memory = controller.advance(memory, u, row, none)
        inputs.append(u[0])
    return y, np.stack(inputs)
