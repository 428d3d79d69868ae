"""Gain from the input to the mismatch that a loop with neurons tolerates: a solver, the limit
without neurons, frozen slopes, simulated loops, a forged file."""

import json
from dataclasses import replace
from functools import cache
from itertools import product

import cvxpy as cp
import numpy as np
import pytest
from recorded import assert_as_recorded
from structured_cases import drawn, model

from ssm_study.bounds.frequency import hinf_norm
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.certificates.theorems.measured_discs_structured import StructuredMeasuredDiscs
from ssm_study.robustness.coverage import DiscWeights
from ssm_study.robustness.sensitivity import error_to_input_response
from ssm_study.synthesis.deployed import add_gain_certificates, certificate_at_largest_rate
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_run import INJECTED, uncertifiable_loop_reason
from ssm_study.synthesis.measured_discs_search import INPUT_ALONE, certify_largest_radius
from ssm_study.synthesis.structured_lmi import largest_rate_with_neurons
from ssm_study.systems import Gains, JacobianBall, JacobianBalls, StructuredSystem

BALLS = JacobianBalls(
    input=JacobianBall.from_slopes(0.6, 1.0), output=JacobianBall(alpha=0.8, beta=0.0)
)
ASKED = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1, input_weight=1.0)


class _Model:
    def __init__(self, system: StructuredSystem) -> None:
        slopes = np.zeros(system.neurons)
        state_space = system.linearise_at_slopes(slopes)
        self.system, self.linear = system, state_space


def found(
    system: StructuredSystem, weights: DiscWeights = INPUT_ALONE
) -> tuple[VerificationContext, StructuredMeasuredDiscs]:
    design = ASKED.design(_Model(system), BALLS)
    known = VerificationContext(system=system, controlled=system, balls=BALLS, gains=design.gains)
    proved = certify_largest_radius(known, weights)
    assert isinstance(proved, StructuredMeasuredDiscs)
    assert proved.certified
    return known, proved


@cache
def small_loop(seed: int, h: float) -> tuple[VerificationContext, StructuredMeasuredDiscs]:
    """A loop of three states and two neurons, shared by the tests that look at it."""
    return found(drawn(seed, n=3, q=2, radius=0.9, h=h))


def test_gains_are_certified_just_inside_their_largest_rate() -> None:
    design = ASKED.design(_Model(drawn(0)), BALLS)
    for part in (design.state_feedback, design.observer):
        again = certificate_at_largest_rate(part)
        limit = largest_rate_with_neurons(*part.as_problem())
        assert again.certified
        np.testing.assert_array_equal(again.gain, part.gain)
        largest = max(part.rate, 0.998 * limit)
        assert largest < again.rate < limit


@pytest.mark.parametrize("weight", [np.eye(1), np.array([[0.5, 1.0], [0.2, 1.0]])])
def test_neurons_without_effect_leave_the_tolerance_of_one_layer(weight: np.ndarray) -> None:
    system = drawn(2, n=4, q=3, radius=0.9)
    e = 0 * system.e
    h = 0 * system.h
    still = StructuredSystem(**{**vars(system), "e": e, "h": h})
    weights = replace(INPUT_ALONE, input=weight)
    known, proved = found(still, weights)
    slopes = np.zeros(3)
    linear = still.linearise_at_slopes(slopes)
    names = ("k", "l")
    gains = {name: known.gains[name] for name in names}
    context = VerificationContext(system=linear, controlled=linear, balls=BALLS, gains=gains)
    other = certify_largest_radius(context, weights)
    assert other is not None
    expected = pytest.approx(other.kappa, rel=2e-4)
    assert proved.kappa == expected


def unknown_rows(*sizes: int) -> list[np.ndarray]:
    """Rows that pick each unknown out of all of them, stacked."""
    return np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])


