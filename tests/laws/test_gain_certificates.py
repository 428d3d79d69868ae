"""Statements of `st.certify` and `print(design)` on a rate: metric, growth, reason, no control."""

import numpy as np
import pytest
from recorded import assert_as_recorded

import ssm_study as st
from ssm_study.api.summaries import summarise_input_limits, summarise_prediction
from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.loop_poles import moves_poles
from ssm_study.synthesis.withheld_coverage import IDLE, UNSTABLE, withhold_coverage
from ssm_study.systems import Gains, StateSpace

ROWS_OF_A = [[0.9, 0.1], [0.0, 0.8]]
A = np.array(ROWS_OF_A)
COLUMN_OF_B = [[0.0], [1.0]]
B = np.array(COLUMN_OF_B)
ROW_OF_C = [1.0, 0.0]
C = np.array([ROW_OF_C])
ROW_OF_K = [-0.1, -0.5]
K = np.array([ROW_OF_K])
COLUMN_OF_L = [[-0.5], [-0.1]]
L = np.array(COLUMN_OF_L)
SLOPES = (0.8, 1.2)
NO_DIRECT_PATH = np.zeros((1, 1))


@pytest.fixture(scope="module")
def proof() -> st.Certification:
    output_slopes = (0.9, 1.1)
    return st.certify(A, B, C, K=K, L=L, slopes=SLOPES, output_slopes=output_slopes)


SIDES = ["controller", "observer"]


@pytest.mark.parametrize("side", SIDES)
def test_distances_contract_in_the_metric(proof: st.Certification, side: str) -> None:
    """The metric of both sides, at both extreme slopes and for a whole walk between them."""
    gain = getattr(proof, side)
    through = B @ K if side == "controller" else L @ C
    metric = gain.metric
    for slope in gain.slopes:
        step = A + slope * through
        decrease = 1 - gain.rate
        contracted = decrease * metric
        metric_of_step = step.T @ metric @ step
        slack = contracted - metric_of_step
        eigenvalues = np.linalg.eigvalsh(slack)
        least = eigenvalues.min()
        assert least > 0
    rng = np.random.default_rng(0)
    start = rng.normal(size=(2, 200))
    distance = start
    growth = 0.0
    for _ in range(30):
        slope = rng.uniform(*gain.slopes)
        closed_loop = A + slope * through
        distance = closed_loop @ distance
        start_norms = np.linalg.norm(start, axis=0)
        distance_norms = np.linalg.norm(distance, axis=0)
        ratio = distance_norms / start_norms
        largest_ratio = ratio.max()
        growth = max(growth, largest_ratio)
    assert growth <= gain.overshoot
    summary = proof.summary()
    label = f"{side}, overshoot"
    assert "Euclidean distances grow at most" in summary[label]


def test_p_itself_is_no_metric() -> None:
    """A reader who takes `p` for the metric finds the inequality broken."""
    rows_of_a = [[1.05, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, -0.05, 0.7]]
    a = np.array(rows_of_a)
    column_of_b = [[0.1], [0.3], [1.0]]
    b = np.array(column_of_b)
    row_of_k = [-1.5, -1.5, -0.6]
    k = np.array([row_of_k])
    proof_of_k = st.certify(a, b, K=k, slopes=SLOPES)
    gain = proof_of_k.controller
    assert gain is not None
    assert gain.certificate is not None
    p = gain.certificate.p
    step = a + 0.8 * b @ k
    decrease = 1 - gain.rate
    contracted = decrease * p
    after_the_step = step.T @ p @ step
    slack = contracted - after_the_step
    eigenvalues = np.linalg.eigvalsh(slack)
    least = eigenvalues.min()
    assert least < 0
    product = gain.metric @ p
    identity = np.eye(3)
    assert np.allclose(product, identity)


def test_a_gain_without_a_certificate_has_no_metric() -> None:
    unstable_row = [1.0, 1.0]
    unstable_gain = [unstable_row]
    unproved = st.certify(A, B, K=unstable_gain, slopes=SLOPES)
    gain = unproved.controller
    assert gain is not None
    assert gain.metric is None
    assert gain.overshoot is None


