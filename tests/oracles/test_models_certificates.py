"""The claims of a scaffolding about itself, checked by another route."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssm_study.bounds.lipschitz import is_proved_nonexpansive
from ssm_study.bounds.slopes import jacobian_ball
from ssm_study.models.scaffolds.mlp import Mlp
from ssm_study.models.scaffolds.residual import Residual, ResidualScaffold
from ssm_study.models.scaffolds.trainable import MapContext
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import JacobianBall, JacobianBalls, StateSpace


def lipschitz_matrix(scaffold: ResidualScaffold) -> np.ndarray:
    """Fazlyab et al. (2019), eq. (10), at constant one for `G`: semidefinite means `|G(v) - G(w)|
    <= |v - w|`."""
    weights = scaffold.network.weights
    multipliers = scaffold.multipliers
    sizes = [w.shape[1] for w in weights]
    running_sum = np.cumsum(sizes)
    size = running_sum[-1]
    matrix = np.zeros((size, size))
    block = []
    for width, end in zip(sizes, running_sum, strict=True):
        block.append(slice(end - width, end))
    first = block[0]
    matrix[first, first] = np.eye(sizes[0])
    for layer, t in enumerate(multipliers, start=1):
        outer = block[layer]
        inner = block[layer - 1]
        matrix[outer, outer] += 2 * np.diag(t)
        cross = -t[:, None] * weights[layer - 1]
        matrix[outer, inner] += cross
        matrix[inner, outer] += cross.T
    last = block[-1]
    matrix[last, last] -= weights[-1].T @ weights[-1]
    return matrix


def smallest_eigenvalue(scaffold: ResidualScaffold) -> float:
    """The smallest eigenvalue of the matrix of eq. (10)."""
    matrix = lipschitz_matrix(scaffold)
    eigenvalues = np.linalg.eigvalsh(matrix)
    return float(eigenvalues.min())


def freeze_residual(
    rng: np.random.Generator, channels: int, width: int, depth: int
) -> ResidualScaffold:
    """A residual map as it is before training, with slopes in [0.1, 1]."""
    slopes = (0.1, 1.0)
    samples = rng.normal(size=(50, channels))
    frame = MapContext(width=width, slopes=slopes, samples=samples)
    residual = Residual(depth=depth)
    frozen = residual.build(frame, rng).to_numpy()
    assert isinstance(frozen, ResidualScaffold)
    return frozen


@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_stored_multipliers_prove_the_residual_map_1_lipschitz(depth: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    frozen = freeze_residual(rng, 3, 6, depth)
    assert smallest_eigenvalue(frozen) > -1e-9
    data = frozen.to_json()
    weights = data["weights"]
    larger = 1.2 * np.array(weights[0])
    weights[0] = larger.tolist()
    scaffold = ResidualScaffold.from_json(data)
    assert smallest_eigenvalue(scaffold) < -1e-3


def trained_like(channels: int, depth: int = 1) -> ResidualScaffold:
    """A residual map with slopes in [0.1, 1], as training leaves one."""
    rng = np.random.default_rng(channels)
    return freeze_residual(rng, channels, 8, depth)


def with_smaller_ball(honest: ResidualScaffold, factor: float) -> ResidualScaffold:
    """The same map, written as a smaller ball around a network that expands."""
    *inner, last = honest.network.weights
    weights = (*inner, factor * last)
    network = replace(honest.network, weights=weights)
    beta = honest.beta / factor
    return replace(honest, beta=beta, network=network)


@pytest.mark.parametrize("channels", [1, 2])
def test_a_ball_that_the_multipliers_do_not_prove_is_not_believed(channels: int) -> None:
    """beta / 64 and 64 times the last weights are the same map: its Jacobians leave the small
    ball."""
    honest = trained_like(channels)
    liar = with_smaller_ball(honest, 64.0)
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, size=(200, channels))
    expected = honest(points)
    np.testing.assert_allclose(liar(points), expected, rtol=1e-12)
    assert is_proved_nonexpansive(honest.network, honest.multipliers)
    honest_bound = jacobian_ball(honest)
    assert honest_bound.method == "construction"
    expected = JacobianBall(alpha=honest.alpha, beta=honest.beta)
    assert honest_bound.ball == expected
    for scale in (1.0, 64.0, 4096.0):  # whatever multipliers stand beside it
        multipliers = tuple(scale * t for t in liar.multipliers)
        scaled_liar = replace(liar, multipliers=multipliers)
        bound = jacobian_ball(scaled_liar)
        jacobians = [scaled_liar.jacobian(point) for point in points]
        alpha = bound.ball.alpha
        centre = alpha * np.eye(channels)
        distances = [np.linalg.norm(jacobian - centre, 2) for jacobian in jacobians]
        farthest = max(distances)
        assert bound.method != "construction"
        proved_radius = bound.ball.beta * (1 + 1e-9)
        assert liar.beta < farthest <= proved_radius


def test_neurons_steeper_than_one_are_not_believed_either() -> None:
    honest = trained_like(2)
    positive_slopes = honest.network.positive_slopes
    steep = tuple(64.0 * slopes for slopes in positive_slopes)
    network = replace(honest.network, positive_slopes=steep)
    assert not is_proved_nonexpansive(network, honest.multipliers)


def slopes_at(scaffold, points) -> list[float]:  # type: ignore[no-untyped-def]
    """Slopes of a map of one channel."""
    jacobians = [scaffold.jacobian(np.array([point])) for point in points]
    return [jacobian[0, 0] for jacobian in jacobians]


def test_a_certificate_with_the_small_ball_of_an_honest_map_is_refused() -> None:
    """Certified at a high rate with the small ball; at a true slope the loop is unstable."""
    honest = trained_like(1)
    liar = with_smaller_ball(honest, 64.0)
    a = np.array([[1.05, 0.2], [0.0, 0.9]])
    b = np.array([[0.0], [1.0]])
    c = np.eye(1, 2)
    d = np.zeros((1, 1))
    system = StateSpace(a=a, b=b, c=c, d=d)
    exact = JacobianBall(alpha=1.0, beta=0.0)
    small_ball = JacobianBall(alpha=liar.alpha, beta=liar.beta)
    small = JacobianBalls(input=small_ball, output=exact)
    rates = {"rate_controller": 0.85, "rate_observer": 0.5}
    synthesis = RiccatiSynthesis(input_weight=1e-3, **rates)
    model = SimpleNamespace(linear=system)
    design = synthesis.design(model, small)
    assert design.certified
    stored = design.to_json()
    text = json.dumps(stored)
    content = json.loads(text)
    assert failed_checks(content, system, small) == []  # what was believed before
    points = np.linspace(-3, 3, 400)
    k = design.state_feedback.k
    radii = []
    for slope in slopes_at(liar, points):
        closed_loop = system.a + slope * system.b @ k
        eigenvalues = np.linalg.eigvals(closed_loop)
        radii.append(np.abs(eigenvalues).max())
    assert max(radii) > 1
    ball = jacobian_ball(liar).ball
    derived = JacobianBalls(input=ball, output=exact)
    claims = failed_checks(content, system, derived)
    assert any("state_feedback.alpha, beta" in claim for claim in claims)


def test_the_perceptron_of_one_channel_can_saturate() -> None:
    """Both outer slopes at the floor, steep in the middle: out of reach of positive weights,
    whatever their values."""
    frame_slopes = (0.1, 1.0)
    even_points = np.linspace(-1, 1, 50)
    samples = even_points[:, None]
    frame = MapContext(width=8, slopes=frame_slopes, samples=samples)
    mlp = Mlp(depth=1, train_slopes=True, certified=True)
    rng = np.random.default_rng(0)
    scaffold = mlp.build(frame, rng)
    scaffold.base_0.data.fill_(-30.0)
    jumps = scaffold.jumps_0.data
    jumps[0] = 200.0
    jumps[-1] = -200.0
    frozen = scaffold.to_numpy()
    slopes = slopes_at(frozen, (-5.0, 0.0, 5.0))
    expected = [0.1, 1.0, 0.1]
    np.testing.assert_allclose(slopes, expected, atol=1e-9)
