"""`st.certify` and `st.control` for matrices that the user brings: refusals, reasons, words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import control
import jaxtyping
import numpy as np
import pytest
from recorded import assert_as_recorded

import ssm_study as st
from ssm_study.api.design import Design
from ssm_study.api.summaries import rate_text
from ssm_study.certificates.frontier import contraction_frontier
from ssm_study.refusal import BadRequest
from ssm_study.systems import JacobianBall

A = np.array([[0.9, 0.1], [0.0, 0.8]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0]])
D = np.zeros((1, 1))
K = np.array([[-0.1, -0.5]])
L = np.array([[-0.5], [-0.1]])
SLOPES = (0.8, 1.2)
STEP_S = 0.1
SYSTEM = (A, B, C, D, STEP_S)
COMPLEX_A = (1j * A, B, C, D, STEP_S)
COMPLEX_D = (A, B, C, 1j * D, STEP_S)
COMPLEX_STEP_S = np.complex128(0.1)
COUNTS = np.arange(9.0)
COMPLEX_COUNTS = 1j * COUNTS
STATE = np.array([[1j]])


@pytest.fixture(scope="module")
def design() -> Design:
    return st.control(SYSTEM, rate=0.5, slopes=SLOPES)


def simulate_complex_state(design: Design) -> object:
    return st.simulate(design, STATE)


def plot_complex_state(design: Design) -> object:
    return design.plot(STATE)


def ask_complex_limits(design: Design) -> object:
    lower = np.array([-1j])
    return design.within_limits(lower, 2)


def ask_complex_step(design: Design) -> object:
    size = np.complex128(1j)
    return design.step(size)


def fit_complex_slopes(_: Design) -> object:
    return st.fit(COUNTS, COUNTS, STEP_S, slopes=(1j, 2))


def control_complex_slopes(_: Design) -> object:
    return st.control(SYSTEM, rate=0.5, output_slopes=(1, 2j))


def control_complex_limits(_: Design) -> object:
    return st.control(SYSTEM, rate=0.5, input_limits=(None, 1j))


def estimate_complex_input(_: Design) -> object:
    estimator = st.Estimator(step_s=STEP_S)
    return estimator.fit(COMPLEX_COUNTS, COUNTS)


COMPLEX_MATRICES = [
    ("A", lambda _: st.certify(1j * A, B, K=K)),
    ("B", lambda _: st.certify(A, 1j * B, K=K)),
    ("A", lambda _: st.control(COMPLEX_A, rate=0.5)),
    ("D", lambda _: st.control(COMPLEX_D, rate=0.5)),
]
COMPLEX_GAINS = [
    ("K", lambda _: st.certify(A, B, K=[[1j, 0]])),
    ("L", lambda _: st.certify(A, C=C, L=1j * L)),
]
COMPLEX_LIMITS = [
    ("slopes", lambda _: st.certify(A, B, K=K, slopes=(1j, 2))),
    ("slopes", fit_complex_slopes),
    ("output_slopes", control_complex_slopes),
    ("input_limits", control_complex_limits),
]
COMPLEX_SIGNALS = [
    ("y0", simulate_complex_state),
    ("y0", plot_complex_state),
    ("lower", ask_complex_limits),
    ("size", ask_complex_step),
]
COMPLEX_RECORDS = [
    ("u", lambda _: st.fit(COMPLEX_COUNTS, COUNTS, STEP_S)),
    ("step_s", lambda _: st.fit(COUNTS, COUNTS, COMPLEX_STEP_S)),
    ("u", estimate_complex_input),
]
COMPLEX_MODELS = [*COMPLEX_MATRICES, *COMPLEX_GAINS, *COMPLEX_LIMITS]
COMPLEX_REQUESTS = [*COMPLEX_MODELS, *COMPLEX_SIGNALS, *COMPLEX_RECORDS]


@pytest.mark.filterwarnings("error::numpy.exceptions.ComplexWarning")
@pytest.mark.parametrize(("name", "ask"), COMPLEX_REQUESTS)
def test_complex_numbers_are_refused_wherever_they_enter(
    name: str, ask: Callable[[Any], object], design: Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NumPy drops an imaginary part with a warning: what is proved is then another system's."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # users check no types
    with pytest.raises(BadRequest, match=r"complex|is no sampling time") as refused:
        ask(design)
    assert refused.value.field.startswith(name)


def test_a_shape_that_does_not_fit_says_what_is_needed() -> None:
    words = r"B \(shape\) = \(1, 3\): must have 2 rows; check"
    three_numbers = np.ones(3)
    with pytest.raises(BadRequest, match=words):
        st.certify(A, three_numbers, K=K)


SLOPES_OF_BOTH_SIGNS = [
    ((0.0, 1.0), "hold zero, so an input might have no effect.*give a positive lowest slope"),
    ((-0.8, 1.2), "hold zero"),
]
SLOPES_OF_WRONG_ORDER = [
    ((-1.2, -0.8), "are negative; change the sign"),
    ((1.2, 0.8), r"are descending: the lowest comes first; give \(0\.8, 1\.2\)"),
]
INFINITE_SLOPES = [((0.8, np.inf), "are not finite")]
REFUSED_SLOPES = [*SLOPES_OF_BOTH_SIGNS, *SLOPES_OF_WRONG_ORDER, *INFINITE_SLOPES]


@pytest.mark.parametrize(("slopes", "words"), REFUSED_SLOPES)
def test_refused_slopes_say_why(slopes: tuple[float, float], words: str) -> None:
    with pytest.raises(BadRequest, match=words):
        st.certify(A, B, K=K, slopes=slopes)


def test_no_gain_proves_more_than_none_where_the_slopes_hold_zero() -> None:
    """The reason of the refusal, by the frontier of such a ball."""
    holds_zero = JacobianBall.from_slopes(0.0, 1.0)
    frontier = contraction_frontier(A, B, holds_zero)
    assert frontier.contraction_limit == pytest.approx(0.9)


def test_a_vector_is_a_column_of_b_and_of_l() -> None:
    from_columns = st.certify(A, B, C, K=K, L=L, slopes=SLOPES)
    b = B[:, 0]
    c = C[0]
    gains = {"K": K[0], "L": L[:, 0]}
    from_vectors = st.certify(A, b, c, slopes=SLOPES, **gains)
    assert repr(from_vectors) == repr(from_columns)

    system = (A, b, c, D, STEP_S)
    design = st.control(system, rate=0.5)
    assert design.certified


def test_a_mode_out_of_reach_is_named() -> None:
    unstable = np.diag([1.2, 0.5])
    second_state = np.array([[0.0, 1.0]])

    proof = st.certify(unstable, B, second_state, K=K, L=L)
    printed = repr(proof)

    words = "a mode of modulus 1.2 is not stable and the"
    advice = "so no gain stabilises it; use another"
    assert f"{words} input does not reach it, {advice} act" in printed
    assert f"{words} output does not show it, {advice} sens" in printed


def test_a_picture_without_records_says_what_to_do(design: Design, tmp_path: Path) -> None:
    words = r"design = matrices: has no records.*identify a model with st\.fit"
    with pytest.raises(BadRequest, match=words):
        design.margin_plot()
    designed = st.control(SYSTEM, rate=0.5)
    saved = designed.save(tmp_path / "saved")
    words = r"loaded design = .*comes without its model's records.*st\.load the saved model"
    with pytest.raises(BadRequest, match=words):
        st.load(saved).coverage_plot()


def test_masked_entries_are_refused() -> None:
    mask = [[False, True], [False, False]]
    masked = np.ma.masked_array(A, mask=mask)
    words = "has masked entries"
    with pytest.raises(BadRequest, match=words):
        st.certify(masked, B, K=K)


def test_real_numbers_of_any_kind_are_read() -> None:
    single_precision = B.astype(np.float32)
    lists = A.tolist()
    gain = K.tolist()
    plain = st.certify(lists, single_precision, K=gain, slopes=SLOPES)
    assert plain.certified


def test_a_design_that_failed_prints_its_reason() -> None:
    """The words are the certificate's, without the names of a study's settings."""
    design = st.control(SYSTEM, rate=0.99, slopes=SLOPES)
    printed = repr(design)
    reason = "no certificate: rate 0.99 is infeasible: the slopes allow only"
    assert f"controller     {reason}" in printed
    assert "rates below 0.856; request a smaller rate" in printed
    assert "observer       rate 0.99" in printed
    assert "(asked 0.99) per sample" in printed
    assert "model." not in printed
    assert "reduction." not in printed


def test_a_rate_limit_below_zero_is_told_as_none() -> None:
    """Only rates below -0.21 is no advice: no rate is positive and below it."""
    doubled = 2 * A
    unstable = (doubled, B, C, D, STEP_S)
    wide = (0.3, 5.0)
    design = st.control(unstable, rate=0.5, slopes=wide)
    printed = repr(design)
    assert "the slopes allow no positive rate; give slopes that lie closer together" in printed
    assert "request a smaller rate" not in printed


def test_a_side_that_arithmetic_does_not_confirm_prints_why() -> None:
    slopes = {"slopes": SLOPES, "output_slopes": SLOPES}
    design = st.control(SYSTEM, rate=0.85, method="lmi", **slopes)
    certificate = design.certificate
    sides = {"controller": certificate.state_feedback, "observer": certificate.observer}
    summary = design.summary()
    assert not design.certificate.certified
    for name, part in sides.items():
        if not part.certified:
            assert summary[f"{name}, reason"] == part.solver_status


def test_certify_says_in_words_that_no_rate_is_possible() -> None:
    coupled = np.array([[0.9, 1.0], [0.0, 0.8]])
    slow = [[-0.5, -0.8]]
    wide = (0.2, 2.0)
    proof = st.certify(coupled, B, K=slow, slopes=wide)
    assert not proof.certified
    assert "no single constant metric proves a rate for every slope from 0.2 to 2" in repr(proof)


def test_a_rate_of_no_design_is_refused_by_its_own_name() -> None:
    for name in ("rate", "observer_rate"):
        words = rf"^{name} = 2\.0: a contraction rate lies in"
        request = {name: 2.0}
        with pytest.raises(BadRequest, match=words):
            st.control(SYSTEM, **request)


UNKNOWN_PERIODS = [(True, "give the sampling period"), (None, "period"), (0, r"control\.c2d")]


@pytest.mark.parametrize(("dt", "remedy"), UNKNOWN_PERIODS)
def test_a_missing_sampling_period_is_asked_for(dt: float | bool | None, remedy: str) -> None:
    """A discrete system of unknown period cannot be sampled; a continuous one can."""
    system = control.StateSpace(A, B, C, D, dt)
    with pytest.raises(BadRequest, match=remedy):
        st.control(system, rate=0.5)


def test_the_printed_certificate_names_its_slopes() -> None:
    """Reader of the print alone knows for which maps the rate holds."""
    slopes = {"slopes": SLOPES, "output_slopes": (0.9, 1.1)}
    proof = st.certify(A, B, C, K=K, L=L, **slopes)
    summary = proof.summary()
    assert summary["controller, slopes"] == "0.8 to 1.2 of the input map"
    assert summary["observer, slopes"] == "0.9 to 1.1 of the output map"
    assert proof.controller is not None
    assert isinstance(proof.controller, st.GainCertificate)
    assert proof.controller.slopes == SLOPES


FROM_CONTROL = control.StateSpace(*SYSTEM)


@pytest.mark.parametrize("system", [SYSTEM, FROM_CONTROL])
def test_certify_takes_a_system_as_control_does(system: object) -> None:
    rates = []
    gains = {"K": K, "L": L}
    for matrices in ((system,), (A, B, C)):
        proof = st.certify(*matrices, slopes=SLOPES, **gains)
        assert proof.controller is not None
        assert proof.observer is not None
        controller_rate = proof.controller.rate
        observer_rate = proof.observer.rate
        rates.append((controller_rate, observer_rate))
    assert rates[0] == rates[1]


def test_certify_says_what_to_give_in_place_of_other_objects(design: Design) -> None:
    """A transfer function has no states that gains could act on; a design has its certificates."""
    denominator = [1.0, -0.5]
    transfer = control.TransferFunction([1.0], denominator, STEP_S)
    kind = type("Plant", (), {})
    plant = object.__new__(kind)
    words = r"give A, B, C \(for example P\.A, P\.B, P\.C\)"
    for other in (design, transfer, plant):
        with pytest.raises(BadRequest, match=words):
            st.certify(other, K=K)


def test_facts_of_a_bare_design_are_its_proof(design: Design) -> None:
    facts = design.result_columns
    assert facts["rate_controller"] == 0.5
    certificate = design.certificate
    certified_rate = certificate.certified_rate("state_feedback")
    assert facts["controller_certified_rate"] == certified_rate
    assert facts["observer_gain_norm"] == certificate.observer.gain_norm
    assert design.record == facts
    infeasible = st.control(SYSTEM, rate=0.99, slopes=SLOPES)
    reason = infeasible.result_columns["infeasible_reason"]
    assert "allow only rates below 0.856" in reason


def test_the_step_picture_shows_the_motion_ahead_of_the_step(design: Design) -> None:
    """The trajectory is planned for a known step, so the picture begins at rest and says so."""
    output, inputs, *_ = design.step().axes
    first_s = inputs.get_xlim()[0]
    time_s, u = inputs.lines[0].get_data()
    is_before = np.asarray(time_s) <= first_s
    before = np.abs(u[is_before])
    ahead = before.max(initial=0.0)
    largest = np.abs(u).max()
    lines = output.lines
    labels = [line.get_label() for line in lines]
    assert ahead < 0.02 * largest
    assert "set point, known in advance" in labels


def test_pictures_of_given_matrices_speak_of_no_identified_model(design: Design) -> None:
    figures = (design.plot(), design.step())
    for figure in figures:
        title = figure.get_suptitle()
        assert "the given model" in title
        assert "identified" not in title


def test_gains_that_bring_every_state_to_rest_are_certified_close_to_rate_one() -> None:
    """All eigenvalues of the loop are zero: nothing is divided by their size."""
    double_integrator = [[1, 1], [0, 1]]
    force = [[0.0], [1.0]]
    deadbeat = [[-1.0, -2.0]]
    proof = st.certify(double_integrator, force, K=deadbeat)
    controller = proof.controller
    assert controller is not None
    assert controller.rate == pytest.approx(0.999)
    assert proof.certified


PROVED_RATES = [0.1, 0.946216, 0.73263159, 0.9999]


@pytest.mark.parametrize("rate", PROVED_RATES)
def test_a_printed_rate_is_never_more_than_what_is_proved(rate: float) -> None:
    for digits in (3, 6):
        printed = float(rate_text(rate, digits))
        assert printed <= rate
        last_digit = 10.0 ** (1 - digits)
        assert printed == pytest.approx(rate, rel=last_digit)


def test_the_printed_rates_are_the_largest_that_the_gains_prove() -> None:
    """A design of bare matrices printed the rate that was asked for, a tenth of what it proves."""
    first_row = [0.9, 0.1, 0.0]
    second_row = [0.0, 0.8, 0.2]
    third_row = [0.0, 0.0, 0.95]
    a = np.array([first_row, second_row, third_row])
    b = np.array([[0.0], [0.1], [1.0]])
    c = np.array([[1.0, 0.0, 0.0]])
    d = np.zeros((1, 1))
    system = (a, b, c, d, 1.0)
    design = st.control(system, slopes=SLOPES)
    gains = design.certificate.gains
    k = gains["k"]
    observer_gain = gains["l"]

    proof = st.certify(a, b, c, K=k, L=observer_gain, slopes=SLOPES)

    controller = proof.controller
    assert controller is not None
    largest = rate_text(controller.rate)
    printed = repr(design)
    assert f"rate {largest} (asked 0.05)" in printed


def test_the_design_has_the_recorded_numbers(design: Design) -> None:
    assert_as_recorded("own_matrices", [design.certificate, str(design)], 1e-3)