@pytest.mark.parametrize(("seed", "h"), [(0, 0.0), (2, 0.0), (0, 0.3)])
def test_a_solver_finds_the_same_gain(seed: int, h: float) -> None:
    """One semidefinite program for P and every multiplier, its rows written out anew; the search
    knows no P."""
    known, proved = small_loop(seed, h)
    system = known.system
    k, l, l_z = (known.gains[name] for name in ("k", "l", "l_z"))  # noqa: E741
    x, eps, p, e, w, d = unknown_rows(3, 3, 1, 1, 2, 2)
    u = k @ (x + eps)
    v = 0.8 * u + p
    injected = 0.8 * (system.c @ eps + system.h @ d) - e
    step = np.vstack(
        [system.a @ x + system.b @ v + system.e @ w, system.a @ eps + system.e @ d + l @ injected]
    )
    z = system.f @ x + system.g @ v
    dz = system.f @ eps + l_z @ injected
    xi = np.vstack([x, eps])
    metric = cp.Variable((6, 6), symmetric=True)
    squared_gain = cp.Variable()
    of_ball = cp.Variable(nonneg=True)
    form = xi.T @ metric @ xi - step.T @ metric @ step + e.T @ e - squared_gain * (u.T @ u)
    form += of_ball * (p.T @ p - 0.04 * u.T @ u)
    for output, entering in ((w, z), (d, dz), (w + d, z + dz)):
        weights = cp.Variable(2, nonneg=True)
        sector = output.T @ cp.diag(weights) @ (output - entering)
        form += sector + sector.T
    cp.Problem(cp.Maximize(squared_gain), [form >> 0]).solve(solver="CLARABEL")
    expected = pytest.approx(float(np.sqrt(squared_gain.value)), rel=5e-3)
    assert proved.tolerated_gain == expected


@pytest.mark.parametrize(("seed", "h"), [(0, 0.0), (0, 0.3), (2, 0.0)])
def test_frozen_slopes_lose_the_loop_above_and_never_below(seed: int, h: float) -> None:
    """Both sets of neurons frozen alike: small gain at each corner; and what is stored is refused
    above it."""
    known, proved = small_loop(seed, h)
    system = known.system
    names = ("k", "l", "l_z")
    k, l, l_z = (known.gains[name] for name in names)  # noqa: E741
    peaks = []
    for slopes in system.slope_corners():
        injected = l + (system.e * slopes) @ l_z
        for slope in (0.6, 0.8, 1.0):
            linear = system.linearise_at_slopes(slopes)
            pair = Gains(k=k, l=injected)
            state_space = error_to_input_response(linear, pair, slope, 0.8)
            peaks.append(hinf_norm(state_space))
    upper_limit = proved.kappa * max(peaks)
    assert 0.2 < upper_limit <= 1
    kappa = 1.001 / max(peaks)
    assert not StructuredMeasuredDiscs.holds(**(proved.variables | {"kappa": kappa}))


def energy(proved: StructuredMeasuredDiscs, x: np.ndarray, x_hat: np.ndarray) -> float:
    """The storage function of the proof: `x' P_11 x + (x_hat - x)' P_22 (x_hat - x)`."""
    error = x_hat - x
    return float(x @ proved.p[:3, :3] @ x + error @ proved.p[3:, 3:] @ error)


def test_no_simulated_mismatch_below_it_keeps_the_loop_from_rest() -> None:
    """The real neurons, S_u of changing slope, and `e` of the allowed energy, placed where it
    raises P most."""
    stand = model()
    system = stand.system
    output = JacobianBall(alpha=1.0, beta=0.0)
    balls = JacobianBalls(input=BALLS.input, output=output)
    gains = ASKED.design(stand, balls).gains
    context = VerificationContext(system=system, controlled=system, balls=balls, gains=gains)
    proved = certify_largest_radius(context)
    assert isinstance(proved, StructuredMeasuredDiscs)
    rng = np.random.default_rng(0)
    k = proved.k
    l = proved.l  # noqa: E741
    l_z = proved.l_z
    for _ in range(2):
        x, x_hat = rng.normal(size=(2, 3))
        start = np.linalg.norm(x)
        budget = 0.0
        for _ in range(60):
            u = k @ x_hat
            # saved energy may be spent later: gain in mean square alone
            budget += proved.kappa**2 * float(u @ u)
            after = []
            for share, sign, slope in product((0, 0.5, 1), (-1, 1), (0.6, 1.0)):
                e = sign * np.sqrt(share * budget)
                v = slope * u
                error = x_hat @ stand.c.T - (x @ stand.c.T + e)
                estimate = stand.next_state(x_hat, v, error @ l_z.T) + l @ error
                after.append((stand.next_state(x, v), estimate, e * e))
            energies = [energy(proved, *states) for *states, _ in after]
            x, x_hat, spent = after[int(np.argmax(energies))]
            budget = budget - spent
        norm = np.linalg.norm(x)
        assert norm < 1e-3 * start


