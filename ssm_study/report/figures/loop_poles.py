"""Where the linear part of the model, of the controlled model and of the observer's error have
their
poles, at the slopes of rest. The dashed circle is the factor per sample that is proved of the
controller's gain for every slope; the full one is the unit circle."""

from typing import Any

import numpy as np
from jaxtyping import Float, Inexact
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.models.structured import at_rest
from ssm_study.report.study_folder import NothingToDraw, StudyFolder


def draw(study: StudyFolder) -> Figure:
    model, certificate = study.of_best(
        "any_model", "certificate", otherwise="No run left a model with gains."
    )
    feedback = certificate.get("state_feedback") or {}
    observer = certificate.get("observer") or {}
    if "k" not in feedback or "l" not in observer:
        raise NothingToDraw("The best run has no gains for both sides.")
    poles = pole_groups(model, np.array(feedback["k"]), np.array(observer["l"]))
    rate = (feedback | (certificate.get("state_feedback_deployed") or {})).get("rate")
    fig = style.canvas(style.COLUMN_IN, 3.4)
    axes = fig.add_subplot()
    circle = np.exp(2j * np.pi * np.linspace(0, 1, 361))
    axes.plot(circle.real, circle.imag, color=style.INK, lw=0.8)
    if rate is not None:
        proved = np.sqrt(1 - rate) * circle
        label = f"proved factor {np.sqrt(1 - rate):.3f}"
        axes.plot(proved.real, proved.imag, color=style.GREY, ls="--", lw=0.9, label=label)
    for (name, values), colour, marker in zip(
        poles.items(), (style.GREY, style.BLUE, style.VERMILLION), "xo^", strict=True
    ):
        look: dict[str, Any] = {"ls": "", "marker": marker, "color": colour, "fillstyle": "none"}
        axes.plot(values.real, values.imag, label=name, **look)
    axes.set_aspect("equal")
    axes.set(xlabel="Real part (per sample)", ylabel="Imaginary part (per sample)")
    style.above(axes, columns=2)
    return fig


def pole_groups(
    model: Any,
    k: Float[np.ndarray, "u z"],
    l: Float[np.ndarray, "e y"],  # noqa: E741
) -> dict[str, Inexact[np.ndarray, "_"]]:
    """Eigenvalues of `A`, `A + B J_u K` and `A + L J_y C` at rest; modes of the plant's load
    out."""
    linear = at_rest(model)
    n = len(linear.a)
    slope_in = model.scaffold_in.jacobian(np.zeros(model.scaffold_in.inputs))
    slope_out = model.scaffold_out.jacobian(np.zeros(model.scaffold_out.inputs))
    return {
        "model": np.linalg.eigvals(linear.a),
        "controlled": np.linalg.eigvals(linear.a + linear.b @ slope_in @ k[:, :n]),
        "observer": np.linalg.eigvals(linear.a + l[:n] @ slope_out @ linear.c),
    }
