"""Statements of `st.certify` and `print(design)` on a rate: metric, growth, reason, no control."""

import numpy as np
import pytest

import ssm_study as st
from ssm_study.api.summaries import summarise_input_limits, summarise_prediction
from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.loop_poles import moves_poles
from ssm_study.synthesis.withheld_coverage import IDLE, UNSTABLE, withhold_coverage
from ssm_study.systems import Gains, StateSpace

A = np.array([[0.9, 0.1], [0.0, 0.8]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0]])
K = np.array([[-0.1, -0.5]])
L = np.array([[-0.5], [-0.1]])
SLOPES = (0.8, 1.2)
NO_DIRECT_PATH = np.zeros((1, 1))


@pytest.fixture(scope="module")
def proof() -> st.Certification:
    return st.certify(A, B, C, K=K, L=L, slopes=SLOPES, output_slopes=(0.9, 1.1))


@pytest.mark.parametrize("side", ["controller", "observer"])
def test_distances_contract_in_the_metric(proof: st.Certification, side: str) -> None:
    """The metric of both sides, at both extreme slopes and for a whole walk between them."""
    gain = getattr(proof, side)
    through = B @ K if side == "controller" else L @ C
    metric = gain.metric
    for slope in gain.slopes:
        step = A + slope * through
        contracted = (1 - gain.rate) * metric
        slack = contracted - step.T @ metric @ step
        least = np.linalg.eigvalsh(slack).min()
        assert least > 0
    rng = np.random.default_rng(0)
    start = rng.normal(size=(2, 200))
    distance = start
    growth = 0.0
    for _ in range(30):
        slope = rng.uniform(*gain.slopes)
        distance = (A + slope * through) @ distance
        start_norms = np.linalg.norm(start, axis=0)
        ratio = np.linalg.norm(distance, axis=0) / start_norms
        growth = max(growth, ratio.max())
    assert growth <= gain.overshoot
    assert "Euclidean distances grow at most" in proof.summary()[f"{side}, overshoot"]


def test_p_itself_is_no_metric() -> None:
    """A reader who takes `p` for the metric finds the inequality broken."""
    a = np.array([[1.05, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, -0.05, 0.7]])
    b = np.array([[0.1], [0.3], [1.0]])
    k = np.array([[-1.5, -1.5, -0.6]])
    proof_of_k = st.certify(a, b, K=k, slopes=SLOPES)
    gain = proof_of_k.controller
    assert gain is not None
    assert gain.certificate is not None
    p = gain.certificate.p
    step = a + 0.8 * b @ k
    contracted = (1 - gain.rate) * p
    slack = contracted - step.T @ p @ step
    least = np.linalg.eigvalsh(slack).min()
    assert least < 0
    product = gain.metric @ p
    assert np.allclose(product, np.eye(3))


def test_a_gain_without_a_certificate_has_no_metric() -> None:
    unproved = st.certify(A, B, K=[[1.0, 1.0]], slopes=SLOPES)
    gain = unproved.controller
    assert gain is not None
    assert gain.metric is None
    assert gain.overshoot is None


@pytest.mark.parametrize(
    ("k", "slopes", "words"),
    [
        (-1.2, (0.3, 1.7), "not stable at slope 0.3 (spectral radius 1.14)"),
        (1.2, (0.9, 1.1), "stable with the opposite sign: gains enter as u = K x"),
    ],
)
def test_a_reason_names_the_slope_that_is_lost(
    k: float, slopes: tuple[float, float], words: str
) -> None:
    proof = st.certify([[1.5]], [[1.0]], K=[[k]], slopes=slopes)
    assert proof.controller is not None
    assert words in proof.controller.reason


