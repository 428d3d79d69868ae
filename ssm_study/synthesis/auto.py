"""Rates and weights chosen from the model and its validation record alone: the fastest certified design that holds.

Among guaranteed-cost designs on a grid of rates and weights, take the one with the smallest response area on the model
whose mismatch margin exceeds one. Nothing of the closed-loop test enters. Source: THEORY sections 4 and 5.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from ssm_study.models.identified import SSM
from ssm_study.refusal import require
from ssm_study.signals import Trajectory
from ssm_study.synthesis.area import relative_areas
from ssm_study.synthesis.certificate import Design, Infeasible
from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.frontier import rate_limit
from ssm_study.synthesis.mismatch import mismatch_gain, peaks_on_grid, sensitivity_peak
from ssm_study.synthesis.problem import NoSolution, Problem
from ssm_study.synthesis.riccati import RiccatiSynthesis, guaranteed_cost
from ssm_study.systems import JacobianBall

GRID_ANGLES = np.geomspace(1e-3, np.pi, 240)
"""Frequencies (rad/sample) that rank the candidates; the chosen one is then judged by the exact norm."""
ATTEMPTS = 20
"""How many candidates are verified exactly before the search gives up: each costs two exact certificates."""


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Gains on the grid, and the specification that gives each of them back."""

    feedback: tuple[RiccatiSynthesis, ...]
    ks: Float[np.ndarray, "C m n"]
    observing: tuple[RiccatiSynthesis, ...]
    ls: Float[np.ndarray, "O n p"]

    def specification(self, pair: Int[np.ndarray, "2"]) -> RiccatiSynthesis:
        feedback, observing = self.feedback[pair[0]], self.observing[pair[1]]
        names = ("rate_observer", "input_noise", "state_noise", "output_noise")
        return replace(feedback, **{name: getattr(observing, name) for name in names})


