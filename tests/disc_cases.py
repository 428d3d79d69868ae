"""Plants at the edge of a measured disc, and the loop of a controller on such a plant."""

import numpy as np
from scipy.linalg import block_diag

from ssm_study.certificates.theorem import VerificationContext
from ssm_study.robustness.coverage import DiscWeights
from ssm_study.systems import StateSpace

ONE = np.ones((1, 1))


def first_order(gain: float, pole: float, direct: float) -> np.ndarray:
    rows = [[pole, 1.0], [gain, direct]]
    return np.array(rows)


OUTPUT_WEIGHT = first_order(0.2, 0.7, 0.4)
INPUT_WEIGHT = first_order(0.05, 0.5, 0.1)
WEIGHTS = DiscWeights(floor=0.3, output=OUTPUT_WEIGHT, input=INPUT_WEIGHT)


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
        state_part = system.c @ xh
        direct_part = system.d @ drive
        predicted_output = state_part + direct_part
        difference = alpha_out * predicted_output - m
        injected = difference - e
        free_motion = system.a @ x
        driven_motion = system.b @ drive
        x = free_motion + driven_motion
        correction = gains["l"] @ injected
        predicted_free = system.a @ xh
        xh = predicted_free + driven_motion + correction
        mismatch_free = mismatch.a @ delta
        mismatch_driven = mismatch.b @ entering
        delta = mismatch_free + mismatch_driven
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
        signs = [-1.0, 1.0]
        sign = rng.choice(signs)
        input_gain = 1 - pole**2
        rows_of_gain = [[input_gain]]
        gain = np.array(rows_of_gain)
        pole_matrix = np.array([[pole]])
        unit = np.array([[1.0]])
        all_pass = (pole_matrix, gain, unit, -pole * ONE)
        signed_share = sign * share[i]
        parts.append((all_pass, signed_share))
    no_weight = np.eye(0)
    floor = weight_system(no_weight, WEIGHTS.floor)
    of_output = weight_system(WEIGHTS.output, 1.0)
    of_input = weight_system(WEIGHTS.input, 1.0)
    filters = [floor, of_output, of_input]
    blocks = []
    columns = (0, 0, 1)
    for (all_pass, size), weight, column in zip(parts, filters, columns, strict=True):
        into = np.zeros((1, 2))
        into[0, column] = 1.0
        block_of_disc = weight_then_all_pass(weight, all_pass, into, kappa * size)
        blocks.append(block_of_disc)
    row = [[centre, 0.0]]
    centre_gain = np.array(row)
    direct_of_blocks = sum(block.d for block in blocks)
    direct = direct_of_blocks + centre_gain
    states = [block.a for block in blocks]
    inputs = [block.b for block in blocks]
    outputs = [block.c for block in blocks]
    a = block_diag(*states)
    b = np.vstack(inputs)
    c = np.hstack(outputs)
    return StateSpace(a=a, b=b, c=c, d=direct)


def weight_system(weight: np.ndarray, gain: float) -> StateSpace:
    """The filter that a matrix of weights stores, or the plain gain where it has no states."""
    order = max(len(weight) - 1, 0)
    if order == 0:
        a = np.zeros((0, 0))
        b = np.zeros((0, 1))
        c = np.zeros((1, 0))
        return StateSpace(a=a, b=b, c=c, d=gain * ONE)
    return StateSpace(
        a=weight[:order, :order],
        b=weight[:order, order:],
        c=weight[order:, :order],
        d=weight[order:, order:],
    )


def weight_then_all_pass(
    weight: StateSpace, all_pass: tuple[np.ndarray, ...], into: np.ndarray, size: float
) -> StateSpace:
    """Series of a filter and an all-pass times `size`, driven by the signal that `into` picks."""
    aa, ab, ac, ad = all_pass
    states = len(weight.a)
    no_coupling = np.zeros((states, 1))
    weight_row = [weight.a, no_coupling]
    driven_by_weight = ab @ weight.c
    all_pass_row = [driven_by_weight, aa]
    a = np.block([weight_row, all_pass_row])
    through_weight = ab @ weight.d
    rows_of_b = [weight.b, through_weight]
    driven = np.vstack(rows_of_b)
    b = driven @ into
    seen_weight = ad @ weight.c
    columns_of_c = [seen_weight, ac]
    c = size * np.hstack(columns_of_c)
    direct = size * ad @ weight.d
    d = direct @ into
    return StateSpace(a=a, b=b, c=c, d=d)
