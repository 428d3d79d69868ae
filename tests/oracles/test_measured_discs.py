"""Measured discs: a closed form of a special case, a solver as oracle, loops on plants at the
disc's edge, and what must be refused."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from disc_cases import ONE, WEIGHTS, at_the_edge, on_the_plant
from jaxtyping import Complex
from scipy.optimize import minimize_scalar
from structured_cases import drawn

from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.certificates.theorems.measured_discs_structured import StructuredMeasuredDiscs
from ssm_study.robustness.coverage import DiscWeights
from ssm_study.robustness.sensitivity import frequency_response
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_search import (
    INPUT_ALONE,
    certify_largest_radius,
    optimum_for_weights,
)
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace, StructuredSystem

ZERO = np.zeros((1, 1))
INPUT_BALL = JacobianBall.from_slopes(0.6, 1.0)
OUTPUT_BALL = JacobianBall(alpha=0.8, beta=0.0)
BALLS = JacobianBalls(input=INPUT_BALL, output=OUTPUT_BALL)
BENT_OUTPUT = JacobianBall(alpha=0.9, beta=0.1)
BENT = replace(BALLS, output=BENT_OUTPUT)
ASKED = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1, input_weight=1.0)


class _Model:
    def __init__(self, system: StateSpace | StructuredSystem) -> None:
        self.system = system
        neurons = isinstance(system, StructuredSystem)
        self.linear = system
        if neurons:
            no_slopes = np.zeros(system.neurons)
            self.linear = system.linearise_at_slopes(no_slopes)


def one_layer(seed: int, order: int = 3) -> StateSpace:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    eigenvalues = np.linalg.eigvals(a)
    spectral_radius = np.abs(eigenvalues).max()
    b = rng.normal(size=(order, 1))
    c = rng.normal(size=(1, order))
    scaled = 0.9 * a / spectral_radius
    return StateSpace(a=scaled, b=b, c=c, d=ZERO)


def context(
    system: StateSpace | StructuredSystem, balls: JacobianBalls = BALLS
) -> VerificationContext:
    design = ASKED.design(_Model(system), balls)
    assert design.certified
    return VerificationContext(system=system, controlled=system, balls=balls, gains=design.gains)


def input_responses(known: VerificationContext) -> Complex[np.ndarray, "F 2"]:
    """Responses of the loop's input to the ball's `p` and to the mismatch, written out anew."""
    system = known.system
    k = known.gains["k"]
    l = known.gains["l"]  # noqa: E741
    driven = 0.8 * system.b @ k
    none = np.zeros_like(system.a)
    observer_loop = system.a + 0.8 * l @ system.c
    loop = StateSpace(
        a=np.block([[system.a + driven, driven], [none, observer_loop]]),
        b=np.block([[system.b, np.zeros_like(l)], [np.zeros_like(system.b), -l]]),
        c=np.hstack([k, k]),
        d=np.zeros((1, 2)),
    )
    angles = np.linspace(0, np.pi, 40001)
    return frequency_response(loop, angles)[:, 0]


@pytest.mark.parametrize("seed", range(3))
def test_an_input_disc_around_zero_has_a_closed_form_to_seven_digits(seed: int) -> None:
    """`(nu + lambda beta^2) |u|^2 <= lambda |p|^2 + |e|^2` at every angle, the largest over
    lambda."""
    known = context(one_layer(seed))
    nu, _ = optimum_for_weights(MeasuredDiscs, known, INPUT_ALONE, 0.0)
    proof = certify_largest_radius(known)
    assert proof is not None
    magnitudes = np.abs(input_responses(known))
    from_p, from_e = (magnitudes**2).T

    def missing(log_multiplier: float) -> float:
        multiplier = np.exp(log_multiplier)
        beta = known.balls.input.beta
        weighted = 1 / (from_p / multiplier + from_e)
        room = weighted - multiplier * beta**2
        return -float(room.min())

    near = float(np.log(proof.lambda_p))
    bounds = (near - 0.3, near + 0.3)
    best = minimize_scalar(missing, bounds=bounds, method="bounded", options={"xatol": 1e-12})
    assert nu == pytest.approx(-best.fun, rel=4e-7)
    kappa = np.sqrt(nu)
    assert proof.kappa == pytest.approx(kappa, rel=2e-3)


@pytest.mark.parametrize("balls", [BALLS, BENT])
@pytest.mark.parametrize("centre", [0.0, -0.25])
def test_a_solver_agrees_where_the_largest_kappa_lies(balls: JacobianBalls, centre: float) -> None:
    """CVXPY looks for P and multipliers at once; the route of the search knows no P."""
    system = one_layer(2, order=2)
    known = context(system, balls)
    weights = DiscWeights(floor=0.6, output=0.3 * ONE, input=0.4 * ONE)
    nu, _ = optimum_for_weights(MeasuredDiscs, known, weights, centre)
    kappa = 0.98 * np.sqrt(nu)
    assert solvable(known, weights, centre, kappa)
    kappa = 1.02 * np.sqrt(nu)
    assert not solvable(known, weights, centre, kappa)


def solvable(known: VerificationContext, weights: DiscWeights, centre: float, kappa: float) -> bool:
    from types import SimpleNamespace

    bent = known.balls.output.beta > 0
    measured_discs = MeasuredDiscs.loop_matrices(known)
    numbers = measured_discs | vars(known.balls.input)
    numbers |= {"centre": centre, "kappa": kappa, "floor": weights.floor, "lambda_p": 1.0}
    numbers |= {"weight_output": weights.output, "weight_input": weights.input}
    numbers["lambda_out"] = np.ones(3) if bent else np.zeros(0)
    matrices = {name: np.atleast_2d(value) for name, value in numbers.items()}
    of = SimpleNamespace(**matrices)
    rows = MeasuredDiscs.signal_matrices(of)
    measured_discs = MeasuredDiscs.static_map_constraints(of, rows)
    forms = [form for _, form in measured_discs]
    order = len(rows.xi)
    p = cp.Variable((order, order), symmetric=True)
    margin = cp.Variable()
    multipliers = cp.Variable(len(forms), nonneg=True)
    energy = rows.xi.T @ p @ rows.xi
    energy_after = rows.step.T @ p @ rows.step
    difference = energy - energy_after
    measured_discs = MeasuredDiscs.disc_constraint(of, rows)
    form = difference + measured_discs
    weighted_forms = [multipliers[i] * forms[i] for i in range(len(forms))]
    form = form + sum(weighted_forms)
    identity = np.eye(rows.xi.shape[1])
    limits = [form >> margin * identity, margin <= 1]
    a = cp.Maximize(margin)
    problem = cp.Problem(a, limits)
    problem.solve(solver="CLARABEL")
    return problem.status in ("optimal", "optimal_inaccurate") and float(margin.value) > 1e-7


@pytest.mark.parametrize("seed", range(3))
def test_no_plant_at_the_edge_of_the_disc_keeps_the_loop_moving(seed: int) -> None:
    known = context(one_layer(seed))
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    assert proof is not None
    assert proof.certified
    assert not proof.failed_checks(known)
    rng = np.random.default_rng(seed)
    for case in range(8):
        plant = at_the_edge(proof.kappa, -0.1, rng)
        slopes = rng.choice([0.6, 1.0], 1500) if case % 2 else np.full(1500, rng.choice([0.6, 1.0]))
        inputs = on_the_plant(known, plant, slopes, case)
        largest = np.abs(inputs[-200:]).max()
        upper_limit = 1e-2 * np.abs(inputs).max()
        assert largest < upper_limit


def test_plants_beyond_the_edge_do_keep_it_moving() -> None:
    """Negative control: the same plants, four times as far out."""
    known = context(one_layer(0))
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    assert proof is not None
    rng = np.random.default_rng(0)
    plants = [at_the_edge(4 * proof.kappa, -0.1, rng) for _ in range(12)]
    with np.errstate(over="ignore", invalid="ignore"):
        ends = [np.abs(on_the_plant(known, one, np.ones(1500), 0)[-100:]).max() for one in plants]
    assert any(not end < 1e-2 for end in ends)


def test_a_plant_that_answers_a_sample_before_its_model_is_covered_by_sums_over_all_time() -> None:
    """`e_t = r (m_(t+1) - m_t)`: `|e| <= 2 r |m|` in energy over all time, yet not up to every
    time.

    The theorem asks for the first alone; the loop on this plant, at the proved kappa, comes to
    rest.
    """
    system = one_layer(3)
    known = context(system)
    weights = DiscWeights(floor=2.0, output=ZERO, input=1e-3 * ONE)
    proof = certify_largest_radius(known, weights, 0.0)
    assert proof is not None
    alpha_out = known.balls.output.alpha
    r = proof.kappa
    difference = system.a - np.eye(3)
    ahead = alpha_out * system.c @ difference  # m_(t+1) - m_t, by the state and the drive
    rng = np.random.default_rng(0)
    x, xh = rng.standard_normal((2, 3))
    outputs = []
    errors = []
    for k in range(4000):
        stabilising_input = known.gains["k"] @ xh
        u = stabilising_input if k < 3000 else np.zeros(1)
        drive = (0.6 if k % 7 else 1.0) * u
        m = alpha_out * system.c @ x
        drive_ahead = alpha_out * system.c @ system.b @ drive
        e = r * (ahead @ x + drive_ahead)
        difference = alpha_out * system.c @ xh - m
        injected = difference - e
        x = system.a @ x + system.b @ drive
        correction = known.gains["l"] @ injected
        xh = system.a @ xh + system.b @ drive + correction
        outputs.append(float(m[0]))
        errors.append(float(e[0]))
    largest = np.abs(outputs[-200:]).max()
    upper_limit = 1e-6 * np.abs(outputs).max()
    assert largest < upper_limit
    excess = excess_after_an_impulse(system, proof, weights)
    assert excess.max() > 0
    assert excess[-1] < 0


def excess_after_an_impulse(
    system: StateSpace, proof: MeasuredDiscs, weights: DiscWeights
) -> np.ndarray:
    """Running sums by which the error exceeds the disc, from rest: they do up to the sample before
    m moves."""
    drive = np.zeros((300, 1))
    drive[0] = 1.0
    y, _ = system.simulate(drive)
    m = BALLS.output.alpha * y[:, 0]
    differences = np.diff(m)
    e = proof.kappa * np.append(differences, 0.0)
    disc = proof.kappa**2 * weights.floor**2
    difference = e**2 - disc * m**2
    return np.cumsum(difference)


def test_neurons_without_effect_leave_the_disc_of_one_layer() -> None:
    plain = one_layer(4)
    q = 2
    e = np.zeros((3, q))
    f = np.zeros((q, 3))
    g = np.zeros((q, 1))
    h = np.zeros((1, q))
    none = {"e": e, "f": f, "g": g, "h": h}
    system = StructuredSystem(**vars(plain), **none)
    known = context(plain)
    l_z = np.zeros((q, 1))
    gains = {**known.gains, "l_z": l_z}
    wider = VerificationContext(system=system, controlled=system, balls=BALLS, gains=gains)
    one, _ = optimum_for_weights(MeasuredDiscs, known, WEIGHTS, -0.25)
    other, _ = optimum_for_weights(StructuredMeasuredDiscs, wider, WEIGHTS, -0.25)
    assert other == pytest.approx(one, rel=1e-5)


def test_loops_with_neurons_come_to_rest_on_plants_at_the_edge() -> None:
    system = drawn(0)
    known = context(system)
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    assert proof is not None
    assert proof.certified
    assert not proof.failed_checks(known)
    rng = np.random.default_rng(0)
    gains = known.gains
    alpha_out = known.balls.output.alpha
    maps = [np.tanh, lambda z: np.clip(z, -0.3, 0.3), lambda z: np.maximum(z, 0.0), lambda z: z]
    for case in range(4):
        phi = maps[case]
        plant = at_the_edge(proof.kappa, -0.1, rng)
        white_noise = rng.standard_normal((2, 3))
        x, xh = 3 * white_noise
        delta = np.zeros(plant.order)
        sizes = []
        for _ in range(1500):
            u = gains["k"] @ xh
            drive = rng.choice([0.6, 1.0]) * u
            m = alpha_out * system.c @ x
            entering = np.concatenate([m, u])
            e = plant.c @ delta + plant.d @ entering
            difference = alpha_out * system.c @ xh - m
            injected = difference - e
            w = phi(system.f @ x + system.g @ drive)
            injected_input = gains["l_z"] @ injected
            wh = phi(system.f @ xh + system.g @ drive + injected_input)
            x = system.a @ x + system.b @ drive + system.e @ w
            correction = gains["l"] @ injected
            xh = system.a @ xh + system.b @ drive + system.e @ wh + correction
            delta = plant.a @ delta + plant.b @ entering
            sizes.append(float(np.abs(u[0])))
        largest = max(sizes[-200:])
        assert largest < 1e-2 * max(sizes)


def test_a_bend_of_the_output_map_needs_its_multipliers() -> None:
    known = context(one_layer(0))
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    assert proof is not None
    bent = replace(known, balls=BENT)
    verification_context = context(one_layer(0), BENT)
    with_bend = certify_largest_radius(verification_context, WEIGHTS, -0.1)
    sentences = proof.failed_checks(bent)
    assert any("beta_out" in sentence for sentence in sentences)
    assert with_bend is not None
    assert len(with_bend.lambda_out) == 3
    assert with_bend.kappa < proof.kappa
    assert with_bend.failed_checks(verification_context) == []


def test_a_forged_bend_without_multipliers_is_refused() -> None:
    """Half the radius leaves all the room that the inequality without multipliers needs."""
    known = context(one_layer(0))
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    assert proof is not None
    half = replace(proof, kappa=0.5 * proof.kappa)
    assert half.failed_checks(known) == []
    bend = replace(OUTPUT_BALL, beta=0.1)
    bent = replace(known, balls=replace(BALLS, output=bend))
    forged = replace(half, beta_out=0.1)
    sentences = forged.failed_checks(bent)
    assert any("beta_out" in sentence for sentence in sentences)


def test_neurons_that_see_the_error_and_the_output_at_once_are_refused() -> None:
    """An observer whose neurons answer the error within the sample has an algebraic loop there."""
    system = drawn(0)
    known = context(system)
    proof = certify_largest_radius(known, WEIGHTS, -0.1)
    assert proof is not None
    assert proof.l_z.any()
    half = replace(proof, kappa=0.5 * proof.kappa)
    assert half.failed_checks(known) == []
    seen = np.full(system.h.shape, 1e-9)
    seeing = replace(system, h=seen)
    at_once = replace(known, system=seeing, controlled=seeing)
    sentences = replace(half, h=seen).failed_checks(at_once)
    assert any("alpha_out" in sentence for sentence in sentences)


def test_without_a_controller_no_number_is_the_largest() -> None:
    known = context(one_layer(0))
    k = np.zeros((1, 3))
    gains = {**known.gains, "k": k}
    idle = replace(known, gains=gains)
    assert certify_largest_radius(idle, INPUT_ALONE, 0.0) is None
