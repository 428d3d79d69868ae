"""Measured discs: the older theorem as a special case, a solver as oracle, loops on plants at the
disc's edge, and what must be refused."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from structured_cases import drawn

from ssm_study.certificates.theorem import VerificationContext
from ssm_study.certificates.theorems import tolerance
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.certificates.theorems.measured_discs_structured import StructuredMeasuredDiscs
from ssm_study.robustness.coverage import Weights
from ssm_study.robustness.sensitivity import frequency_response
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.synthesis.measured_discs_search import largest_kappa, optimum_for_weights
from ssm_study.systems import Balls, JacobianBall, StateSpace, StructuredSystem

ONE = np.ones((1, 1))
ZERO = np.zeros((1, 1))
INPUT_ALONE = Weights(floor=1e-9, output=ZERO, input=ONE)
BALLS = Balls(input=JacobianBall.from_slopes(0.6, 1.0), output=JacobianBall(alpha=0.8, beta=0.0))
BENT = replace(BALLS, output=JacobianBall(alpha=0.9, beta=0.1))
ASKED = RiccatiSynthesis(rate_controller=0.1, rate_observer=0.1, input_weight=1.0)


class _Model:
    def __init__(self, system: StateSpace | StructuredSystem) -> None:
        self.system = system
        neurons = isinstance(system, StructuredSystem)
        self.linear = system.linearise_at_slopes(np.zeros(system.neurons)) if neurons else system


def one_layer(seed: int, order: int = 3) -> StateSpace:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    return StateSpace(
        a=0.9 * a / np.abs(np.linalg.eigvals(a)).max(),
        b=rng.normal(size=(order, 1)),
        c=rng.normal(size=(1, order)),
        d=ZERO,
    )


def context(system: StateSpace | StructuredSystem, balls: Balls = BALLS) -> VerificationContext:
    design = ASKED.design(_Model(system), balls)
    assert design.certified
    return VerificationContext(system=system, controlled=system, balls=balls, gains=design.gains)


@pytest.mark.parametrize("seed", range(6))
def test_an_input_disc_around_zero_is_the_tolerance_to_seven_digits(seed: int) -> None:
    """The same theorem by a route of its own: a peak over frequencies, a line search over the
    multiplier; here both to more digits than the certificate asks for."""
    known = context(one_layer(seed))
    nu, _ = optimum_for_weights(MeasuredDiscs, known, INPUT_ALONE, 0.0)
    older = tolerance.largest_tolerance(known, ONE)
    assert older is not None
    loop, into_u = tolerance.Tolerance.matrices(older)
    outputs = np.vstack([older.beta * into_u, into_u])
    system = StateSpace(
        a=loop[:, : len(loop)], b=loop[:, len(loop) :], c=outputs, d=np.zeros((2, 2))
    )
    response = frequency_response(system, np.linspace(0, np.pi, 40001))

    def peak(log_multiplier: float) -> float:
        return float(tolerance._inverse_squares(response, 1, log_multiplier).max())

    near = float(np.log(older.lambda_p))
    best = minimize_scalar(
        peak, bounds=(near - 1e-2, near + 1e-2), method="bounded", options={"xatol": 1e-12}
    )
    assert np.sqrt(nu) == pytest.approx(best.fun**-0.5, rel=2e-7)
    assert older.s == pytest.approx(np.sqrt(nu), rel=2e-3)


def test_at_the_same_numbers_the_inequality_is_that_of_the_tolerance() -> None:
    known = context(one_layer(1))
    older = tolerance.largest_tolerance(known, ONE)
    disc = largest_kappa(known, INPUT_ALONE, 0.0)
    assert older is not None
    assert disc is not None
    same = disc.variables | {
        "p": older.p,
        "lambda_p": older.lambda_p,
        "kappa": older.s,
        "floor": 0.0,
    }
    made = MeasuredDiscs.as_floats(**same)["inequality"]
    np.testing.assert_allclose(made, tolerance.Tolerance.as_floats(**older.variables)["inequality"])
    assert disc.kappa == pytest.approx(older.s, rel=0.02)


@pytest.mark.parametrize("balls", [BALLS, BENT])
@pytest.mark.parametrize("centre", [0.0, -0.25])
def test_a_solver_agrees_where_the_largest_kappa_lies(balls: Balls, centre: float) -> None:
    """CVXPY looks for P and multipliers at once; the route of the search knows no P."""
    known = context(one_layer(2, order=2), balls)
    weights = Weights(floor=0.6, output=0.3 * ONE, input=0.4 * ONE)
    nu, _ = optimum_for_weights(MeasuredDiscs, known, weights, centre)
    assert solvable(known, weights, centre, 0.98 * np.sqrt(nu))
    assert not solvable(known, weights, centre, 1.02 * np.sqrt(nu))


def solvable(known: VerificationContext, weights: Weights, centre: float, kappa: float) -> bool:
    from types import SimpleNamespace

    bent = known.balls.output.beta > 0
    numbers = MeasuredDiscs.loop_of(known) | vars(known.balls.input)
    numbers |= {"centre": centre, "kappa": kappa, "floor": weights.floor, "lambda_p": 1.0}
    numbers |= {"weight_output": weights.output, "weight_input": weights.input}
    numbers["lambda_out"] = np.ones(3) if bent else np.zeros(0)
    of = SimpleNamespace(**{name: np.atleast_2d(value) for name, value in numbers.items()})
    rows = MeasuredDiscs.signals(of)
    forms = [form for _, form in MeasuredDiscs.static_map_forms(of, rows)]
    order = len(rows.xi)
    p = cp.Variable((order, order), symmetric=True)
    margin = cp.Variable()
    multipliers = cp.Variable(len(forms), nonneg=True)
    form = rows.xi.T @ p @ rows.xi - rows.step.T @ p @ rows.step + MeasuredDiscs.disc_form(of, rows)
    form = form + sum(multipliers[i] * forms[i] for i in range(len(forms)))
    limits = [form >> margin * np.eye(rows.xi.shape[1]), margin <= 1]
    problem = cp.Problem(cp.Maximize(margin), limits)
    problem.solve(solver="CLARABEL")
    return problem.status in ("optimal", "optimal_inaccurate") and float(margin.value) > 1e-7


def first_order(gain: float, pole: float, direct: float) -> np.ndarray:
    return np.array([[pole, 1.0], [gain, direct]])


WEIGHTS = Weights(floor=0.3, output=first_order(0.2, 0.7, 0.4), input=first_order(0.05, 0.5, 0.1))


def on_the_plant(
    known: VerificationContext, mismatch: StateSpace, slopes: np.ndarray, seed: int
) -> np.ndarray:
    """The loop's input on a plant `y = m + e`, `e = Delta(m, u)` with these slopes of S_u, from a
    random start."""
    system = known.system
    gains = known.gains
    alpha_out = known.balls.output.alpha
    rng = np.random.default_rng(seed)
    x, xh = rng.standard_normal((2, system.order))
    delta = np.zeros(mismatch.order)
    inputs = np.empty(len(slopes))
    for k, slope in enumerate(slopes):
        u = gains["k"] @ xh
        drive = slope * u
        m = alpha_out * (system.c @ x + system.d @ drive)
        entering = np.concatenate([m, u])
        e = mismatch.c @ delta + mismatch.d @ entering
        injected = alpha_out * (system.c @ xh + system.d @ drive) - m - e
        x = system.a @ x + system.b @ drive
        xh = system.a @ xh + system.b @ drive + gains["l"] @ injected
        delta = mismatch.a @ delta + mismatch.b @ entering
        inputs[k] = u[0]
    return inputs


def at_the_edge(kappa: float, centre: float, rng: np.random.Generator) -> StateSpace:
    """`e = c m + kappa (Q_1 floor m + Q_2 W m + Q_3 V u)`, the Q all-passes that together have gain
    one."""
    share = rng.standard_normal(3)
    share /= np.linalg.norm(share)
    parts = []
    for i in range(3):
        pole = rng.uniform(-0.95, 0.95)
        sign = rng.choice([-1.0, 1.0])
        all_pass = (np.array([[pole]]), np.array([[1 - pole**2]]), np.array([[1.0]]), -pole * ONE)
        parts.append((all_pass, sign * share[i]))
    filters = [(np.eye(0), WEIGHTS.floor), (WEIGHTS.output, 1.0), (WEIGHTS.input, 1.0)]
    blocks = []
    for (all_pass, size), (weight, gain), column in zip(parts, filters, (0, 0, 1), strict=True):
        order = max(len(weight) - 1, 0)
        a = weight[:order, :order]
        b = weight[:order, order:]
        c = weight[order:, :order]
        d = weight[order:, order:]
        if order == 0:
            a = np.zeros((0, 0))
            b = np.zeros((0, 1))
            c = np.zeros((1, 0))
            d = gain * ONE
        aa, ab, ac, ad = all_pass
        whole_a = np.block([[a, np.zeros((order, 1))], [ab @ c, aa]])
        into = np.zeros((1, 2))
        into[0, column] = 1.0
        blocks.append(
            (
                whole_a,
                np.vstack([b, ab @ d]) @ into,
                kappa * size * np.hstack([ad @ c, ac]),
                kappa * size * ad @ d @ into,
            )
        )
    from scipy.linalg import block_diag

    direct = sum(block[3] for block in blocks) + np.array([[centre, 0.0]])
    return StateSpace(
        a=block_diag(*(block[0] for block in blocks)),
        b=np.vstack([block[1] for block in blocks]),
        c=np.hstack([block[2] for block in blocks]),
        d=direct,
    )


@pytest.mark.parametrize("seed", range(5))
def test_no_plant_at_the_edge_of_the_disc_keeps_the_loop_moving(seed: int) -> None:
    known = context(one_layer(seed))
    proof = largest_kappa(known, WEIGHTS, -0.1)
    assert proof is not None
    assert proof.certified
    assert not proof.failed_checks(known)
    rng = np.random.default_rng(seed)
    for case in range(16):
        plant = at_the_edge(proof.kappa, -0.1, rng)
        slopes = rng.choice([0.6, 1.0], 1500) if case % 2 else np.full(1500, rng.choice([0.6, 1.0]))
        inputs = on_the_plant(known, plant, slopes, case)
        assert np.abs(inputs[-200:]).max() < 1e-2 * np.abs(inputs).max()


def test_plants_beyond_the_edge_do_keep_it_moving() -> None:
    """Negative control: the same plants, four times as far out."""
    known = context(one_layer(0))
    proof = largest_kappa(known, WEIGHTS, -0.1)
    assert proof is not None
    rng = np.random.default_rng(0)
    plants = [at_the_edge(4 * proof.kappa, -0.1, rng) for _ in range(40)]
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
    weights = Weights(floor=2.0, output=ZERO, input=1e-3 * ONE)
    proof = largest_kappa(known, weights, 0.0)
    assert proof is not None
    alpha_out = known.balls.output.alpha
    r = proof.kappa
    ahead = (
        alpha_out * system.c @ (system.a - np.eye(3))
    )  # m_(t+1) - m_t, by the state and the drive
    x, xh = np.random.default_rng(0).standard_normal((2, 3))
    outputs = []
    errors = []
    for k in range(4000):
        u = known.gains["k"] @ xh if k < 3000 else np.zeros(1)
        drive = (0.6 if k % 7 else 1.0) * u
        m = alpha_out * system.c @ x
        e = r * (ahead @ x + alpha_out * system.c @ system.b @ drive)
        injected = alpha_out * system.c @ xh - m - e
        x = system.a @ x + system.b @ drive
        xh = system.a @ xh + system.b @ drive + known.gains["l"] @ injected
        outputs.append(float(m[0]))
        errors.append(float(e[0]))
    assert np.abs(outputs[-200:]).max() < 1e-6 * np.abs(outputs).max()
    # From rest, an impulse of the input: the sum up to the sample before m moves exceeds the
    # disc's.
    drive = np.zeros((300, 1))
    drive[0] = 1.0
    y, _ = system.simulate(drive)
    m = alpha_out * y[:, 0]
    e = r * np.append(np.diff(m), 0.0)
    excess = np.cumsum(e**2 - proof.kappa**2 * weights.floor**2 * m**2)
    assert excess.max() > 0
    assert excess[-1] < 0


def test_neurons_without_effect_leave_the_disc_of_one_layer() -> None:
    plain = one_layer(4)
    q = 2
    none = {
        "e": np.zeros((3, q)),
        "f": np.zeros((q, 3)),
        "g": np.zeros((q, 1)),
        "h": np.zeros((1, q)),
    }
    system = StructuredSystem(**vars(plain), **none)
    known = context(plain)
    wider = VerificationContext(
        system=system,
        controlled=system,
        balls=BALLS,
        gains={**known.gains, "l_z": np.zeros((q, 1))},
    )
    one, _ = optimum_for_weights(MeasuredDiscs, known, WEIGHTS, -0.25)
    other, _ = optimum_for_weights(StructuredMeasuredDiscs, wider, WEIGHTS, -0.25)
    assert other == pytest.approx(one, rel=1e-5)


def test_loops_with_neurons_come_to_rest_on_plants_at_the_edge() -> None:
    system = drawn(0)
    known = context(system)
    proof = largest_kappa(known, WEIGHTS, -0.1)
    assert proof is not None
    assert proof.certified
    assert not proof.failed_checks(known)
    rng = np.random.default_rng(0)
    gains = known.gains
    alpha_out = known.balls.output.alpha
    maps = [np.tanh, lambda z: np.clip(z, -0.3, 0.3), lambda z: np.maximum(z, 0.0), lambda z: z]
    for case in range(8):
        phi = maps[case % 4]
        plant = at_the_edge(proof.kappa, -0.1, rng)
        x, xh = 3 * rng.standard_normal((2, 3))
        delta = np.zeros(plant.order)
        sizes = []
        for _ in range(2500):
            u = gains["k"] @ xh
            drive = rng.choice([0.6, 1.0]) * u
            m = alpha_out * system.c @ x
            entering = np.concatenate([m, u])
            e = plant.c @ delta + plant.d @ entering
            injected = alpha_out * system.c @ xh - m - e
            w = phi(system.f @ x + system.g @ drive)
            wh = phi(system.f @ xh + system.g @ drive + gains["l_z"] @ injected)
            x = system.a @ x + system.b @ drive + system.e @ w
            xh = system.a @ xh + system.b @ drive + system.e @ wh + gains["l"] @ injected
            delta = plant.a @ delta + plant.b @ entering
            sizes.append(float(np.abs(u[0])))
        assert max(sizes[-200:]) < 1e-2 * max(sizes)


def test_forged_numbers_are_refused() -> None:
    known = context(one_layer(0))
    proof = largest_kappa(known, WEIGHTS, -0.1)
    assert proof is not None
    assert not proof.failed_checks(known)
    assert replace(proof, kappa=3 * proof.kappa).failed_checks(known)
    assert replace(proof, lambda_p=-proof.lambda_p).failed_checks(known)
    assert replace(proof, p=-proof.p).failed_checks(known)
    assert replace(proof, k=2 * proof.k).failed_checks(known)
    outside = replace(proof, floor=0.09 / proof.kappa)  # then e = 0 is not in the disc around -0.1
    assert any("model inside the disc" in sentence for sentence in outside.failed_checks(known))


def test_a_bend_of_the_output_map_needs_its_multipliers() -> None:
    known = context(one_layer(0))
    proof = largest_kappa(known, WEIGHTS, -0.1)
    assert proof is not None
    bent = replace(known, balls=BENT)
    with_bend = largest_kappa(context(one_layer(0), BENT), WEIGHTS, -0.1)
    assert any("beta_out" in sentence for sentence in proof.failed_checks(bent))
    assert with_bend is not None
    assert len(with_bend.lambda_out) == 3
    assert with_bend.kappa < proof.kappa


def test_without_a_controller_no_number_is_the_largest() -> None:
    known = context(one_layer(0))
    idle = replace(known, gains={**known.gains, "k": np.zeros((1, 3))})
    assert largest_kappa(idle, INPUT_ALONE, 0.0) is None
