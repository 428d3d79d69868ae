"""Certified against measured contraction, on the model: the distance of pairs of trajectories in the certified metric,
relative to its start (worst and median of many pairs), under the bound r^k. Left the feedback, right the observer."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_study.models.identified import SSM
from ssm_study.report import style
from ssm_study.report.study_folder import Study

PAIRS, SAMPLES, SEED = 200, 60, 0
Step = Callable[[Float[np.ndarray, "N n"]], Float[np.ndarray, "N n"]]


def draw(study: Study) -> Figure:
    run = study.best
    if run is None or run.model is None or run.certificate is None:
        return style.message("No run left a certificate.", style.PAGE_IN)
    return figure(run.model, run.certificate)


def figure(model: SSM, certificate: Mapping[str, Any]) -> Figure:
    fig = style.canvas(style.PAGE_IN, 2.3)
    control, observe = fig.subplots(1, 2)
    feedback, observer = certificate.get("state_feedback") or {}, certificate.get("observer") or {}
    if "k" in feedback:
        metric = np.linalg.inv(np.array(feedback["p"]))  # the dual form: M = P^-1
        a, b, k = (np.array(feedback[name]) for name in ("a", "b", "k"))
        _panel(control, distances(controlled(model, a, b, k), metric), feedback["rate"], "State feedback")
    if "l" in observer:
        step = observed(model, np.array(observer["l"]))
        _panel(observe, distances(step, np.array(observer["q"])), observer["rate"], "Observer error")
    return fig


def controlled(
    model: SSM, a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n k"], k: Float[np.ndarray, "m n"]
) -> Step:
    """`x+ = A x + B S_u(K x)` in scaled units, with the matrices that were certified (integrators among them)."""
    return lambda x: x @ a.T + model.scaffold_in(x @ k.T) @ b.T


def observed(model: SSM, l: Float[np.ndarray, "n p"]) -> Step:  # noqa: E741 - the paper's letter
    """`xh+ = A xh + L S_y(C xh)`: two observers that see the same input and output (u = 0, D drops out)."""

    def step(x: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
        rest = np.zeros((len(x), model.linear.b.shape[1]))
        return model.advance(x, rest) + model.read_scaled(x, rest) @ l.T

    return step


def distances(step: Step, metric: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "N T"]:
    """`d_k / d_0`, `d_k = sqrt((x - z)^T M (x - z))`, for random pairs of starts spread over four decades of size."""
    rng = np.random.default_rng(SEED)
    size = 10 ** rng.uniform(-2, 2, (2, PAIRS, 1))
    x, z = size * rng.standard_normal((2, PAIRS, len(metric)))
    d = np.empty((PAIRS, SAMPLES))
    for k in range(SAMPLES):
        d[:, k] = np.sqrt(np.einsum("ni,ij,nj->n", x - z, metric, x - z))
        x, z = step(x), step(z)
    return d / d[:, :1]


def _panel(axes: Axes, d: Float[np.ndarray, "N T"], rate: float, title: str) -> None:
    k = np.arange(d.shape[1])
    r = np.sqrt(1 - rate)
    axes.plot(k, r**k, color=style.VERMILLION, ls="--", label=f"bound, r = {r:.3f}")
    axes.plot(k, d.max(axis=0), color=style.BLUE, label="worst pair")
    axes.plot(k, np.median(d, axis=0), color=style.SKY, label="median pair")
    axes.set_yscale("log")
    axes.set_ylim(bottom=max(1e-12, 0.3 * float(np.nanmin(np.median(d, axis=0)))), top=3)
    axes.set(xlabel="Sample", ylabel=f"{title}:\ndistance / its start (–)")
    style.above(axes)
