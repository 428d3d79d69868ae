"""A design for matrices is exported only where its observer can compute the plant's maps."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from recorded import assert_as_recorded

import ssm_study as st
from ssm_study.api.design import Design
from ssm_study.api.known_maps import UnknownMapWarning
from ssm_study.export.targets import describe_origin
from ssm_study.refusal import BadRequest

A = np.array([[1.3, 1.0], [0.0, 1.17]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0]])
SYSTEM = (A, B, C, np.zeros((1, 1)), 0.1)
SLOPES = (0.8, 1.2)


@pytest.fixture(scope="module")
def uncertain() -> Design:
    return st.control(SYSTEM, slopes=SLOPES, rate=0.3)


def loop_radius(design: Design, plant_slope: float, observer_slope: float) -> float:
    """Spectral radius of a plant with one slope under an observer that computes another."""
    gains = design.certificate.gain_pair
    plant = np.hstack([A, plant_slope * B @ gains.k])
    correction = gains.l @ C
    own = A + observer_slope * B @ gains.k + correction
    observer = np.hstack([-correction, own])
    loop = np.vstack([plant, observer])
    poles = np.linalg.eigvals(loop)
    radius = np.abs(poles).max()
    return float(radius)


def test_an_observer_with_another_map_can_lose_the_plant(uncertain: Design) -> None:
    """Both certificates hold, of an observer with the plant's own map; with the mean slope in its
    place the same gains lose a plant whose slope is in the range."""
    expected = {"controller": True, "observer": True, "loop": False}
    assert uncertain.verdicts == expected
    assert not uncertain.certified
    assert loop_radius(uncertain, 1.2, 1.2) < 1
    actual = loop_radius(uncertain, 1.2, 1.0)
    assert actual == pytest.approx(1.065, abs=1e-3)


def test_a_controller_with_an_unknown_map_is_not_exported(
    uncertain: Design, tmp_path: Path
) -> None:
    words = r"only the slopes are given.*give slopes=\(g, g\)"
    with pytest.raises(BadRequest, match=words):
        uncertain.to_c(tmp_path / "controller.h")
    with pytest.raises(BadRequest, match=words):
        uncertain.to_control()
    with pytest.raises(BadRequest, match=words):
        uncertain.save(tmp_path / "saved")
    files = list(tmp_path.iterdir())
    assert files == []
    summary = uncertain.summary()
    line = "not certified: this proof needs an observer that computes the plant's own input map"
    example = "not stable with input gain 1.2 of the plant, 1 of the observer"
    words = f"{line} with slopes 0.8 to 1.2; {example} (spectral radius 1.065)"
    assert summary["loop of both"] == words


def test_an_output_map_that_is_not_known_counts_too() -> None:
    design = st.control(SYSTEM, output_slopes=(0.9, 1.1), rate=0.3)
    assert list(design.unknown_maps) == ["output_slopes"]
    with pytest.raises(BadRequest, match=r"output map with slopes 0\.9 to 1\.1"):
        design.to_control()


@pytest.mark.parametrize("gain", [1.0, 2.0])
def test_a_known_gain_is_exported_with_the_design_s_own_verdict(
    gain: float, tmp_path: Path
) -> None:
    """Header and design agree, and the exported observer computes the map that was given."""
    design = st.control(SYSTEM, slopes=(gain, gain), rate=0.3)
    assert design.certified
    assert all(design.verdicts.values())
    assert not design.unknown_maps
    assert design.summary()["loop of both"].startswith("comes to rest, certified")
    radius = loop_radius(design, gain, gain)
    assert radius < 1
    path = design.to_c(tmp_path / "pump.h")
    text = path.read_text()
    words = "/* Controller pump, certified for its model at rates 0.3 (controller)"
    assert text.startswith(words)
    gains = design.certificate.gain_pair
    state = np.array([0.3, -0.2])
    measured = np.zeros(1)
    controller = design.to_control()
    after = controller.dynamics(0.0, state, measured)
    own = A + gain * B @ gains.k + gains.l @ C
    expected = own @ state
    assert np.allclose(after, expected, rtol=1e-12)
    saved = design.save(tmp_path / "saved")
    assert st.load(saved).certified


def test_a_header_says_why_it_is_not_certified(tmp_path: Path) -> None:
    """A folder whose certificate is of other slopes than its model's: one verdict, its reason."""
    design = st.control(SYSTEM, slopes=(1.0, 1.0), rate=0.3)
    saved = design.save(tmp_path / "saved")
    other = st.control(SYSTEM, slopes=SLOPES, rate=0.3)
    path = saved / "certificate.json"
    other.certificate.save(path)
    with pytest.raises(BadRequest, match="state_feedback"):
        st.load(saved)
    words = describe_origin(saved)
    assert "NOT certified: state_feedback" in words
    assert words.endswith("see certificate.json.")