@pytest.fixture(scope="module", params=[False, True])
def stored(request: pytest.FixtureRequest) -> tuple[dict, object]:
    stand = model()
    internal_model = ["step"] if request.param else []
    asked = replace(ASKED, internal_model=internal_model)
    balls = certified_balls(stand)
    design = asked.design(stand, balls)
    whole = add_gain_certificates(design, stand, balls)
    assert "tolerance" in whole.extra_certificates
    text = json.dumps(whole.to_json())
    content = json.loads(text)
    system = controlled_system(stand, whole.state_feedback)
    return content, system


def broken(content: dict, controlled: object) -> list[str]:
    system = model().system
    balls = certified_balls(model())
    return failed_checks(content, system, balls, controlled)


def test_it_is_stored_and_verified_from_the_file(stored: tuple[dict, object]) -> None:
    assert broken(*stored) == []
    design = Design.from_json(stored[0])
    text = json.dumps(design.to_json())
    content = json.loads(text)
    assert content == stored[0]


def test_an_observer_that_injects_into_neurons_of_the_output_is_excluded(stored):
    design = Design.from_json(stored[0])
    assert design.observer.l_z.any()
    stand = model()
    assert uncertifiable_loop_reason(design, stand) is None
    seen = np.ones_like(stand.h)
    seeing = replace(stand, h=seen)
    assert uncertifiable_loop_reason(design, seeing) == INJECTED


def test_a_nonlinear_output_map_costs_some_of_it() -> None:
    known, straight = found(drawn(0, n=2, q=1, radius=0.9))
    output = JacobianBall.from_slopes(0.7, 0.9)
    bent = JacobianBalls(input=BALLS.input, output=output)
    context = replace(known, balls=bent)
    proved = certify_largest_radius(context)
    assert proved is not None
    assert len(proved.lambda_out) == 3
    assert 0 < proved.kappa < straight.kappa
    sentences = straight.failed_checks(context)
    assert any("beta_out" in sentence for sentence in sentences)


def test_a_loop_that_some_slope_loses_by_itself_gets_none() -> None:
    """At rest and at slope one half `x+ = 0.2 x + 2 phi(x) - 0.25 x` decays, at slope one it
    grows."""
    one = np.ones((1, 1))
    unit = JacobianBall(alpha=1.0, beta=0.0)
    matrices = {
        "a": 0.2 * one,
        "b": one,
        "c": one,
        "d": 0 * one,
        "e": 2 * one,
        "f": one,
        "g": 0 * one,
        "h": 0 * one,
    }
    system = StructuredSystem(**matrices)
    gains = {"k": -0.25 * one, "l": -0.5 * one, "l_z": 0 * one}
    balls = JacobianBalls(input=unit, output=unit)
    known = VerificationContext(system=system, controlled=system, balls=balls, gains=gains)
    assert certify_largest_radius(known) is None


def test_the_design_has_the_recorded_numbers(
    stored: tuple[dict, object], request: pytest.FixtureRequest
) -> None:
    kind = request.node.callspec.params["stored"]
    sides = [stored[0]["state_feedback"], stored[0]["observer"]]
    assert_as_recorded(f"tolerated_gain_{kind}", sides, 1e-3)
