"""Grid of rates and weights at which the candidate gains of the synthesis `auto` are computed.

Source: docs/theory.md, "The frontier"; docs/closed_loop.md, "Rates chosen for you".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import NoSolution, Solution, dual_system
from ssm_study.certificates.theorems.integral_action import append_internal_model, internal_model
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model, evaluate_activations
from ssm_study.synthesis.candidates import GainCandidate, GainCandidates
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace, System

Slopes = Float[np.ndarray, "q"]
# Share of the rate that a model has by itself: the most cautious request, whose gain may vanish.
OWN_SHARE = 0.5
STATE_WEIGHT = 1e-6  # of the gains' cost, beside `|C x|^2`
INTEGRAL_WEIGHTS = (1e-5, 1e-4, 1e-3, 1e-2)  # of an internal model's states, where none are given
HALF_SLOPE = 0.5


class SideCandidates(NamedTuple):
    """Candidate gains of the controller, or of the observer, and the number of rates and weights
    without a solution."""

    candidates: list[GainCandidate]
    unsolved: int


@dataclass(frozen=True, kw_only=True)
class CandidateGrid:
    """Contraction rates and cost weights of controllers and observers at which candidate gains are
    computed. The fields are explained in `auto`."""

    rate_controller: float | str
    rate_observer: float | str
    stretch_shares: Sequence[float]
    observer_rates: Sequence[float]
    input_weights: Sequence[float]
    output_noises: Sequence[float]
    integral_weights: Sequence[float]
    internal_model_signals: tuple[str, ...]

    def riccati_settings(self) -> list[RiccatiSynthesis]:
        """Settings of the Riccati syntheses of the grid, one for each weight of the internal model
        (integral action)."""
        weights: Sequence[float] = INTEGRAL_WEIGHTS[:1]
        if self.internal_model_signals:
            weights = tuple(self.integral_weights) or INTEGRAL_WEIGHTS
        return [
            RiccatiSynthesis(
                rate_controller=0.5,
                rate_observer=0.5,
                internal_model=self.internal_model_signals,
                state_weight=STATE_WEIGHT,
                integral_weight=weight,
            )
            for weight in weights
        ]

    def compute_candidates(self, model: Model, balls: JacobianBalls) -> GainCandidates | None:
        """Candidate gains at all rates and weights of the grid with a Riccati solution; None if
        controller or observer has no candidate."""
        if any(abs(ball.alpha) <= ball.beta for ball in (balls.input, balls.output)):
            return None
        rest = equilibrium_slopes(model)
        specifications = self.riccati_settings()
        first = specifications[0]
        observers, unsolved = self.solve_gains(first, model.system, balls.output, True, rest)
        controllers: list[GainCandidate] = []
        for specification in specifications:
            controlled = model.system
            if specification.internal_model_signals:
                weight = specification.integral_weight
                controlled = append_internal_model(
                    model, specification.internal_model_signals, weight
                )
            side = self.solve_gains(specification, controlled, balls.input, False, rest)
            controllers += side.candidates
            unsolved += side.unsolved
        if not controllers or not observers:
            return None
        feedback = tuple(specification for specification, _ in controllers)
        controller_gains = [solution.k for _, solution in controllers]
        ks = np.stack(controller_gains)
        observing = tuple(specification for specification, _ in observers)
        observer_gains = [solution.k.T for _, solution in observers]
        ls = np.stack(observer_gains)
        injections = stack_neuron_injections(observers)
        return GainCandidates(
            feedback=feedback,
            ks=ks,
            observing=observing,
            ls=ls,
            l_zs=injections,
            internal=self._internal_model(model),
            unsolved=unsolved,
        )

    def _internal_model(self, model: Model) -> Float[np.ndarray, "z z"] | None:
        """State matrix of the controller's internal model at the sampling time of a model; None
        without integral action."""
        if not self.internal_model_signals:
            return None
        outputs = model.scale.outputs
        return internal_model(self.internal_model_signals, model.step_s, outputs)

    def solve_gains(
        self,
        specification: RiccatiSynthesis,
        system: System,
        ball: JacobianBall,
        is_observer: bool,
        slopes_at_equilibrium: Slopes | None = None,
    ) -> SideCandidates:
        """Candidate gains of the controller, or of the observer, at all rates and weights of the
        grid, the slowest rate first.

        A solution at a faster rate holds at a slower one, so the search for that one starts there.
        """
        rates, start = self._rates_below_limit(specification, system, ball, is_observer)
        side = "observer" if is_observer else "controller"
        name = "output_noise" if is_observer else "input_weight"
        weights = self.output_noises if is_observer else self.input_weights
        candidates: list[GainCandidate] = []
        faster: dict[float, Solution] = {}  # by weight
        unsolved = 0
        falling_weights = sorted(weights, reverse=True)
        for rate, weight in product(rates, falling_weights):
            latest = candidates[-1][1] if candidates else start
            near = faster.get(weight, latest)
            settings: dict[str, Any] = {f"rate_{side}": rate, name: weight}
            settings["near"] = {} if near is None else {is_observer: near}
            request = replace(specification, **settings)
            try:
                problem = request.problem(system, ball, is_observer)
                solution = request.solve(problem)
            except NoSolution:
                unsolved += 1
                continue
            faster[weight] = solution
            near_solution = replace(request, near={is_observer: solution})
            candidate = (near_solution, solution)
            candidates.append(candidate)
        if slopes_at_equilibrium is not None and rates:
            slowest = rates[-1]
            candidates += self._solve_at_frozen_slopes(
                specification, system, ball, is_observer, slopes_at_equilibrium, slowest
            )
        slowest_first = candidates[::-1]
        return SideCandidates(slowest_first, unsolved)

    def _rates_below_limit(
        self, specification: RiccatiSynthesis, system: System, ball: JacobianBall, is_observer: bool
    ) -> tuple[list[float], Solution | None]:
        """Contraction rates of the grid below the exact limit of controller or observer, the
        fastest first. A solution from which the search starts is returned, too."""
        own = 0.0  # with neurons the spectral radius proves nothing
        fastest = None
        if isinstance(system, StateSpace):
            state_decay = system.spectral_radius**2
            own = max(1 - state_decay, 0.0)
            side = dual_system(system) if is_observer else system
            frontier = controller_frontier(side, ball)
            limit = frontier.rate_limit
        else:
            from ssm_study.synthesis import structured_lmi  # CVXPY: only where there are neurons

            problem = specification.problem(system, ball, is_observer)
            limit, fastest = structured_lmi.fastest_confirmed_solution(problem)
        linear = isinstance(system, StateSpace)
        rates = self._candidate_rates(is_observer, linear, own, limit)
        below = [rate for rate in rates if 0 < rate < limit]
        return sorted(below, reverse=True), fastest

    def _candidate_rates(
        self, is_observer: bool, is_linear: bool, open_loop_rate: float, rate_limit: float
    ) -> list[float]:
        """Contraction rates to try for the controller or the observer, requested or derived from
        the model. If none is requested they go from half of the model's own to near the limit."""
        requested = self.rate_observer if is_observer else self.rate_controller
        if requested != "auto":
            return [float(requested)]
        rates = [OWN_SHARE * open_loop_rate]
        if is_observer:
            rates += self.observer_rates
        if not (is_observer and is_linear):
            rates += [
                open_loop_rate + share * (rate_limit - open_loop_rate)
                for share in self.stretch_shares
            ]
        return rates

    def _solve_at_frozen_slopes(
        self,
        specification: RiccatiSynthesis,
        system: Any,
        ball: JacobianBall,
        is_observer: bool,
        slopes_at_equilibrium: Slopes,
        rate: float,
    ) -> list[GainCandidate]:
        """Gains designed for linear models in which the slopes of the neurons are constant. They
        are certified for all slopes.

        A cost for the worst slopes guards against what the model may never do; the certificate does
        not need that guard.
        """
        from ssm_study.synthesis.structured_lmi import StructuredLmi

        side_problem = specification.problem(system, ball, is_observer)
        problem = side_problem.at_rate(rate)
        program = StructuredLmi.for_fixed_gains(problem)
        side = "rate_observer" if is_observer else "rate_controller"
        proved_candidates = []
        unit_slopes = np.ones_like(slopes_at_equilibrium)
        for slopes in (slopes_at_equilibrium, HALF_SLOPE * unit_slopes):
            frozen = system.linearise_at_slopes(slopes)
            solved_side = self.solve_gains(specification, frozen, ball, is_observer)
            for request, solution in solved_side.candidates:
                try:
                    proved = program.prove_rate(solution.k)
                except NoSolution:
                    continue
                near = {is_observer: proved}
                settings: dict[str, Any] = {side: rate, "near": near}
                proved_request = replace(request, **settings)
                proved_candidates.append((proved_request, proved))
        return proved_candidates


def equilibrium_slopes(model: Model) -> Slopes | None:
    """Slopes of a model's neurons at the equilibrium; None for a model without neurons."""
    if isinstance(model, SSM) or not model.neurons:
        return None
    return evaluate_activations(model.neurons, model.bias, "slope")


def stack_neuron_injections(observers: list[GainCandidate]) -> Float[np.ndarray, "O q p"] | None:
    """Gains with which several observers feed the output error into the neurons, as one array; None
    if the first observer has none."""
    gains = [solution.k_w for _, solution in observers]
    if gains[0] is None:
        return None
    injections = [k_w.T for k_w in gains if k_w is not None]
    return np.stack(injections)