@dataclass(frozen=True, kw_only=True)
class Auto:
    """The fastest certified design whose mismatch margin exceeds `margin`.

    The grids: rates as shares of the model's own rate `1 - spectral_radius^2` (the gain may then vanish, so a stable
    model always leaves a cautious choice) and of the stretch from there to the exact rate limit; for the observer,
    whose limit is far, also absolute rates; input weights against `|C x|^2`, output noise against input noise. A rate
    given as a number instead of "auto" is kept. When no candidate reaches the margin, the one with the largest is
    returned and `solver_status` says so.
    """

    rate_controller: float | str = "auto"
    rate_observer: float | str = "auto"
    margin: float = 1.0
    own_rate_shares: Sequence[float] = (0.5,)
    stretch_shares: Sequence[float] = (0.05, 0.3, 0.6, 0.9)
    observer_rates: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5)
    input_weights: Sequence[float] = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    output_noises: Sequence[float] = (1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    state_weight: float = 1e-6
    state_noise: float = 1e-4

    method: ClassVar[str] = "auto"

    def __post_init__(self) -> None:
        for name in ("rate_controller", "rate_observer"):
            rate = getattr(self, name)
            given = isinstance(rate, int | float) and 0 < rate < 1
            remedy = 'use "auto" or a number such as 0.1'
            require(rate == "auto" or given, f"synthesis.{name}", rate, "a contraction rate lies in (0, 1)", remedy)
        require(self.margin > 0, "synthesis.margin", self.margin, "the margin must be positive", "use 1")
        for name in ("own_rate_shares", "stretch_shares", "observer_rates"):
            grid = getattr(self, name)
            inside = len(grid) > 0 and all(0 < value < 1 for value in grid)
            require(inside, f"synthesis.{name}", grid, "must hold numbers in (0, 1)", "keep the default grid")
        for name in ("input_weights", "output_noises"):
            grid = getattr(self, name)
            positive = len(grid) > 0 and all(0 < value < np.inf for value in grid)
            require(positive, f"synthesis.{name}", grid, "must hold positive numbers", "keep the default grid")

    def design(
        self,
        model: SSM,
        input_ball: JacobianBall,
        output_ball: JacobianBall,
        validation: tuple[Trajectory, ...],
    ) -> Design:
        """The chosen controller and observer, exactly verified; infeasible as the Riccati route reports it."""
        candidates = self.candidates(model, input_ball, output_ball)
        if candidates is None:
            return self._reported(self._slowest(model, input_ball, output_ball), "nothing on the grid is feasible")
        gain = mismatch_gain(model, validation)
        peaks = peaks_on_grid(model.linear, candidates.ks, candidates.ls, input_ball, output_ball, GRID_ANGLES)
        for pair in self._in_order(model, candidates, 1 / np.maximum(gain * peaks, np.finfo(float).tiny)):
            design = _both(candidates.specification(pair), model, input_ball, output_ball)
            if design.certified and self._margin(model, design, gain, input_ball, output_ball) > self.margin:
                return self._reported(design, "fastest with margin above the bound")
        best = np.array(np.unravel_index(np.argmin(peaks), peaks.shape))
        design = _both(candidates.specification(best), model, input_ball, output_ball)
        return self._reported(design, f"no margin above {self.margin:g}; largest margin taken")

    def candidates(self, model: SSM, input_ball: JacobianBall, output_ball: JacobianBall) -> Candidates | None:
        """Every gain of the grids that the Riccati equation gives; None if one side has none."""
        controller_limit, observer_limit = rate_limit(model.linear, input_ball, output_ball)
        own = max(1 - model.linear.spectral_radius**2, 0.0)
        cautious = [share * own for share in self.own_rate_shares]
        bold = [own + share * (controller_limit - own) for share in self.stretch_shares]
        rates_c = self._rates(self.rate_controller, cautious + bold)
        rates_o = self._rates(self.rate_observer, cautious + list(self.observer_rates))
        feedback, observing = [], []
        for rate in (r for r in rates_c if 0 < r < controller_limit):
            for weight in self.input_weights:
                feedback.append(self._specification(rate_controller=rate, input_weight=weight))
        for rate in (r for r in rates_o if 0 < r < observer_limit):
            for noise in self.output_noises:
                observing.append(self._specification(rate_observer=rate, output_noise=noise))
        if not input_ball.lower * input_ball.upper > 0 or not output_ball.lower * output_ball.upper > 0:
            return None
        found_k = _solved((s, s.controller_problem(model.linear, input_ball)) for s in feedback)
        found_l = _solved((s, s.observer_problem(model.linear, output_ball)) for s in observing)
        if not found_k or not found_l:
            return None
        return Candidates(
            feedback=tuple(s for s, _ in found_k),
            ks=np.stack([k for _, k in found_k]),
            observing=tuple(s for s, _ in found_l),
            ls=np.stack([k.T for _, k in found_l]),
        )

    def _rates(self, rate: float | str, grid: list[float]) -> list[float]:
        return grid if rate == "auto" else [float(rate)]

    def _specification(self, **chosen: float) -> RiccatiSynthesis:
        asked = {"rate_controller": 0.5, "rate_observer": 0.5} | chosen
        return RiccatiSynthesis(state_weight=self.state_weight, state_noise=self.state_noise, **asked)

    def _in_order(
        self, model: SSM, candidates: Candidates, margins: Float[np.ndarray, "C O"]
    ) -> Iterator[Int[np.ndarray, "2"]]:
        """Pairs whose margin on the grid exceeds the bound, fastest on the model first."""
        pairs = np.argwhere(margins > self.margin)
        if not len(pairs):
            return
        areas = relative_areas(model, candidates.ks, candidates.ls, pairs)
        yield from pairs[np.argsort(areas, kind="stable")[:ATTEMPTS]]

    def _margin(
        self, model: SSM, design: Design, gain: float, input_ball: JacobianBall, output_ball: JacobianBall
    ) -> float:
        if isinstance(design.state_feedback, Infeasible) or isinstance(design.observer, Infeasible):
            return 0.0
        peak = sensitivity_peak(model.linear, design.state_feedback.k, design.observer.l, input_ball, output_ball)
        return 0.0 if np.isinf(peak) else 1 / max(gain * peak, np.finfo(float).tiny)

    def _slowest(self, model: SSM, input_ball: JacobianBall, output_ball: JacobianBall) -> Design:
        """What the Riccati route says at the least demanding request, as the reason to report."""
        asked = [1e-3 if rate == "auto" else float(rate) for rate in (self.rate_controller, self.rate_observer)]
        specification = self._specification(rate_controller=asked[0], rate_observer=asked[1])
        return _both(specification, model, input_ball, output_ball)

    def _reported(self, design: Design, status: str) -> Design:
        """The parts under this method's name, with what the search found."""
        feedback, observer = design.state_feedback, design.observer
        return Design(
            state_feedback=replace(feedback, method=self.method, solver_status=f"{status}; {feedback.solver_status}"),
            observer=replace(observer, method=self.method, solver_status=f"{status}; {observer.solver_status}"),
        )


def _both(specification: RiccatiSynthesis, model: SSM, input_ball: JacobianBall, output_ball: JacobianBall) -> Design:
    return Design(
        state_feedback=specification.state_feedback(model.linear, input_ball),
        observer=specification.observer(model.linear, output_ball),
    )


def _solved(
    problems: Iterator[tuple[RiccatiSynthesis, Problem]],
) -> list[tuple[RiccatiSynthesis, Float[np.ndarray, "m n"]]]:
    found = []
    for specification, problem in problems:
        try:
            found.append((specification, guaranteed_cost(problem).k))
        except NoSolution:
            continue
    return found


Synthesis.register(Auto)  # same `design`; but it has grids where a Synthesis has one rate and one weight each
