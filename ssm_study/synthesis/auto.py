"""Rates and weights chosen from the model and its validation record alone: the fastest certified design that holds.

Among guaranteed-cost designs on a grid of rates and weights, take the one with the smallest response area on the model
(`synthesis.area`) that is predicted to keep the plant (`synthesis.mismatch`): its resolved mismatch margin exceeds one
and its controller is stable by itself. Nothing of the closed-loop test enters. Source: THEORY sections 4 and 5.
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
from ssm_study.synthesis.frontier import controller_frontier, observer_frontier
from ssm_study.synthesis.integral import IntegralSynthesis, with_integrators
from ssm_study.synthesis.mismatch import Mismatch, mismatch, predict
from ssm_study.synthesis.problem import NoSolution, Problem
from ssm_study.synthesis.riccati import RiccatiSynthesis, guaranteed_cost
from ssm_study.synthesis.sensitivity import controller_radius, peaks_on_grid
from ssm_study.systems import JacobianBall, StateSpace

GRID_ANGLES = np.geomspace(1e-3, np.pi, 240)
"""Frequencies (rad/sample) that rank the candidates; the chosen one is then judged on a finer grid."""
ATTEMPTS = 20
"""How many candidates are verified exactly before the search gives up: each costs two exact certificates."""


Found = tuple[RiccatiSynthesis, Float[np.ndarray, "m s"]]


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Gains on the grid, and the specification that gives each of them back; `integral` holds 0 for no integrators."""

    feedback: tuple[RiccatiSynthesis, ...]
    integral: tuple[float, ...]
    ks: Float[np.ndarray, "C m s"]
    observing: tuple[RiccatiSynthesis, ...]
    ls: Float[np.ndarray, "O n p"]

    def specification(self, pair: Int[np.ndarray, "2"]) -> RiccatiSynthesis | IntegralSynthesis:
        feedback, observing, weight = self.feedback[pair[0]], self.observing[pair[1]], self.integral[pair[0]]
        names = ("rate_observer", "input_noise", "state_noise", "output_noise")
        chosen = replace(feedback, **{name: getattr(observing, name) for name in names})
        return IntegralSynthesis(synthesis=chosen, integral_weight=weight) if weight else chosen


