"""Sampled plants at the edge of a covered disc: does any of them keep the loop moving?

    python benchmarks/coverage_samples.py RUN --samples 3000      one run's certificate
    python benchmarks/coverage_samples.py --models 1000           random models of one layer

Each sample is a plant `y = m + e` with `e = c m + s kappa (Q_1 floor m + Q_2 W m + Q_3 V u)`:
`(Q_1, Q_2, Q_3)` all-passes, each times a share, the shares on the unit sphere, so that e lies on
the disc's edge at every frequency; slopes of S_u fixed at an end of the ball, or drawn anew at
every sample; neurons are true static maps, the same in plant and observer. A loop that has not
shrunk to `SETTLED` of its largest input within the horizon counts as lost. The proof claims no
rate, and a plant at the very edge may come to rest as slowly as one likes: at the proved kappa
(s = 1) those that are left run on to `LONG_HORIZON`. The seeds are fixed. The same plants are taken
at `BEYOND` times as far out: some of them must be lost, or the samples show nothing.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import finished_results
from jaxtyping import Float

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, StateFeedback
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.models.identified import SSM
from ssm_study.models.stored import model_from_json
from ssm_study.robustness.coverage import DiscWeights
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_search import certify_largest_radius
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace

SETTLED = 1e-2
BEYOND = 1.5
HORIZON = 3000  # samples
LONG_HORIZON = 30_000  # samples, for loops at the disc's edge that are still on their way
FIRST_ORDER = DiscWeights(
    floor=0.5, output=np.array([[0.7, 1.0], [0.1, 0.4]]), input=np.array([[0.5, 1.0], [0.02, 0.1]])
)


@dataclass(frozen=True, kw_only=True)
class EdgeLoops:
    """Loops of one input and one output on N plants at the edge of one certificate's disc."""

    proof: MeasuredDiscs
    known: VerificationContext

    def lost(self, samples: int, seed: int, distance: float) -> int:
        """How many of the loops have not come to rest within the horizon."""
        lost = self.lost_within(HORIZON, samples, seed, distance)
        if lost and distance <= 1.0:
            lost = self.lost_within(LONG_HORIZON, samples, seed, distance)
        return lost

    def lost_within(self, horizon: int, samples: int, seed: int, distance: float) -> int:
        """How many of the loops have not come to rest within a given number of samples."""
        inputs = self.inputs(horizon, samples, np.random.default_rng(seed), distance)
        sizes = np.abs(inputs)
        largest = np.nanmax(sizes, axis=0)
        last = sizes[-horizon // 20 :].max(axis=0)
        return int(np.sum(~(last < SETTLED * largest)))

    def inputs(
        self, horizon: int, samples: int, rng: np.random.Generator, distance: float
    ) -> Float[np.ndarray, "T N"]:
        """The inputs of all loops, from random starts."""
        proof = self.proof
        system = self.known.controlled
        gains = self.known.gains
        observed = self.known.system
        order = self.known.system.order
        ball = self.known.balls.input
        ends = np.array([ball.lower, ball.upper])
        varies = rng.random(samples) < 0.5
        fixed = rng.choice(ends, samples)
        shares = rng.standard_normal((3, samples))
        shares *= distance * proof.kappa / np.linalg.norm(shares, axis=0)
        poles = rng.uniform(-0.98, 0.98, (3, samples))
        x = rng.standard_normal((system.order, samples))
        estimate = rng.standard_normal((order, samples))
        filters = [proof.weight_output, proof.weight_input]
        states = [np.zeros((len(weight) - 1, samples)) for weight in filters]
        passes = np.zeros((3, samples))
        neurons = getattr(observed, "e", np.zeros((order, 0))).shape[1]
        maps = rng.integers(0, 3, (neurons, samples))
        inputs = np.empty((horizon, samples))
        for k in range(horizon):
            u = gains["k"][:, :order] @ estimate + gains["k"][:, order:] @ x[order:]
            slope = np.where(varies, rng.choice(ends, samples), fixed)
            drive = slope * u
            w = self._neurons(x[:order], drive, maps, None)
            m = proof.alpha_out * (observed.c @ x[:order] + observed.d @ drive)
            m = m + proof.alpha_out * self._at_output(w)
            entering = [proof.floor * m]
            for i, (weight, signal) in enumerate(zip(filters, (m, u), strict=True)):
                size = len(weight) - 1
                entering.append(weight[size:, :size] @ states[i] + weight[size:, size:] * signal)
                states[i] = weight[:size, :size] @ states[i] + weight[:size, size:] @ signal
            driven = np.concatenate(entering)
            passed = passes - poles * driven
            passes = poles * passes + (1 - poles**2) * driven
            e = proof.centre * m + (shares * passed).sum(axis=0, keepdims=True)
            injected = proof.alpha_out * (observed.c @ (estimate - x[:order]))
            wh = np.zeros_like(w)
            if neurons:
                injected = injected - e if not observed.h.any() else injected
                wh = self._neurons(estimate, drive, maps, injected)
            read = proof.alpha_out * (observed.c @ estimate + observed.d @ drive)
            read = read + proof.alpha_out * self._at_output(wh)
            correction = gains["l"] @ (read - m - e)
            forward = system.a @ x + system.b @ drive
            estimate = system.a[:order, :order] @ estimate + system.b[:order] @ drive + correction
            if neurons:
                forward = forward + system.e @ w
                estimate = estimate + system.e[:order] @ wh
            forward[order:] += e
            x = forward
            inputs[k] = u[0]
        return inputs

    def _at_output(self, w: Float[np.ndarray, "q N"]) -> Any:
        return self.known.system.h @ w if len(w) else 0.0

    def _neurons(
        self, x: Float[np.ndarray, "n N"], drive: Float[np.ndarray, "m N"], maps: Any, injected: Any
    ) -> Float[np.ndarray, "q N"]:
        if not len(maps):
            return np.zeros((0, x.shape[1]))
        z = self.known.system.f @ x + self.known.system.g @ drive
        if injected is not None and not self.known.system.h.any():
            z = z + self.known.gains["l_z"] @ injected
        return np.where(maps == 0, np.tanh(z), np.where(maps == 1, np.clip(z, -0.5, 0.5), z))


def of_run(run: Path) -> EdgeLoops:
    """The certificate of a run; exits where it has none."""
    model = model_from_json(json.loads((run / "model.json").read_text()))
    design = Design.load(run / "certificate.json")
    proof = design.extra_certificates.get("coverage")
    if not isinstance(proof, MeasuredDiscs) or not isinstance(design.state_feedback, StateFeedback):
        raise SystemExit(f"{run} has no certificate of coverage")
    known = VerificationContext(
        system=model.system,  # type: ignore[attr-defined]  # an SSM or StructuredSSM
        controlled=controlled_system(model, design.state_feedback),
        balls=certified_balls(model),
        gains=design.gains,
    )
    return EdgeLoops(proof=proof, known=known)


def of_random_model(seed: int) -> EdgeLoops | None:
    """A random model of order 2 to 4 with a certified pair of gains and a certified kappa; None
    without one."""
    rng = np.random.default_rng(seed)
    order = int(rng.integers(2, 5))
    a = rng.normal(size=(order, order))
    linear = StateSpace(
        a=rng.uniform(0.6, 0.97) * a / np.abs(np.linalg.eigvals(a)).max(),
        b=rng.normal(size=(order, 1)),
        c=rng.normal(size=(1, order)),
        d=np.zeros((1, 1)),
    )
    lower = float(rng.uniform(0.4, 0.9))
    unit = JacobianBall(alpha=1.0, beta=0.0)
    balls = JacobianBalls(input=JacobianBall.from_slopes(lower, 1.0), output=unit)
    weight = float(10 ** rng.uniform(-2, 1))
    asked = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.2, input_weight=weight)
    design = asked.design(SSM.from_linear(linear, 0.01), balls)
    if not design.certified:
        return None
    known = VerificationContext(system=linear, controlled=linear, balls=balls, gains=design.gains)
    centre = float(rng.choice([0.0, -0.1, -0.25]))
    proof = certify_largest_radius(known, FIRST_ORDER, centre)
    return None if proof is None else EdgeLoops(proof=proof, known=known)


