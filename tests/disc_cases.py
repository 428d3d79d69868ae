"""Plants at the edge of a measured disc, and the loop of a controller on such a plant."""

import numpy as np
from scipy.linalg import block_diag

from ssm_study.certificates.theorem import VerificationContext
from ssm_study.robustness.coverage import Weights
from ssm_study.systems import StateSpace

ONE = np.ones((1, 1))


def first_order(gain: float, pole: float, direct: float) -> np.ndarray:
    return np.array([[pole, 1.0], [gain, direct]])


OUTPUT_WEIGHT = first_order(0.2, 0.7, 0.4)
INPUT_WEIGHT = first_order(0.05, 0.5, 0.1)
WEIGHTS = Weights(floor=0.3, output=OUTPUT_WEIGHT, input=INPUT_WEIGHT)


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
        predicted_output = system.c @ xh + system.d @ drive
        difference = alpha_out * predicted_output - m
        injected = difference - e
        x = system.a @ x + system.b @ drive
        correction = gains["l"] @ injected
        xh = system.a @ xh + system.b @ drive + correction
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
        gain = np.array([[1 - pole**2]])
        all_pass = (np.array([[pole]]), gain, np.array([[1.0]]), -pole * ONE)
        parts.append((all_pass, sign * share[i]))
    floor = weight_system(np.eye(0), WEIGHTS.floor)
    of_output = weight_system(WEIGHTS.output, 1.0)
    of_input = weight_system(WEIGHTS.input, 1.0)
    filters = [floor, of_output, of_input]
    blocks = []
    for (all_pass, size), weight, column in zip(parts, filters, (0, 0, 1), strict=True):
        into = np.zeros((1, 2))
        into[0, column] = 1.0
        blocks.append(weight_then_all_pass(weight, all_pass, into, kappa * size))
    centre_gain = np.array([[centre, 0.0]])
    direct = sum(block.d for block in blocks) + centre_gain
    states = [block.a for block in blocks]
    inputs = [block.b for block in blocks]
    outputs = [block.c for block in blocks]
    return StateSpace(a=block_diag(*states), b=np.vstack(inputs), c=np.hstack(outputs), d=direct)


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
    no_coupling = np.zeros((len(weight.a), 1))
    a = np.block([[weight.a, no_coupling], [ab @ weight.c, aa]])
    b = np.vstack([weight.b, ab @ weight.d]) @ into
    c = size * np.hstack([ad @ weight.c, ac])
    d = size * ad @ weight.d @ into
    return StateSpace(a=a, b=b, c=c, d=d)
