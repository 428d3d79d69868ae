"""The claims of a scaffolding about itself, checked by another route."""

import numpy as np
import pytest

from ssm_study.models.scaffolds.mlp import Mlp
from ssm_study.models.scaffolds.residual import Residual, ResidualScaffold
from ssm_study.models.scaffolds.scaffold import Frame


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
