"""Loops with products of input and state: what is certified holds for simulated motions, what is
not so is refused, and the exported code does the same."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_models_bilinear import known_model

from ssm_study.api.rest_design import RestDesign, equilibrium_input_range, equilibrium_state
from ssm_study.certificates.bilinear_certificates import BilinearDesign, failed_bilinear_checks
from ssm_study.certificates.theorems.bilinear_contraction import BilinearContraction
from ssm_study.certificates.theorems.bilinear_everywhere import BilinearEverywhere
from ssm_study.certificates.theorems.bilinear_loop import BilinearLoop
from ssm_study.cli.main import main
from ssm_study.engine.records import write_record
from ssm_study.loop.bilinear_feedback import BilinearFeedback, advance_bilinear_states
from ssm_study.models.bilinear import Bilinear
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, Scale
from ssm_study.study.verify import verify
from ssm_study.synthesis.bilinear_design import BilinearSynthesis
from ssm_study.synthesis.bilinear_gains import input_vector_slopes

INPUT_CHANNEL = Channel(name="u", unit="V")
OUTPUT_CHANNEL = Channel(name="y", unit="m")
CHANNELS = (INPUT_CHANNEL, OUTPUT_CHANNEL)
CASES = 400


@pytest.fixture(scope="module")
def certificates() -> BilinearDesign:
    model = known_model()
    return BilinearSynthesis().design(model)


@pytest.fixture
def controller(certificates: BilinearDesign) -> BilinearFeedback:
    model = known_model()
    return BilinearFeedback(model=model, k=certificates.k, l_nodes=certificates.l_nodes)


def norms(vectors: np.ndarray, metric: np.ndarray) -> np.ndarray:
    squares = np.einsum("Ni,ij,Nj->N", vectors, metric, vectors)
    return np.sqrt(squares)


def loop_step(
    controller: BilinearFeedback, x: np.ndarray, estimate: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Next states and estimates, and the scaled inputs that led there."""
    model = controller.model
    none = np.zeros(0)
    output_matrix = model.c.T
    y = model.scale.physical_output(x @ output_matrix)
    u = controller.input(estimate, y, none)
    after = advance_bilinear_states(model, x, u)
    next_estimate = controller.next_memory(estimate, u, y, none)
    scaled_input = model.scale.scaled_input(u)
    return after, next_estimate, scaled_input