def test_a_gain_is_compared_with_none(proof: st.Certification) -> None:
    """Zero gain: the rate is the system's own, and the print says it."""
    idle = st.certify(A, B, K=0 * K, slopes=SLOPES)
    summary = idle.summary()
    assert summary["controller, without it"] == summary["controller, this gain"]
    assert proof.controller is not None
    open_loop_rate = 1 - 0.9**2
    assert proof.controller.rate_without == pytest.approx(open_loop_rate)


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
    lag = ([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.1)
    costly = st.control(lag, rate=0.05, input_weight=1e4)
    slow = costly.summary()["without control"]
    assert slow.endswith("rates below 0.189: the controller's rate shows no gain")
    cheap = st.control(lag, rate=0.5)
    fast = cheap.summary()["without control"]
    assert fast == "the model contracts at rates below 0.189"
    facts = {"limited_rate": 0.18, "limit_lower": -1.0, "limit_upper": 1.0}
    line = summarise_input_limits(facts, 0.19)["controller, input limited"]
    assert line.endswith("(no more than without control)")
    line = summarise_input_limits(facts, 0.1)["controller, input limited"]
    assert line == "rate 0.18 per sample with inputs from -1 to 1"


def test_an_idle_controller_is_not_praised() -> None:
    a = np.array([[0.0, 1.0], [0.0, 0.0]])
    system = (a, B, C, NO_DIRECT_PATH, 0.1)
    idle = st.control(system, rate=0.3)
    words = "hardly any: the poles are those without control"
    assert idle.summary()["effect of the controller"] == words
    facts = {"coverage": 2700.0, "resolved_margin": 3e8, "evidence": "sound"}
    facts |= {"predicted_stable": True}
    lines = summarise_prediction(facts, controller_acts=False)
    text = " ".join(lines.values())
    assert "withheld: the controller hardly acts" in text
    assert "margin" not in text
    praised = summarise_prediction(facts, controller_acts=True)
    assert "2.7e+03 times" in praised["covered by the proof"]
    gains = idle.certificate.pair
    covered = facts | {"coverage_reference": "input"}
    withheld = withhold_coverage(covered, idle.model, gains)
    assert withheld["coverage"] is None
    assert withheld["coverage_reason"] == IDLE
    assert summarise_prediction(withheld, controller_acts=False)["covered by the proof"] == IDLE
    system_of_active = (A, B, C, NO_DIRECT_PATH, 0.1)
    active = st.control(system_of_active, rate=0.5)
    assert "effect of the controller" not in active.summary()
    assert "rates below 0.189" in active.summary()["without control"]
    facts_of_active = withhold_coverage(facts, active.model, active.certificate.pair)
    assert facts_of_active == facts


def test_the_coverage_of_a_controller_that_is_unstable_by_itself_is_withheld() -> None:
    """`xh+ = (a + b k + l c) xh` at a plant that holds still: -1.2 with these gains, while the loop
    on the model contracts."""
    one = np.ones((1, 1))
    lag = StateSpace(a=0.5 * one, b=one, c=one, d=0 * one)
    model = SSM.from_linear(lag, 0.1)
    stable = Gains(k=-0.4 * one, l=-0.4 * one)
    unstable = Gains(k=-0.85 * one, l=-0.85 * one)
    facts = {"coverage": 1.2, "coverage_reference": "input"}
    assert withhold_coverage(facts, model, stable) == facts
    withheld = withhold_coverage(facts, model, unstable)
    assert withheld["coverage"] is None
    assert withheld["coverage_reason"] == UNSTABLE
    withheld = withhold_coverage({"coverage": 0.9}, model, unstable)
    assert withheld == {"coverage": 0.9}


def test_poles_that_move_are_an_effect() -> None:
    poles = np.array([0.9 + 0j, 0.8 + 0j])
    assert not moves_poles(poles, poles[::-1])
    assert moves_poles(poles, poles - 0.01)


def test_no_gain_is_promised_where_an_unstable_mode_is_out_of_reach() -> None:
    """Fewer states would hide the mode: the certificate would be of a plant that explodes."""
    unstable = np.diag([1.1, 0.5])
    c = np.array([[0.0, 1.0]])
    design = st.control((unstable, B, c, NO_DIRECT_PATH, 0.1), rate=0.3)
    printed = repr(design)
    assert "a mode of modulus 1.1 is not stable and the input does not reach it" in printed
    assert "the output does not show it, so no gain stabilises it" in printed
    assert "fewer states" not in printed
    slow = np.diag([0.99, 0.5])
    design = st.control((slow, B, c, NO_DIRECT_PATH, 0.1), rate=0.3)
    printed = repr(design)
    assert "allows only rates below 0.0199" in printed


def test_limits_of_a_bare_system_are_refused() -> None:
    system = (A, B, C, NO_DIRECT_PATH, 0.1)
    with pytest.raises(BadRequest, match="of a bare system nothing is proved there; leave them"):
        st.control(system, rate=0.5, input_limits=(-1.0, 1.0))