WIDE_SLOPES = (0.3, 1.7)
NARROW_SLOPES = (0.9, 1.1)
LOST = [
    (-1.2, WIDE_SLOPES, "not stable at slope 0.3 (spectral radius 1.14)"),
    (1.2, NARROW_SLOPES, "stable with the opposite sign: gains enter as u = K x"),
]


@pytest.mark.parametrize(("k", "slopes", "words"), LOST)
def test_a_reason_names_the_slope_that_is_lost(
    k: float, slopes: tuple[float, float], words: str
) -> None:
    a = [[1.5]]
    b = [[1.0]]
    gain = [[k]]
    proof = st.certify(a, b, K=gain, slopes=slopes)
    assert proof.controller is not None
    assert words in proof.controller.reason


def test_a_gain_is_compared_with_none(proof: st.Certification) -> None:
    """Zero gain: the rate is the system's own, and the print says it."""
    idle = st.certify(A, B, K=0 * K, slopes=SLOPES)
    summary = idle.summary()
    assert summary["controller, without it"] == summary["controller, this gain"]
    assert summary["controller, this gain"].startswith("provable below 0.1")
    assert proof.controller is not None
    open_loop_rate = 1 - 0.9**2
    rate_without = proof.controller.rate_without
    expected_rate = pytest.approx(open_loop_rate)
    assert rate_without == expected_rate


def test_certificates_print_what_they_prove_and_no_matrices(proof: st.Certification) -> None:
    assert proof.controller is not None
    printed = repr(proof.controller)
    assert printed.startswith("GainCertificate\n  gain ")
    assert "decided exactly" in printed
    assert "array" not in printed
    system = (A, B, C, NO_DIRECT_PATH, 0.1)
    design = st.control(system, rate=0.1)
    limits = design.within_limits([-1.0], [1.0])
    printed = repr(limits)
    assert "at the full rate  from equilibria with outputs from [-" in printed
    everywhere = limits.everywhere
    assert everywhere is None or f"at rate {everywhere.rate:.2g}"[:9] in printed
    assert "array" not in printed


def test_a_rate_that_the_open_loop_has_too_is_called_no_gain() -> None:
    """The lag contracts at 0.19 by itself, and a gain that costs much adds nothing to that."""
    a = [[0.9]]
    b = [[1.0]]
    c = [[0.1]]
    d = [[0.0]]
    lag = (a, b, c, d, 0.1)
    costly = st.control(lag, rate=0.05, input_weight=1e4)
    slow = costly.summary()["without control"]
    assert slow.endswith("rates below 0.189: the controller's rate shows no gain")
    cheap = st.control(lag, rate=0.5)
    fast = cheap.summary()["without control"]
    assert fast == "the model contracts at rates below 0.189"
    facts = {"limited_rate": 0.18, "limit_lower": -1.0, "limit_upper": 1.0}
    lines_of_equal = summarise_input_limits(facts, 0.19)
    line = lines_of_equal["controller, input limited"]
    assert line.endswith("(no more than without control)")
    lines_of_faster = summarise_input_limits(facts, 0.1)
    line = lines_of_faster["controller, input limited"]
    assert line == "rate 0.18 per sample with inputs from -1 to 1"


