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
from ssm_study.models.scaffolds.scaffold import Frame
from ssm_study.synthesis.design import failed_checks
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Balls, JacobianBall, StateSpace


def lipschitz_matrix(scaffold: ResidualScaffold) -> np.ndarray:
    """Fazlyab et al. (2019), eq. (10), at constant one for `G`: semidefinite means `|G(v) - G(w)|
    <= |v - w|`."""
    weights = scaffold.network.weights
    multipliers = scaffold.multipliers
    sizes = [w.shape[1] for w in weights]
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    matrix = np.zeros((offsets[-1], offsets[-1]))
    block = [slice(offsets[i], offsets[i + 1]) for i in range(len(sizes))]
    matrix[block[0], block[0]] = np.eye(sizes[0])
    for layer, t in enumerate(multipliers, start=1):
        matrix[block[layer], block[layer]] += 2 * np.diag(t)
        cross = -t[:, None] * weights[layer - 1]
        matrix[block[layer], block[layer - 1]] += cross
        matrix[block[layer - 1], block[layer]] += cross.T
    matrix[block[-1], block[-1]] -= weights[-1].T @ weights[-1]
    return matrix


@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_the_stored_multipliers_prove_the_residual_map_1_lipschitz(depth: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = Frame(width=6, slopes=(0.1, 1.0), samples=rng.normal(size=(50, 3)))
    frozen = Residual(depth=depth).build(frame, rng).freeze()
    assert isinstance(frozen, ResidualScaffold)
    assert np.linalg.eigvalsh(lipschitz_matrix(frozen)).min() > -1e-9
    data = frozen.to_json()
    data["weights"][0] = (1.2 * np.array(data["weights"][0])).tolist()
    assert np.linalg.eigvalsh(lipschitz_matrix(ResidualScaffold.from_json(data))).min() < -1e-3


def trained_like(channels: int, depth: int = 1) -> ResidualScaffold:
    """A residual map with slopes in [0.1, 1], as training leaves one."""
    rng = np.random.default_rng(channels)
    frame = Frame(width=8, slopes=(0.1, 1.0), samples=rng.normal(size=(50, channels)))
    frozen = Residual(depth=depth).build(frame, rng).freeze()
    assert isinstance(frozen, ResidualScaffold)
    return frozen


def with_smaller_ball(honest: ResidualScaffold, factor: float) -> ResidualScaffold:
    """The same map, written as a smaller ball around a network that expands."""
    *inner, last = honest.network.weights
    network = replace(honest.network, weights=(*inner, factor * last))
    return replace(honest, beta=honest.beta / factor, network=network)


@pytest.mark.parametrize("channels", [1, 2])
def test_a_ball_that_the_multipliers_do_not_prove_is_not_believed(channels: int) -> None:
    """beta / 64 and 64 times the last weights are the same map: its Jacobians leave the small
    ball."""
    honest = trained_like(channels)
    liar = with_smaller_ball(honest, 64.0)
    points = np.random.default_rng(0).uniform(-3, 3, size=(200, channels))
    np.testing.assert_allclose(liar(points), honest(points), rtol=1e-12)
    assert is_proved_nonexpansive(honest.network, honest.multipliers)
    assert jacobian_ball(honest).method == "construction"
    assert jacobian_ball(honest).ball == JacobianBall(alpha=honest.alpha, beta=honest.beta)
    for scale in (1.0, 64.0, 4096.0):  # whatever multipliers stand beside it
        told = replace(liar, multipliers=tuple(scale * t for t in liar.multipliers))
        bound = jacobian_ball(told)
        jacobians = [told.jacobian(point) for point in points]
        eye = bound.ball.alpha * np.eye(channels)
        farthest = max(float(np.linalg.norm(j - eye, 2)) for j in jacobians)
        assert bound.method != "construction"
        assert liar.beta < farthest <= bound.ball.beta * (1 + 1e-9)


def test_neurons_steeper_than_one_are_not_believed_either() -> None:
    honest = trained_like(2)
    steep = tuple(64.0 * slopes for slopes in honest.network.positive_slopes)
    network = replace(honest.network, positive_slopes=steep)
    assert not is_proved_nonexpansive(network, honest.multipliers)


def test_a_certificate_with_the_small_ball_of_an_honest_map_is_refused() -> None:
    """Certified at a high rate with the small ball; at a true slope the loop is unstable."""
    honest = trained_like(1)
    liar = with_smaller_ball(honest, 64.0)
    system = StateSpace(
        a=np.array([[1.05, 0.2], [0.0, 0.9]]),
        b=np.array([[0.0], [1.0]]),
        c=np.eye(1, 2),
        d=np.zeros((1, 1)),
    )
    exact = JacobianBall(alpha=1.0, beta=0.0)
    small = Balls(input=JacobianBall(alpha=liar.alpha, beta=liar.beta), output=exact)
    wanted = RiccatiSynthesis(rate_controller=0.85, rate_observer=0.5, input_weight=1e-3)
    design = wanted.design(SimpleNamespace(linear=system), small)
    assert design.certified
    content = json.loads(json.dumps(design.to_json()))
    assert failed_checks(content, system, small) == []  # what was believed before
    slopes = [liar.jacobian(np.array([v]))[0, 0] for v in np.linspace(-3, 3, 400)]
    radii = [
        np.abs(np.linalg.eigvals(system.a + s * system.b @ design.state_feedback.k)).max()
        for s in slopes
    ]
    assert max(radii) > 1
    derived = Balls(input=jacobian_ball(liar).ball, output=exact)
    claims = failed_checks(content, system, derived)
    assert any("state_feedback.alpha, beta" in claim for claim in claims)


def test_the_perceptron_of_one_channel_can_saturate() -> None:
    """Both outer slopes at the floor, steep in the middle: out of reach of positive weights,
    whatever their values."""
    frame = Frame(width=8, slopes=(0.1, 1.0), samples=np.linspace(-1, 1, 50)[:, None])
    scaffold = Mlp(depth=1, train_slopes=True, certified=True).build(
        frame, np.random.default_rng(0)
    )
    scaffold.base_0.data.fill_(-30.0)
    scaffold.jumps_0.data[0], scaffold.jumps_0.data[-1] = 200.0, -200.0
    frozen = scaffold.freeze()
    slopes = [frozen.jacobian(np.array([v]))[0, 0] for v in (-5.0, 0.0, 5.0)]
    np.testing.assert_allclose(slopes, [0.1, 1.0, 0.1], atol=1e-9)