@dataclass(frozen=True, kw_only=True)
class Auto:
    """The fastest certified design with a stable controller whose resolved mismatch margin exceeds `margin`.

    The grids: rates as shares of the model's own rate `1 - spectral_radius^2` (the gain may then vanish, so a stable
    model always leaves a cautious choice) and of the stretch from there to the exact rate limit; for the observer,
    whose limit is far, also absolute rates; input weights against `|C x|^2`, output noise against input noise. A rate
    given as a number instead of "auto" is kept; `rate` stands for each side that is left at "auto". When no candidate
    passes, the one with the largest margin is returned and `solver_status` says so. With `integral_weights`, the
    controller also acts on integrators of the tracking error (`synthesis.integral`), and their weight is one more axis
    of the grid.
    """

    rate: float | str = "auto"
    rate_controller: float | str = "auto"
    rate_observer: float | str = "auto"
    margin: float = 1.0
    own_rate_shares: Sequence[float] = (0.5,)
    stretch_shares: Sequence[float] = (0.05, 0.3, 0.6, 0.9)
    observer_rates: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5)
    input_weights: Sequence[float] = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    output_noises: Sequence[float] = (1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    integral_weights: Sequence[float] = ()
    state_weight: float = 1e-6
    state_noise: float = 1e-4

    method: ClassVar[str] = "auto"

    def __post_init__(self) -> None:
        for name in ("rate", "rate_controller", "rate_observer"):
            rate = getattr(self, name)
            given = isinstance(rate, int | float) and 0 < rate < 1
            remedy = 'use "auto" or a number such as 0.1'
            require(rate == "auto" or given, f"synthesis.{name}", rate, "a contraction rate lies in (0, 1)", remedy)
        require(self.margin > 0, "synthesis.margin", self.margin, "the margin must be positive", "use 1")
        for name in ("own_rate_shares", "stretch_shares", "observer_rates"):
            grid = getattr(self, name)
            inside = len(grid) > 0 and all(0 < value < 1 for value in grid)
            require(inside, f"synthesis.{name}", grid, "must hold numbers in (0, 1)", "keep the default grid")
        for name in ("input_weights", "output_noises", "integral_weights"):
            grid = getattr(self, name)
            positive = (len(grid) > 0 or name == "integral_weights") and all(0 < value < np.inf for value in grid)
            require(positive, f"synthesis.{name}", grid, "must hold positive numbers", "keep the default grid")

    def design(
        self,
        model: SSM,
        input_ball: JacobianBall,
        output_ball: JacobianBall,
        validation: tuple[Trajectory, ...],
        start_up_samples: int = 0,
    ) -> Design:
        """The chosen controller and observer, exactly verified; infeasible as the Riccati route reports it."""
        candidates = self.candidates(model, input_ball, output_ball)
        if candidates is None:
            return self._reported(self._slowest(model, input_ball, output_ball), "nothing on the grid is feasible")
        balls, shown = (input_ball, output_ball), mismatch(model, validation, start_up_samples)
        known = candidates.ks, candidates.ls
        peaks = peaks_on_grid(model.linear, *known, *balls, GRID_ANGLES, shown.at(GRID_ANGLES))
        for pair in self._in_order(model, candidates, balls, peaks, validation):
            design = candidates.specification(pair).design(model, *balls)
            if design.certified and self._passes(model, design, balls, shown):
                return self._reported(design, "fastest that is predicted to keep the plant")
        best = np.array(np.unravel_index(np.argmin(peaks), peaks.shape))
        design = candidates.specification(best).design(model, *balls)
        status = f"no stable controller with margin above {self.margin:g}; largest margin taken"
        return self._reported(design, status)

    def candidates(self, model: SSM, input_ball: JacobianBall, output_ball: JacobianBall) -> Candidates | None:
        """Every gain of the grids that the Riccati equation gives; None if one side has none."""
        if abs(input_ball.alpha) <= input_ball.beta or abs(output_ball.alpha) <= output_ball.beta:
            return None
        feedback = [
            (specification, weight, gain)
            for weight in self.integral_weights or (0.0,)
            for specification, gain in self._controllers(_controlled(model, weight), input_ball)
        ]
        observing = self._observers(model.linear, output_ball)
        if not feedback or not observing:
            return None
        return Candidates(
            feedback=tuple(specification for specification, _, _ in feedback),
            integral=tuple(weight for _, weight, _ in feedback),
            ks=np.stack([gain for _, _, gain in feedback]),
            observing=tuple(specification for specification, _ in observing),
            ls=np.stack([gain.T for _, gain in observing]),
        )

    def _controllers(self, system: StateSpace, ball: JacobianBall) -> list[Found]:
        limit, own = controller_frontier(system, ball).rate_limit, _own_rate(system)
        bold = [own + share * (limit - own) for share in self.stretch_shares]
        rates = self._rates(self.rate_controller, self._cautious(system) + bold, limit)
        asked = [
            self._specification(rate_controller=rate, input_weight=weight)
            for rate in rates
            for weight in self.input_weights
        ]
        return _solved((specification, specification.controller_problem(system, ball)) for specification in asked)

    def _observers(self, system: StateSpace, ball: JacobianBall) -> list[Found]:
        limit = observer_frontier(system, ball).rate_limit
        rates = self._rates(self.rate_observer, self._cautious(system) + list(self.observer_rates), limit)
        asked = [
            self._specification(rate_observer=rate, output_noise=noise)
            for rate in rates
            for noise in self.output_noises
        ]
        return _solved((specification, specification.observer_problem(system, ball)) for specification in asked)

    def _cautious(self, system: StateSpace) -> list[float]:
        return [share * _own_rate(system) for share in self.own_rate_shares]

    def _rates(self, rate: float | str, grid: list[float], limit: float) -> list[float]:
        asked = self._asked(rate)
        return [value for value in (grid if asked == "auto" else [float(asked)]) if 0 < value < limit]

    def _asked(self, own: float | str) -> float | str:
        return self.rate if own == "auto" else own

    def _specification(self, **chosen: float) -> RiccatiSynthesis:
        asked = {"rate_controller": 0.5, "rate_observer": 0.5} | chosen
        return RiccatiSynthesis(state_weight=self.state_weight, state_noise=self.state_noise, **asked)

    def _in_order(
        self,
        model: SSM,
        candidates: Candidates,
        balls: tuple[JacobianBall, JacobianBall],
        peaks: Float[np.ndarray, "C O"],
        validation: tuple[Trajectory, ...],
    ) -> Iterator[Int[np.ndarray, "2"]]:
        """Pairs with a stable controller whose margin on the grid exceeds the bound, fastest on the model first."""
        pairs = np.argwhere(self.margin * peaks < 1)
        gains = candidates.ks[pairs[:, 0]], candidates.ls[pairs[:, 1]]
        pairs = pairs[controller_radius(model.linear, *gains, *balls) < 1]
        if not len(pairs):
            return
        areas = relative_areas(model, candidates.ks, candidates.ls, pairs, validation)
        yield from pairs[np.argsort(areas, kind="stable")[:ATTEMPTS]]

    def _passes(self, model: SSM, design: Design, balls: tuple[JacobianBall, JacobianBall], shown: Mismatch) -> bool:
        feedback, observer = design.state_feedback, design.observer
        if isinstance(feedback, Infeasible) or isinstance(observer, Infeasible):
            return False
        return predict(model, feedback.k, observer.l, *balls, shown).keeps_the_plant(self.margin)

    def _slowest(self, model: SSM, input_ball: JacobianBall, output_ball: JacobianBall) -> Design:
        """What the Riccati route says at the least demanding request, as the reason to report."""
        rates = (self._asked(self.rate_controller), self._asked(self.rate_observer))
        asked = [1e-3 if rate == "auto" else float(rate) for rate in rates]
        specification = self._specification(rate_controller=asked[0], rate_observer=asked[1])
        if not self.integral_weights:
            return specification.design(model, input_ball, output_ball)
        integral = IntegralSynthesis(synthesis=specification, integral_weight=self.integral_weights[0])
        return integral.design(model, input_ball, output_ball)

    def _reported(self, design: Design, status: str) -> Design:
        """The parts under this method's name, with what the search found."""
        feedback, observer = design.state_feedback, design.observer
        return Design(
            state_feedback=replace(feedback, method=self.method, solver_status=f"{status}; {feedback.solver_status}"),
            observer=replace(observer, method=self.method, solver_status=f"{status}; {observer.solver_status}"),
        )


def _controlled(model: SSM, integral_weight: float) -> StateSpace:
    return with_integrators(model, integral_weight) if integral_weight else model.linear


def _own_rate(system: StateSpace) -> float:
    """The rate at which the system contracts by itself, 0 if it does not."""
    return max(1 - system.spectral_radius**2, 0.0)


def _solved(problems: Iterator[tuple[RiccatiSynthesis, Problem]]) -> list[Found]:
    found = []
    for specification, problem in problems:
        try:
            found.append((specification, guaranteed_cost(problem).k))
        except NoSolution:
            continue
    return found


Synthesis.register(Auto)  # same `design`; but it has grids where a Synthesis has one rate and one weight each