def test_poles_of_a_design_are_those_at_the_middle_of_its_slopes() -> None:
    """Slope one may lie outside the range for which the design is certified."""
    lag = ([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.1)
    design = st.control(lag, rate=0.3, slopes=(0.4, 0.8))
    gain = design.certificate.gain_pair.k.item()
    poles = design.eigenvalues()
    assert poles["controlled"].item() == pytest.approx(0.9 + 0.6 * gain)
    correction = design.certificate.gain_pair.l.item()
    assert poles["estimate"].item() == pytest.approx(0.9 + 0.1 * correction)
    printed = design.summary()["slowest pole, observer"]
    assert printed == f"{abs(poles['estimate'].item()):.4f} per sample"


def test_a_loop_with_an_unknown_map_says_which_gain_it_takes(uncertain: Design) -> None:
    """Neither a table nor a picture takes a map in silence; with a known gain there is no word."""
    words = "the input map with slopes 0.8 to 1.2: plant and observer take the gain in the middle"
    with pytest.warns(UnknownMapWarning, match=words):
        st.simulate(uncertain, [0.1], "loop.horizon_s=0.2")
    for draw in (uncertain.step, uncertain.nyquist, uncertain.poles):
        with pytest.warns(UnknownMapWarning, match=words):
            draw()
    with pytest.warns(UnknownMapWarning, match=words):
        figure = uncertain.plot()
    assert "slopes in the middle of their range" in figure.get_suptitle() + str(figure.texts)
    assert "gain in the middle" in uncertain.summary()["drawn and simulated"]
    known = st.control(SYSTEM, rate=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnknownMapWarning)
        st.simulate(known, [0.1], "loop.horizon_s=0.2")
    assert "drawn and simulated" not in known.summary()


def test_certify_and_control_mean_the_same_by_certified(uncertain: Design) -> None:
    """Both gains are proved, and an observer with the mean slope loses plants within the slopes."""
    scalar = [[3.0]], [[1.0]], [[1.0]]
    gains = {"K": [[-3.0]], "L": [[-2.9]]}
    proof = st.certify(*scalar, **gains, slopes=SLOPES)
    assert proof.verdicts == uncertain.verdicts
    assert not proof.certified
    printed = repr(proof)
    assert "loop of both            not certified: this proof needs an observer" in printed
    words = "input gain 0.8 of the plant, 1 of the observer (spectral radius 1.37)"
    assert words in printed
    loop = np.array([[3.0, -2.4], [2.9, 3.0 - 3.0 - 2.9]])
    actual = np.abs(np.linalg.eigvals(loop)).max()
    assert actual == pytest.approx(1.37, abs=1e-3)
    known = st.certify(*scalar, **gains)
    assert known.certified
    assert known.summary()["loop of both"].startswith("comes to rest, certified")
    alone = st.certify([[3.0]], [[1.0]], K=[[-3.0]], slopes=SLOPES)
    assert alone.certified
    assert alone.verdicts == {"controller": True}
    wrong = st.certify(*scalar, K=[[-3.0]], L=[[2.9]])
    assert wrong.summary()["loop of both"] == "not certified: the observer is not"


def test_the_observer_s_line_names_what_it_supposes(uncertain: Design) -> None:
    line = uncertain.summary()["observer"]
    words = "if it computes the plant's own input map with slopes 0.8 to 1.2"
    assert line.endswith(words)
    known = st.control(SYSTEM, slopes=(2.0, 2.0), rate=0.3)
    assert "if it computes" not in known.summary()["observer"]


def test_the_print_says_where_the_proof_ends(uncertain: Design) -> None:
    """Nothing is simulated of a bare system; the lines on the loop stand whatever they say."""
    summary = uncertain.summary()
    assert summary["not proved"].startswith("a rate of the loop of both")
    assert "simulated" not in summary
    infeasible = st.control(SYSTEM, slopes=(0.3, 5.0), rate=0.9).summary()
    assert infeasible["loop of both"].startswith("not certified: the controller")


def test_the_design_has_the_recorded_numbers(uncertain: Design) -> None:
    assert_as_recorded("known_maps", [uncertain.certificate, str(uncertain)], 1e-3)