def random_starts(part: BilinearLoop | BilinearEverywhere, size: float) -> tuple:
    """States and errors whose norm is just `size`."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((CASES, 2))
    error = rng.standard_normal((CASES, 2))
    norm_of_error = norms(error, part.m)
    of_error = part.weight * norm_of_error
    norm = norms(x, part.p) + of_error
    share = (size / norm)[:, None]
    return share * x, share * error


def test_the_loop_comes_to_rest_as_certified(
    certificates: BilinearDesign, controller: BilinearFeedback
) -> None:
    part = certificates.parts["bilinear_loop"]
    assert isinstance(part, BilinearLoop)
    assert part.certified
    x, error = random_starts(part, part.radius)
    estimate = x + error
    norm = np.full(CASES, part.radius)
    for _ in range(30):
        unlimited = estimate @ certificates.k.T
        x, estimate, scaled = loop_step(controller, x, estimate)
        np.testing.assert_allclose(scaled, unlimited, atol=1e-12)
        norm_of_error = norms(estimate - x, part.m)
        of_error = part.weight * norm_of_error
        after = norms(x, part.p) + of_error
        upper_limit = part.factor * norm + 1e-12
        assert (after <= upper_limit).all()
        norm = after


def test_from_far_away_the_cut_loop_comes_to_rest_as_certified(
    certificates: BilinearDesign, controller: BilinearFeedback
) -> None:
    part = certificates.parts["bilinear_everywhere"]
    assert isinstance(part, BilinearEverywhere)
    x, error = random_starts(part, 50.0)
    estimate = x + error
    cut = 0
    norm = np.full(CASES, 50.0)
    for _ in range(60):
        unlimited = estimate @ certificates.k.T
        x, estimate, scaled = loop_step(controller, x, estimate)
        is_cut = np.abs(scaled - unlimited) > 0.1
        cut += int(is_cut.sum())
        norm_of_error = norms(estimate - x, part.m)
        of_error = part.weight * norm_of_error
        after = norms(x, part.p) + of_error
        upper_limit = part.factor * norm + 1e-12
        assert (after <= upper_limit).all()
        norm = after
    assert cut > CASES
    assert norm.max() < 0.1


def test_two_motions_approach_each_other_inside_the_set_as_certified(
    certificates: BilinearDesign,
) -> None:
    part = certificates.parts["bilinear_contraction"]
    assert isinstance(part, BilinearContraction)
    model = known_model()
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((2, CASES, 2))
    pair = []
    for x in directions:
        shares = rng.uniform(0.0, 1.0, CASES)
        share = part.radius * shares / norms(x, part.p)
        pair.append(share[:, None] * x)
    distance = pair[0] - pair[1]
    before = norms(distance, part.p)
    moved = [advance_bilinear_states(model, x, x @ certificates.k.T) for x in pair]
    distance_after = moved[0] - moved[1]
    after = norms(distance_after, part.p)
    upper_limit = part.factor * before + 1e-12
    assert (after <= upper_limit).all()


def test_contraction_fails_far_from_rest() -> None:
    """Both vertices contract at 0.9, the loop's slope is -1.5."""
    scale_of_one = Scale.identity(1, 1)
    nodes = np.array([-4.0, 0.0, 4.0])
    a = np.array([[[0.9]], [[0.9]], [[-0.9]]])
    no_input = np.zeros((3, 1))
    one = np.ones((1, 1))
    model = Bilinear(nodes=nodes, a=a, b=no_input, c=one, scale=scale_of_one, step_s=0.1)
    flat_a = model.a.reshape(-1, 1)
    k = np.array([[-0.3]])
    numbers = {
        "nodes": model.nodes,
        "a_nodes": flat_a,
        "b_nodes": model.b,
        "k": k,
        "p": one,
        "factor_controller": 0.91,
        "gain_state": 0.31,
        "variation": 0.46,
        "factor": 0.99,
    }
    assert BilinearContraction.holds(**numbers, radius=0.5)
    assert not BilinearContraction.holds(**numbers, radius=10.0)
    states = [[-9.0], [-9.1]]
    x = np.array(states)
    after = advance_bilinear_states(model, x, -0.3 * x)
    distance_after = abs(after[1, 0] - after[0, 0])
    assert distance_after > 0.12  # before: 0.1


def test_the_vertices_hold_between_the_nodes(certificates: BilinearDesign) -> None:
    """A second route: the loop's matrix at many inputs, from the hat functions themselves."""
    part = certificates.parts["bilinear_loop"]
    assert isinstance(part, BilinearLoop)
    model = known_model()
    root = np.linalg.cholesky(part.p).T
    inverse = np.linalg.inv(root)
    for v in np.linspace(-1, 1, 41):
        if v == 0.0:
            continue
        at_the_input = np.array([[v]])
        all_hats = model.hat_values(at_the_input)
        hats = all_hats[0]
        a = np.einsum("q,qij->ij", hats, model.a)
        b = hats @ model.b / v
        correction = np.outer(b, certificates.k)
        closed = a + correction
        shifted = root @ closed @ inverse
        shrinkage = np.linalg.norm(shifted, 2)
        assert shrinkage <= part.factor_controller