def lost_loops_of_model(seed: int) -> tuple[int, int, int]:
    """Whether a random model has a certified kappa (1 or 0), and how many of its ten loops are lost
    at the disc's edge and far beyond it."""
    found = of_random_model(seed)
    if found is None:
        return 0, 0, 0
    return 1, found.lost(10, seed, 1.0), found.lost(10, seed, 2 * BEYOND)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("--samples", type=int, default=3000)
    parser.add_argument("--models", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="seed of the first random model")
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    if asked.run is not None:
        loops = of_run(asked.run)
        for distance in (1.0, BEYOND, 2 * BEYOND):
            lost = loops.lost(asked.samples, 0, distance)
            print(
                f"{distance:g} times the proved kappa: {lost} of {asked.samples} lost", flush=True
            )
    seeds = range(asked.first, asked.first + asked.models)
    sums = np.zeros(3, dtype=int)
    results = finished_results(lost_loops_of_model, seeds, asked.jobs)
    for tried, counts in enumerate(results, start=1):
        sums += counts
        if tried % 50 == 0 or tried == asked.models:
            certified, lost, beyond = sums
            print(
                f"{certified} of {tried} models certified, {10 * certified} loops: {lost} lost; "
                f"{2 * BEYOND:g} times as far out: {beyond} lost",
                flush=True,
            )


if __name__ == "__main__":
    main()
