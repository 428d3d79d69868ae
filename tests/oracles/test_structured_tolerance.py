"""Mismatch tolerated by a model with neurons: the limit without them, frozen slopes, simulated
loops, a forged file."""

import json
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
from structured_cases import drawn, model

from ssm_study.bounds.frequency import hinf_norm
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design, certificate_digest
from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.integral_action import controlled_system
from ssm_study.certificates.theorems.structured_tolerance import StructuredTolerance
from ssm_study.certificates.theorems.tolerance import largest_tolerance as without_neurons
from ssm_study.robustness.sensitivity import sensitivity
from ssm_study.synthesis.deployed import at_largest_rate, none_if_unsolved, with_gain_certificates
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.structured_lmi import largest_rate
from ssm_study.systems import Balls, Gains, JacobianBall, StructuredSystem

BALLS = Balls(input=JacobianBall.from_slopes(0.6, 1.0), output=JacobianBall(alpha=0.8, beta=0.0))
largest_tolerance = partial(without_neurons, theorem=StructuredTolerance)
ASKED = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1, input_weight=1.0)


class _Model:
    def __init__(self, system: StructuredSystem) -> None:
        slopes = np.zeros(system.neurons)
        state_space = system.linearise_at_slopes(slopes)
        self.system, self.linear = system, state_space


def found(
    system: StructuredSystem, weight: np.ndarray | None = None
) -> tuple[VerificationContext, StructuredTolerance]:
    design = ASKED.design(_Model(system), BALLS)
    known = VerificationContext(system=system, controlled=system, balls=BALLS, gains=design.gains)
    proved = largest_tolerance(known, np.eye(1) if weight is None else weight)
    assert proved is not None
    assert proved.certified
    return known, proved


def test_gains_are_certified_just_inside_their_largest_rate() -> None:
    design = ASKED.design(_Model(drawn(0)), BALLS)
    for part in (design.state_feedback, design.observer):
        again = at_largest_rate(part)
        limit = largest_rate(*part.as_problem())
        assert again.certified
        np.testing.assert_array_equal(again.gain, part.gain)
        largest = max(part.rate, 0.998 * limit)
        assert largest < again.rate < limit


@pytest.mark.parametrize("weight", [np.eye(1), np.array([[0.5, 1.0], [0.2, 1.0]])])
def test_neurons_without_effect_leave_the_tolerance_of_one_layer(weight: np.ndarray) -> None:
    """The tolerance is found by two routes that share no line: a semidefinite program, and a
    Riccati equation with a search."""
    system = drawn(2, n=4, q=3, radius=0.9)
    e = 0 * system.e
    h = 0 * system.h
    still = StructuredSystem(**{**vars(system), "e": e, "h": h})
    known, proved = found(still, weight)
    slopes = np.zeros(3)
    linear = still.linearise_at_slopes(slopes)
    names = ("k", "l")
    gains = {name: known.gains[name] for name in names}
    verification_context = VerificationContext(
        system=linear, controlled=linear, balls=BALLS, gains=gains
    )
    other = without_neurons(verification_context, weight)
    assert other is not None
    assert proved.s == pytest.approx(other.s, rel=2e-4)


@pytest.mark.parametrize(("seed", "h"), [(0, 0.0), (0, 0.3), (2, 0.0)])
def test_frozen_slopes_lose_the_loop_above_and_never_below(seed: int, h: float) -> None:
    """Both sets of neurons frozen alike: small gain at each corner; and what is stored is refused
    above it."""
    system = drawn(seed, n=4, q=3, radius=0.9, h=h)
    known, proved = found(system)
    names = ("k", "l", "l_z")
    k, l, l_z = (known.gains[name] for name in names)  # noqa: E741
    peaks = []
    for slopes in system.corners():
        injected = l + (system.e * slopes) @ l_z
        for slope in (0.6, 0.8, 1.0):
            linear = system.linearise_at_slopes(slopes)
            pair = Gains(k=k, l=injected)
            state_space = sensitivity(linear, pair, slope, 0.8)
            peaks.append(hinf_norm(state_space))
    upper_limit = proved.s * max(peaks)
    assert 0.2 < upper_limit <= 1
    s = 1.001 / max(peaks)
    assert not StructuredTolerance.holds(**(proved.variables | {"s": s}))


def energy(proved: StructuredTolerance, x: np.ndarray, x_hat: np.ndarray) -> float:
    """The storage function of the proof: `x' P_11 x + (x_hat - x)' P_22 (x_hat - x)`."""
    error = x_hat - x
    return float(x @ proved.p[:3, :3] @ x + error @ proved.p[3:, 3:] @ error)


def test_no_simulated_mismatch_below_it_keeps_the_loop_from_rest() -> None:
    """The real neurons, S_u of changing slope, and `e` of the allowed energy, placed where it
    raises P most."""
    stand = model()
    system = stand.system
    output = JacobianBall(alpha=1.0, beta=0.0)
    balls = Balls(input=BALLS.input, output=output)
    gains = ASKED.design(stand, balls).gains
    context = VerificationContext(system=system, controlled=system, balls=balls, gains=gains)
    weight = np.eye(1)
    proved = largest_tolerance(context, weight)
    assert proved is not None
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
            budget += proved.s**2 * float(
                u @ u
            )  # saved energy may be spent later: gain in mean square alone
            after = []
            for share, sign, slope in product((0, 0.5, 1), (-1, 1), (0.6, 1.0)):
                e = sign * np.sqrt(share * budget)
                v = slope * u
                error = x_hat @ stand.c.T - (x @ stand.c.T + e)
                estimate = stand.advance(x_hat, v, error @ l_z.T) + l @ error
                after.append((stand.advance(x, v), estimate, e * e))
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
    whole = with_gain_certificates(design, stand, balls)
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


@pytest.mark.parametrize(
    ("name", "factor", "said"),
    [
        ("s", 1.05, "tolerance.certified = True: in exact arithmetic the inequality fails"),
        ("lambda", -1.0, "fails (inequality)"),
        ("lambda_p", -1.0, "fails (inequality, lambda_p)"),
        ("f", 0.5, "tolerance.f: differs"),
        ("h", None, "tolerance.h: differs"),
        ("l_z", 0.5, "tolerance.l_z: differs"),
        ("alpha_out", 0.5, "tolerance.alpha_out: differs"),
        ("theorem", "tolerance", "is not part of a certificate"),
    ],
)
def test_a_forged_number_is_found(
    stored: tuple[dict, object], name: str, factor: object, said: str
) -> None:
    text = json.dumps(stored[0])
    content = json.loads(text)
    controlled = stored[1]
    value = np.array(content["tolerance"][name]) * factor if isinstance(factor, float) else factor
    content["tolerance"][name] = (
        value.tolist() if isinstance(value, np.ndarray) else value or [[0.1, 0.1]]
    )
    content["tolerance"]["certificate_digest"] = certificate_digest(content["tolerance"])
    claims = broken(content, controlled)
    assert any(said in claim for claim in claims)


def test_a_nonlinear_output_map_gets_none() -> None:
    known, _ = found(drawn(2, n=4, q=3, radius=0.9))
    output = JacobianBall.from_slopes(0.7, 0.9)
    bent = Balls(input=BALLS.input, output=output)
    context = VerificationContext(
        system=known.system, controlled=known.system, balls=bent, gains=known.gains
    )
    weight = np.eye(1)
    assert largest_tolerance(context, weight) is None


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
    balls = Balls(input=unit, output=unit)
    known = VerificationContext(system=system, controlled=system, balls=balls, gains=gains)
    find = partial(largest_tolerance, known, one)
    assert none_if_unsolved(find) is None
