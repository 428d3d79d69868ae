"""Certified against measured contraction of the model, for the feedback (left) and the observer
(right). Solid lines are distances between pairs of trajectories, relative to their start, in the
metric of the certificate. They show the worst and the median of many pairs. The dashed line is the
proved bound r^k after k samples, above which no pair may lie. Where the three lines coincide, no
smaller bound holds."""

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
    """Draw, for the best run, the certified and the simulated decay of distances between
    trajectories, for controller and observer."""
    reason = "No run left a certificate for a model without neurons."
    model, certificate = study.read_from_best("model", "certificate", otherwise=reason)
    fig = style.new_figure(style.PAGE_IN, 2.3)
    control, observe = fig.subplots(1, 2)
    feedback = certificate_with_largest_rate(certificate, "state_feedback")
    observer = certificate_with_largest_rate(certificate, "observer")
    if "k" in feedback:
        a, b, k, p = (np.array(feedback[name]) for name in ("a", "b", "k", "p"))
        metric = np.linalg.inv(p)  # the dual form: M = P^-1
        distances = relative_distances(controlled_step_function(model, a, b, k), metric)
        draw_decay(control, distances, feedback)
        label_axes(control, "State feedback")
    if "l" in observer:
        gain = np.array(observer["l"])
        metric = np.array(observer["q"])  # the primal form: M = Q
        distances = relative_distances(observer_step_function(model, gain), metric)
        draw_decay(observe, distances, observer)
        label_axes(observe, "Observer error")
    return fig


def certificate_with_largest_rate(certificate: Mapping[str, Any], side: str) -> dict[str, Any]:
    """Stored certificate of a controller or observer, with its largest proved rate."""
    designed = certificate.get(side) or {}
    deployed = certificate.get(f"{side}_deployed") or {}
    return designed | deployed


def controlled_step_function(
    model: SSM,
    a: Float[np.ndarray, "n n"],
    b: Float[np.ndarray, "n k"],
    k: Float[np.ndarray, "m n"],
) -> Step:
    """Function that computes the next state of a model under state feedback, in scaled units."""
    return lambda x: x @ a.T + model.scaffold_in(x @ k.T) @ b.T


def observer_step_function(model: SSM, l: Float[np.ndarray, "n p"]) -> Step:  # noqa: E741 - the paper's letter
    """Function that computes the next state of an observer, in scaled units."""
    rest = np.zeros((PAIRS, model.linear.b.shape[1]))
    return lambda x: model.next_state(x, rest) + model.scaled_output_at(x, rest) @ l.T


def relative_distances(step: Step, metric: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "N T"]:
    """Distances of random pairs of simulated trajectories over time, relative to their initial
    distances."""
    rng = np.random.default_rng(SEED)
    exponents = rng.uniform(-2, 2, (2, PAIRS, 1))
    directions = rng.standard_normal((2, PAIRS, len(metric)))
    x, z = 10**exponents * directions
    d = np.empty((PAIRS, SAMPLES))
    for k in range(SAMPLES):
        gap = x - z
        squares = np.einsum("ni,ij,nj->n", gap, metric, gap)
        d[:, k] = np.sqrt(squares)
        x = step(x)
        z = step(z)
    return d / d[:, :1]


def draw_decay(axes: Axes, d: Float[np.ndarray, "N T"], part: Mapping[str, Any]) -> None:
    """Draw the certified bound on the distance of two trajectories at each sample, with the largest
    and the median simulated distance."""
    k = np.arange(d.shape[1])
    r = np.sqrt(1 - part["rate"])
    median = np.median(d, axis=0)
    word = "bound" if part["certified"] else "not certified"
    bound: dict[str, Any] = {"color": style.VERMILLION, "ls": "--", "zorder": 3}
    axes.plot(k, r**k, label=f"{word}, r = {r:.3f}", **bound)
    worst = d.max(axis=0)
    axes.plot(k, worst, color=style.BLUE, label="worst pair")
    axes.plot(k, median, color=style.SKY, label="median pair")
    lowest = max(1e-12, 0.3 * float(np.nanmin(median)))  # below lies only rounding
    axes.set(yscale="log", ylim=(lowest, 3))


def label_axes(axes: Axes, title: str) -> None:
    """Label the axes of a figure with sample number and relative distance, and place the legend
    above."""
    axes.set(xlabel="Sample", ylabel=f"{title}:\ndistance / its start (–)")
    style.place_legend_above(axes)