def test_an_idle_controller_is_not_praised() -> None:
    rows_of_a = [[0.0, 1.0], [0.0, 0.0]]
    a = np.array(rows_of_a)
    system = (a, B, C, NO_DIRECT_PATH, 0.1)
    idle = st.control(system, rate=0.3)
    words = "hardly any: the poles are those without control"
    summary_of_idle = idle.summary()
    effect = summary_of_idle["effect of the controller"]
    assert effect == words
    facts = {"coverage": 2700.0, "resolved_margin": 3e8, "evidence": "sound"}
    facts |= {"predicted_stable": True}
    lines = summarise_prediction(facts, controller_acts=False)
    sentences = lines.values()
    text = " ".join(sentences)
    assert "withheld: the controller hardly acts" in text
    assert "margin" not in text
    praised = summarise_prediction(facts, controller_acts=True)
    assert "2.7e+03 times" in praised["covered by the proof"]
    gains = idle.certificate.gain_pair
    covered = facts | {"coverage_reference": "input"}
    withheld = withhold_coverage(covered, idle.model, gains)
    assert withheld["coverage"] is None
    assert withheld["coverage_reason"] == IDLE
    withheld_lines = summarise_prediction(withheld, controller_acts=False)
    covered_by_the_proof = withheld_lines["covered by the proof"]
    assert covered_by_the_proof == IDLE
    system_of_active = (A, B, C, NO_DIRECT_PATH, 0.1)
    active = st.control(system_of_active, rate=0.5)
    assert "effect of the controller" not in active.summary()
    summary_of_active = active.summary()
    comparison = summary_of_active["without control"]
    assert "rates below 0.189" in comparison
    gains_of_active = active.certificate.gain_pair
    facts_of_active = withhold_coverage(facts, active.model, gains_of_active)
    assert facts_of_active == facts


def test_the_coverage_of_a_controller_that_is_unstable_by_itself_is_withheld() -> None:
    """`xh+ = (a + b k + l c) xh` at a plant that holds still: -1.2 with these gains, while the loop
    on the model contracts."""
    unit = np.ones((1, 1))
    lag = StateSpace(a=0.5 * unit, b=unit, c=unit, d=0 * unit)
    model = SSM.from_linear(lag, 0.1)
    stable = Gains(k=-0.4 * unit, l=-0.4 * unit)
    unstable = Gains(k=-0.85 * unit, l=-0.85 * unit)
    facts = {"coverage": 1.2, "coverage_reference": "input"}
    unchanged = withhold_coverage(facts, model, stable)
    assert unchanged == facts
    withheld = withhold_coverage(facts, model, unstable)
    assert withheld["coverage"] is None
    assert withheld["coverage_reason"] == UNSTABLE
    withheld = withhold_coverage({"coverage": 0.9}, model, unstable)
    assert withheld == {"coverage": 0.9}


def test_poles_that_move_are_an_effect() -> None:
    poles = np.array([0.9 + 0j, 0.8 + 0j])
    reversed_poles = poles[::-1]
    moved = moves_poles(poles, reversed_poles)
    assert not moved
    assert moves_poles(poles, poles - 0.01)


def test_no_gain_is_promised_where_an_unstable_mode_is_out_of_reach() -> None:
    """Fewer states would hide the mode: the certificate would be of a plant that explodes."""
    modes = [1.1, 0.5]
    unstable = np.diag(modes)
    row_of_c = [0.0, 1.0]
    c = np.array([row_of_c])
    unstable_system = (unstable, B, c, NO_DIRECT_PATH, 0.1)
    design = st.control(unstable_system, rate=0.3)
    printed = repr(design)
    assert "a mode of modulus 1.1 is not stable and the input does not reach it" in printed
    assert "the output does not show it, so no gain stabilises it" in printed
    assert "fewer states" not in printed
    slow_modes = [0.99, 0.5]
    slow = np.diag(slow_modes)
    slow_system = (slow, B, c, NO_DIRECT_PATH, 0.1)
    design = st.control(slow_system, rate=0.3)
    printed = repr(design)
    assert "allows only rates below 0.0199" in printed


def test_limits_of_a_bare_system_are_refused() -> None:
    system = (A, B, C, NO_DIRECT_PATH, 0.1)
    input_limits = (-1.0, 1.0)
    with pytest.raises(BadRequest, match="nothing is proved within input limits; leave them"):
        st.control(system, rate=0.5, input_limits=input_limits)


def test_the_proof_has_the_recorded_numbers(proof: st.Certification) -> None:
    assert_as_recorded("gain_certificates", [proof, str(proof)], 1e-3)
