"""Rates and weights chosen from the model and the records alone: the certified design of the best
expected response.

    P area + (1 - P) LOSS,        P = Phi(ln(margin) / spread)

The mismatch is not a number but a sample: the fastest design that just passes is the one that any
optimism of g lets
through. Nothing of the closed-loop test enters. Source: docs/closed_loop.md, "Rates chosen for
you"; docs/theory.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, product
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from ssm_study.certificates.certificate import Design
from ssm_study.certificates.frontier import controller_frontier
from ssm_study.certificates.problem import NoSolution, Solution, dual
from ssm_study.certificates.theorems.integral_action import frequencies, internal_model, with_modes
from ssm_study.models.identified import SSM
from ssm_study.models.structured import Model, phi
from ssm_study.refusal import positive, require
from ssm_study.robustness.coverage import Premise
from ssm_study.robustness.mismatch import Mismatch, measure_mismatch
from ssm_study.robustness.prediction import noise_peak, predict, robustness_measure
from ssm_study.robustness.sensitivity import (
    FINE_ANGLES,
    Responses,
    controller_radius,
    peaks_on_grid,
)
from ssm_study.signals import Ends, Trajectories
from ssm_study.synthesis.candidates import Candidates, GainCandidate
from ssm_study.synthesis.design import Synthesis, contraction_rate
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.input_inversion import designed
from ssm_study.synthesis.integrated_error import relative_areas
from ssm_study.synthesis.measured_discs_choice import prefer_covered
from ssm_study.systems import Balls, JacobianBall, StateSpace, System

# Frequencies (rad/sample) that rank the candidates; the chosen one is then judged on a finer grid.
GRID_ANGLES = np.geomspace(1e-3, np.pi, 240)
ATTEMPTS = 20  # how many candidates are verified exactly before the search gives up: each costs two exact certificates
LOOKED_AT = 200  # how many candidates are compared with all that the records show: the fastest, and of the rest as many
OWN_SHARE = (
    0.5  # of the rate that a model has by itself: the most cautious request, whose gain may vanish
)
STATE_WEIGHT = 1e-6  # of the gains' cost, beside `|C x|^2`
WEIGHTS = (1e-5, 1e-4, 1e-3, 1e-2)  # of an internal model's states, where none are given
LOSS = 10.0  # area of a design that fails on the plant, in areas of the plant left alone
Slopes = Float[np.ndarray, "q"]
LEAST_SPREAD = 0.1  # no record is known better than this: a twentieth of it is what Welch's estimate alone scatters by


@dataclass(frozen=True, kw_only=True)
class Auto:
    """The best expected response of a certified design whose resolved mismatch margin exceeds
    `margin`.

    Grids, steps and the choice where no candidate passes: docs/closed_loop.md, "Rates chosen for
    you". With an
    `internal_model` (`step`, `ramp`, `sine(0.5Hz)`) the weights of its states are one more axis;
    weights alone are of
    integrators. `limits` of the input, scaled, are set by the run.
    With `invert_input` the law undoes the input map (`synthesis.commanded`), and `shown` is
    relative to its commands.
    """

    rate: float | str = "auto"
    rate_controller: float | str = "auto"
    rate_observer: float | str = "auto"
    margin: float = 1.0
    stretch_shares: Sequence[float] = (0.05, 0.3, 0.6, 0.9)
    observer_rates: Sequence[float] = (0.1, 0.2, 0.3, 0.4, 0.5)  # absolute: the limit is far
    input_weights: Sequence[float] = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    output_noises: Sequence[float] = (1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0, 100.0)
    integral_weights: Sequence[float] = ()
    internal_model: Sequence[str] = ()
    limits: Ends | None = None
    invert_input: bool = False
    cover: float | None = None
    premise: Premise | None = None

    method: ClassVar[str] = "auto"

    def __post_init__(self) -> None:
        for name in ("rate", "rate_controller", "rate_observer"):
            rate = getattr(self, name)
            if rate != "auto":
                contraction_rate(f"synthesis.{name}", rate, 'use "auto" or a number such as 0.1')
        require(
            self.margin > 0, "synthesis.margin", self.margin, "the margin must be positive", "use 1"
        )
        for name in (
            "stretch_shares",
            "observer_rates",
            "input_weights",
            "output_noises",
            "integral_weights",
        ):
            grid, shares = getattr(self, name), name in ("stretch_shares", "observer_rates")
            fits = len(grid) > 0 or name == "integral_weights"
            fits = fits and all(0 < value < (1 if shares else np.inf) for value in grid)
            told = "numbers in (0, 1)" if shares else "positive numbers"
            require(fits, f"synthesis.{name}", grid, f"must hold {told}", "keep the default grid")
        frequencies(self.internal_model)
        if self.cover is not None:
            positive("synthesis.cover", self.cover, "use 1, or 1.5 for more")

    @property
    def modes(self) -> tuple[str, ...]:
        """The internal model's words."""
        return tuple(self.internal_model) or ("step",) * bool(self.integral_weights)

    def design(
        self,
        model: Model,
        balls: Balls,
        validation: Trajectories = (),
        shown: Mismatch | None = None,
    ) -> Design:
        """The chosen controller and observer, exactly verified; infeasible as the Riccati route
        reports it.

        The mismatch `shown` is that of the validation records unless given.
        """
        if self.invert_input:
            return designed(replace(self, invert_input=False), model, validation, shown)
        candidates = self.candidates(model, balls)
        if candidates is None:
            return self._reported(self._slowest(model, balls), "nothing on the grid is feasible")
        left_out = (
            f" ({candidates.unsolved} of the grid have no solution)" if candidates.unsolved else ""
        )
        shown = shown or measure_mismatch(model, validation)
        weights, ks, ls = shown.at(GRID_ANGLES), candidates.ks, candidates.ls
        peaks = peaks_on_grid(
            model.system, ks, ls, balls, GRID_ANGLES, weights, candidates.l_zs, candidates.internal
        )

        def certified_and_predicted(pair: Int[np.ndarray, "2"]) -> Design | None:
            made = candidates.specification(pair).design(model, balls)
            if not made.certified:
                return None
            predicted = predict(model, made.pair, balls, shown)
            return made if predicted.predicts_stability(self.margin) else None

        pairs = self._in_order(model, candidates, balls, peaks, validation, shown)
        if self.premise is None or not (self.cover or isinstance(model, SSM)):
            pairs = islice(pairs, ATTEMPTS)
        chosen, status = prefer_covered(
            pairs, certified_and_predicted, model, balls, self.premise, self.cover
        )
        if chosen is not None:
            return self._reported(chosen, status + left_out)
        best = np.array(np.unravel_index(np.argmin(peaks), peaks.shape))
        design = candidates.specification(best).design(model, balls)
        status = f"no stable controller with margin above {self.margin:g}; largest margin taken"
        if np.isinf(self.margin):
            status = "the evidence allows no judgement of the plant; largest margin taken"
        return self._reported(design, status + left_out)

    def within(self, lower: Float[np.ndarray, "m"], upper: Float[np.ndarray, "m"]) -> "Auto":
        """The same, responses scored with the input cut at these scaled deviations, where they
        leave room at rest."""
        return (
            replace(self, limits=(lower, upper))
            if (lower < 0).all() and (upper > 0).all()
            else self
        )

    def covering(self, premise: Premise) -> "Auto":
        """The same, preferring designs whose proof covers what these records show."""
        return replace(self, premise=premise)

    def cautious(self) -> "Auto":
        """The same grids, from which the largest margin is taken."""
        return replace(self, margin=float("inf"))

    def candidates(self, model: Model, balls: Balls) -> Candidates | None:
        """Every gain of the grids that the Riccati equation gives; None if one side has none."""
        if any(abs(ball.alpha) <= ball.beta for ball in (balls.input, balls.output)):
            return None
        rest = None
        if not isinstance(model, SSM) and model.neurons:
            rest = phi(model.neurons, model.bias, "slope")
        specifications, feedback = self._specifications(), list[GainCandidate]()
        observing, unsolved = self._solved(
            specifications[0], model.system, balls.output, True, rest
        )
        for asked in specifications:
            controlled = (
                with_modes(model, asked.modes, asked.integral_weight)
                if asked.modes
                else model.system
            )
            found, without = self._solved(asked, controlled, balls.input, False, rest)
            feedback, unsolved = feedback + found, unsolved + without
        if not feedback or not observing:
            return None
        injected = [found.k_w for _, found in observing]
        return Candidates(
            feedback=tuple(specification for specification, _ in feedback),
            ks=np.stack([found.k for _, found in feedback]),
            unsolved=unsolved,
            observing=tuple(specification for specification, _ in observing),
            ls=np.stack([found.k.T for _, found in observing]),
            l_zs=None
            if injected[0] is None
            else np.stack([k_w.T for k_w in injected if k_w is not None]),
            internal=internal_model(self.modes, model.step_s, model.scale.outputs)
            if self.modes
            else None,
        )

    def _solved(
        self,
        asked: RiccatiSynthesis,
        system: System,
        ball: JacobianBall,
        observes: bool,
        rest: Slopes | None = None,
    ) -> tuple[list[GainCandidate], int]:
        """What the grid of one side gives, and how many of its requests have no solution (or none
        that floats hold)."""
        side, linear = "observer" if observes else "controller", isinstance(system, StateSpace)
        # what the system does by itself; its radius proves nothing where there are neurons
        own = max(1 - system.spectral_radius**2, 0.0) if isinstance(system, StateSpace) else 0.0
        fastest = None
        if linear:
            limit = controller_frontier(dual(system) if observes else system, ball).rate_limit
        else:  # the best that the inequality reaches
            from ssm_study.synthesis import structured_lmi  # CVXPY: only where there are neurons

            limit, fastest = structured_lmi.fastest(asked.problem(system, ball, observes))
        weight, weights = (
            ("output_noise", self.output_noises)
            if observes
            else ("input_weight", self.input_weights)
        )
        found: list[GainCandidate] = []
        near: dict[
            float, Solution
        ] = {}  # by weight, of a faster rate: it holds, so a search may start there
        unsolved = 0
        down = sorted(
            (rate for rate in self._rates(observes, linear, own, limit) if 0 < rate < limit),
            reverse=True,
        )
        for rate, value in product(down, sorted(weights, reverse=True)):
            start = near.get(value, found[-1][1] if found else fastest)
            chosen: Any = {
                f"rate_{side}": rate,
                weight: value,
                "near": {} if start is None else {observes: start},
            }
            specification = replace(asked, **chosen)
            try:
                near[value] = specification.solve(specification.problem(system, ball, observes))
                found.append((replace(specification, near={observes: near[value]}), near[value]))
            except NoSolution:
                unsolved += 1
        if rest is not None and down:
            found += self._frozen(asked, system, ball, observes, rest, down[-1])
        return found[::-1], unsolved

    def _rates(self, observes: bool, linear: bool, own: float, limit: float) -> list[float]:
        """The grid of one side, from half of what the system does by itself to near the limit; or
        the one asked for."""
        asked = self._asked(self.rate_observer if observes else self.rate_controller)
        if asked != "auto":
            return [float(asked)]
        rates = [OWN_SHARE * own, *(self.observer_rates if observes else ())]
        return rates + (
            []
            if observes and linear
            else [own + share * (limit - own) for share in self.stretch_shares]
        )

    def _frozen(
        self,
        asked: RiccatiSynthesis,
        system: Any,
        ball: JacobianBall,
        observes: bool,
        rest: Slopes,
        rate: float,
    ) -> list[GainCandidate]:
        """Gains as of one layer, the neurons' slopes frozen at rest or half way: those proved for
        every slope.

        A cost for the worst slopes guards against what the model may never do; the certificate does
        not ask for it.
        """
        from ssm_study.synthesis.structured_lmi import StructuredLmi

        program = StructuredLmi.of_gains(asked.problem(system, ball, observes).at(rate))
        kept, side = [], "rate_observer" if observes else "rate_controller"
        slopes_at = rest, 0.5 * np.ones_like(rest)
        frozen = (self._solved(asked, system.at_slopes(at), ball, observes)[0] for at in slopes_at)
        for made, found in chain.from_iterable(frozen):
            try:
                proved = program.proved(found.k)
            except NoSolution:
                continue
            told: Any = {side: rate, "near": {observes: proved}}
            kept.append((replace(made, **told), proved))
        return kept

    def _asked(self, own: float | str) -> float | str:
        return self.rate if own == "auto" else own

    def _specifications(self) -> list[RiccatiSynthesis]:
        """What the grids are laid over: one for each weight of the internal model."""
        asked: Any = {"rate_controller": 0.5, "rate_observer": 0.5, "internal_model": self.modes}
        weights = (self.integral_weights or WEIGHTS) if self.modes else WEIGHTS[:1]
        return [
            RiccatiSynthesis(**asked, state_weight=STATE_WEIGHT, integral_weight=weight)
            for weight in weights
        ]

    def _in_order(
        self,
        model: Model,
        candidates: Candidates,
        balls: Balls,
        peaks: Float[np.ndarray, "C O"],
        validation: Trajectories,
        shown: Mismatch,
    ) -> Iterator[Int[np.ndarray, "2"]]:
        """Pairs that pass, the best expected response first.

        An expected area is never below the area, so the search ends where the areas exceed the
        expected ones found,
        and goes on only where none of those is taken (the gains of a verified design may differ
        from its candidate's).
        """
        if np.isinf(self.margin):  # no pair has it (and times a peak of zero it is no number)
            return
        pairs = np.argwhere(self.margin * peaks < 1)
        gains = candidates.gains(pairs)
        pairs = pairs[controller_radius(model.system, gains, balls) < 1]
        if not len(pairs) or not shown.rests:
            return
        areas = relative_areas(model, candidates.gains(pairs), validation, self.limits)
        coarse, fine = Responses(angles=FINE_ANGLES[::2]), Responses(angles=FINE_ANGLES)
        scored: list[tuple[float, int]] = []

        def expected(index: int, shared: Responses) -> tuple[float, float]:
            number = robustness_measure(
                model, candidates.gains(pairs[index]), balls, shown, shared, 1 / self.margin
            )
            return expected_area(float(areas[index]), number, shown.spread), number

        order = np.argsort(areas, kind="stable")
        left = [
            *order[:LOOKED_AT].tolist(),
            *order[LOOKED_AT :: max(len(order) // LOOKED_AT, 1)].tolist(),
        ]
        while left or scored:
            while left and not (scored and areas[left[0]] >= min(scored)[0]):
                score, number = expected(index := left.pop(0), coarse)
                if (
                    self.margin * number < 1
                    and noise_peak(model, candidates.gains(pairs[index]), balls, shown) < 1
                ):
                    scored.append((score, index))
            # between two frequencies of the coarser grid a loop may come nearer to its limit
            scored.sort()
            yield from (
                pairs[i] for _, i in sorted((expected(i, fine)[0], i) for _, i in scored[:ATTEMPTS])
            )
            del scored[:ATTEMPTS]

    def _slowest(self, model: Model, balls: Balls) -> Design:
        """What the Riccati route says at the least demanding request, as the reason to report."""
        asked: Any = {"rate_controller": self.rate_controller, "rate_observer": self.rate_observer}
        for side, own in asked.items():
            rate = self._asked(own)
            asked[side] = 1e-3 if rate == "auto" else rate
        return replace(self._specifications()[0], **asked).design(model, balls)

    def _reported(self, design: Design, status: str) -> Design:
        """The parts under this method's name, with what the search found."""
        feedback, observer = design.state_feedback, design.observer
        return Design(
            state_feedback=replace(
                feedback, method=self.method, solver_status=f"{status}; {feedback.solver_status}"
            ),
            observer=replace(
                observer, method=self.method, solver_status=f"{status}; {observer.solver_status}"
            ),
        )


def expected_area(area: float, number: float, spread: float) -> float:
    """`P area + (1 - P) LOSS`, `P = Phi(-ln(number) / spread)`: `number` is the inverse of the
    margin."""
    from scipy.special import ndtr  # here: what only reads a study does without

    kept = float(ndtr(-np.log(max(number, np.finfo(float).tiny)) / max(spread, LEAST_SPREAD)))
    return kept * area + (1 - kept) * LOSS


Synthesis.register(
    Auto
)  # same `design`; but it has grids where a Synthesis has one rate and one weight each