def test_a_stored_design_is_verified_and_a_lie_is_named(
    certificates: BilinearDesign, tmp_path: Path
) -> None:
    design = RestDesign(model=known_model(), certificates=certificates, channels=CHANNELS)
    folder = design.save(tmp_path / "design")
    verification = verify(folder)
    assert verification.holds
    assert len(verification) == 3
    again = RestDesign.load(folder)
    assert again.certificates.to_json() == certificates.to_json()
    path = folder / "certificate.json"
    text = path.read_text()
    content = json.loads(text)
    content["bilinear_loop"]["radius"] *= 2
    lie = json.dumps(content)
    path.write_text(lie)
    failed = [finding for finding in verify(folder) if not finding.holds]
    failing = [finding.found for finding in failed]
    assert any("in exact arithmetic the inequality fails" in words for words in failing)
    with pytest.raises(BadRequest, match="in exact arithmetic the inequality fails"):
        RestDesign.load(folder)


def test_a_record_beside_a_saved_design_is_named_and_not_shown(
    certificates: BilinearDesign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Any run folder would be verified by the certificates of a design that lies in it."""
    design = RestDesign(model=known_model(), certificates=certificates, channels=CHANNELS)
    folder = design.save(tmp_path / "design")
    assert "channels.json" in verify(folder).unchecked
    content = {"status": "ok", "fit_test_percent": 99.9, "coverage": 9.0}
    write_record(folder, content)
    (folder / "proof.txt").write_text("settled on hardware")
    failing = {finding.claim for finding in verify(folder) if not finding.holds}
    assert failing == {"record.json", "proof.txt"}
    assert main(["show", str(folder)]) == 2
    printed = capsys.readouterr()
    assert "99.9" not in printed.out
    assert "belongs to no saved bilinear design" in printed.err
    with pytest.raises(BadRequest, match="belongs to no saved bilinear design"):
        RestDesign.load(folder)


def test_the_commands_take_a_saved_design(
    certificates: BilinearDesign, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    design = RestDesign(model=known_model(), certificates=certificates, channels=CHANNELS)
    folder = design.save(tmp_path / "design")
    assert main(["verify", str(folder)]) == 0
    assert "3 of 3 claims hold" in capsys.readouterr().out
    to = tmp_path / "c"
    assert main(["export", str(folder), "--to", str(to)]) == 0
    assert "No set points" in capsys.readouterr().out
    header = to / "controller.h"
    expected = design.to_c(tmp_path / "controller.h").read_text()
    assert header.read_text() == expected
    assert main(["refine", str(folder)]) == 2
    assert "there is no record.json" in capsys.readouterr().err


def test_a_certificate_of_another_model_or_gain_is_refused(certificates: BilinearDesign) -> None:
    content = certificates.to_json()
    model = known_model()
    assert failed_bilinear_checks(content, model) == []
    larger_a = 0.99 * model.a
    other = replace(model, a=larger_a)
    (first, *_) = failed_bilinear_checks(content, other)
    assert "a_nodes: differs from what the model" in first
    larger_gain = 1.1 * certificates.k
    deployed = content | {"k": larger_gain.tolist()}
    text = " ".join(failed_bilinear_checks(deployed, model))
    assert "not the one that is deployed" in text
    (unknown,) = failed_bilinear_checks(content | {"bilinear_wish": {}}, model)
    assert "bilinear_wish: is not one of bilinear_loop" in unknown
    gain_alone = {"k": content["k"]}
    (missing,) = failed_bilinear_checks(gain_alone, model)
    assert "certificate.l_nodes" in missing


def test_a_model_that_no_gain_steadies_is_told() -> None:
    model = known_model()
    unstable_a = 2.0 * model.a
    no_input = 0.0 * model.b
    unsteady = replace(model, a=unstable_a, b=no_input)
    certificates = BilinearSynthesis().design(unsteady)
    assert not certificates.certified
    design = RestDesign(model=unsteady, certificates=certificates, channels=CHANNELS)
    with pytest.raises(BadRequest, match="no single gain steadies the model"):
        design.simulate([0.5])
    summary = design.summary()
    assert summary["comes to rest"] == "not certified"
    assert summary["input stays within"] == "-1 to 1"


def test_an_input_with_its_rest_at_an_end_is_certified_with_the_cut_alone() -> None:
    model = known_model()
    upper = slice(1, None)
    upper_nodes = model.nodes[upper]
    upper_a = model.a[upper]
    upper_b = model.b[upper]
    one_sided = replace(model, nodes=upper_nodes, a=upper_a, b=upper_b)
    certificates = BilinearSynthesis().design(one_sided)
    assert list(certificates.parts) == ["bilinear_everywhere"]
    assert "an end of the inputs" in certificates.reasons["bilinear_loop"]
    assert certificates.certified


def test_the_loop_settles_sooner_than_the_model_alone(certificates: BilinearDesign) -> None:
    design = RestDesign(model=known_model(), certificates=certificates, channels=CHANNELS)
    starts = [0.5, -0.5]
    table = design.simulate(starts, horizon_s=3.0)
    assert list(table) == ["case", "time_s", "u", "y"]
    assert len(table) == 60
    last = table[table.time_s > 2.85]
    sizes_of_outputs = last.y.abs()
    assert sizes_of_outputs.max() < 0.01
    moduli = [np.abs(np.linalg.eigvals(a)) for a in known_model().a]
    radii = [of_node.max() for of_node in moduli]
    part = certificates.parts["bilinear_loop"]
    assert isinstance(part, BilinearLoop)
    assert part.factor_controller < max(radii)
    columns = input_vector_slopes(known_model())
    assert len(columns) == 2


def test_the_named_starts_from_rest_are_in_the_set(certificates: BilinearDesign) -> None:
    part = certificates.parts["bilinear_loop"]
    model = known_model()
    lowest, highest = equilibrium_input_range(model, part)
    assert lowest == -1.0
    assert 0.0 < highest < 1.0
    level = np.array([[highest]])
    inputs = np.repeat(level, 400, axis=0)
    y = model.simulate(inputs)
    x = equilibrium_state(model, highest)
    np.testing.assert_allclose(model.c @ x, y[-1], atol=1e-9)
    norm = np.sqrt(x @ part.p @ x)
    norm_of_error = np.sqrt(x @ part.m @ x)
    norm += part.weight * norm_of_error
    assert 0.9 * part.radius < norm <= part.radius


@pytest.mark.parametrize("real", ["double", "float"])
def test_the_compiled_controller_does_the_same(
    certificates: BilinearDesign, tmp_path: Path, real: str
) -> None:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    input_scale = np.array([2.0])
    output_scale = np.array([3.0])
    input_equilibrium = np.array([1.0])
    output_equilibrium = np.array([-4.0])
    scale = Scale(
        input_scale=input_scale,
        output_scale=output_scale,
        input_equilibrium=input_equilibrium,
        output_equilibrium=output_equilibrium,
    )
    model = replace(known_model(), scale=scale)
    design = RestDesign(model=model, certificates=certificates, channels=CHANNELS)
    header = design.to_c(tmp_path / "law.h", real=real)
    text = header.read_text()
    assert "the loop comes to rest from every start" in text
    replay = tmp_path / "law_replay.c"
    program = tmp_path / "replay"
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-pedantic", "-Wall", "-Wextra", "-Werror"]
    compilation = [compiler, *flags, replay, "-o", program]
    subprocess.run(compilation, check=True)
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    wrong = text.replace("v < law_nodes[0]", "v < 0")
    assert wrong != text
    header.write_text(wrong)
    subprocess.run(compilation, check=True)
    returncode = subprocess.run([program], capture_output=True).returncode
    assert returncode == 1


def test_a_prefix_that_is_no_name_is_refused(certificates: BilinearDesign, tmp_path: Path) -> None:
    design = RestDesign(model=known_model(), certificates=certificates, channels=CHANNELS)
    with pytest.raises(BadRequest, match="is no name in C"):
        design.to_c(tmp_path / "int.h")
