"""Certified against measured contraction, on the model: the distance of pairs of trajectories in
the certified metric, relative to its start (worst and median of many pairs), under the bound r^k
that is proved of the gains. Left the feedback, right the observer."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study import style
from ssm_study.models.identified import SSM
from ssm_study.report.study_folder import StudyFolder

PAIRS = 200
SAMPLES = 60
SEED = 0
Step = Callable[[Float[np.ndarray, "N n"]], Float[np.ndarray, "N n"]]


def draw(study: StudyFolder) -> Figure:
    model, certificate = study.of_best(
        "model", "certificate", otherwise="No run left a certificate for a model without neurons."
    )
    fig = style.canvas(style.PAGE_IN, 2.3)
    control, observe = fig.subplots(1, 2)
    feedback, observer = (  # with what is proved of the gains where the run knows it
        (certificate.get(side) or {}) | (certificate.get(f"{side}_deployed") or {})
        for side in ("state_feedback", "observer")
    )
    if "k" in feedback:
        a, b, k, p = (np.array(feedback[name]) for name in ("a", "b", "k", "p"))
        d = distances(controlled(model, a, b, k), np.linalg.inv(p))  # the dual form: M = P^-1
        _panel(control, d, feedback, "State feedback")
    if "l" in observer:
        d = distances(
            observed(model, np.array(observer["l"])), np.array(observer["q"])
        )  # the primal form: M = Q
        _panel(observe, d, observer, "Observer error")
    return fig


def controlled(
    model: SSM,
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n k"],
    k: Float[np.ndarray, "m n"],
) -> Step:
    """`x+ = A x + B S_u(K x)` in scaled units, with the matrices that were certified (integrators
    among them)."""
    return lambda x: x @ a.T + model.scaffold_in(x @ k.T) @ b.T


def observed(model: SSM, l: Float[np.ndarray, "n p"]) -> Step:  # noqa: E741 - the paper's letter
    """`xh+ = A xh + L S_y(C xh)`: two observers that see the same input and output (u = 0, D drops
    out)."""
    rest = np.zeros((PAIRS, model.linear.b.shape[1]))
    return lambda x: model.advance(x, rest) + model.read_scaled(x, rest) @ l.T


def distances(step: Step, metric: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "N T"]:
    """`d_k / d_0`, `d_k = sqrt((x - z)^T M (x - z))`, for random pairs of starts spread over four
    decades of size."""
    rng = np.random.default_rng(SEED)
    x, z = 10 ** rng.uniform(-2, 2, (2, PAIRS, 1)) * rng.standard_normal((2, PAIRS, len(metric)))
    d = np.empty((PAIRS, SAMPLES))
    for k in range(SAMPLES):
        d[:, k] = np.sqrt(np.einsum("ni,ij,nj->n", x - z, metric, x - z))
        x = step(x)
        z = step(z)
    return d / d[:, :1]


def _panel(axes: Axes, d: Float[np.ndarray, "N T"], part: Mapping[str, Any], title: str) -> None:
    k = np.arange(d.shape[1])
    r = np.sqrt(1 - part["rate"])
    median = np.median(d, axis=0)
    said = "bound" if part["certified"] else "not certified"
    axes.plot(k, r**k, color=style.VERMILLION, ls="--", zorder=3, label=f"{said}, r = {r:.3f}")
    axes.plot(k, d.max(axis=0), color=style.BLUE, label="worst pair")
    axes.plot(k, median, color=style.SKY, label="median pair")
    axes.set(
        yscale="log", ylim=(max(1e-12, 0.3 * float(np.nanmin(median))), 3)
    )  # below lies only rounding
    axes.set(xlabel="Sample", ylabel=f"{title}:\ndistance / its start (–)")
    style.above(axes)
