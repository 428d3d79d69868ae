"""Every trainable scaffolding: frozen numbers give its values, slopes stay in the certified sector,
zero stays zero."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hydra.utils import instantiate
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.bounds.slopes import interval_bound, jacobian_ball
from ssm_study.models.scaffolds.mlp import Mlp, layer_slope_bounds
from ssm_study.models.scaffolds.residual import Residual
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.models.scaffolds.trainable import MapContext, Trainable
from ssm_study.models.torch_scaffold import TorchScaffold
from ssm_study.models.torch_ssm import InputMapping

CONF = Path(__file__).resolve().parents[2] / "conf"


def built(path: Path) -> Trainable:
    text = path.read_text()
    content = yaml.safe_load(text)
    spec = instantiate(content)
    assert isinstance(spec, Trainable)
    return spec


SCAFFOLD_FILES = sorted((CONF / "scaffold").glob("*.yaml"))
FROM_YAML = {path.stem: built(path) for path in SCAFFOLD_FILES}
SPECS = FROM_YAML | {
    "mlp fixed": Mlp(depth=1, train_slopes=False, certified=True),
    "mlp deep": Mlp(depth=3, train_slopes=True, certified=True),
    "mlp_free deep": Mlp(depth=2, train_slopes=True, certified=False),
    "residual deep": Residual(depth=2),
}
CERTIFIED = [name for name in SPECS if not name.startswith(("linear", "mlp_free"))]
LOWER = 0.1
UPPER = 1.5


def test_every_yaml_is_under_the_laws() -> None:
    assert {"linear", "mlp", "mlp_free", "monotone", "residual"} <= set(FROM_YAML)


def draw_normal(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    """Independent standard normal numbers in double precision."""
    return torch.from_numpy(rng.normal(size=shape))


def shaken(spec: Trainable, seed: int, channels: int) -> TorchScaffold:
    """A scaffolding far from where it starts: the certificate must not depend on training."""
    rng = np.random.default_rng(seed)
    slopes = (LOWER, UPPER)
    samples = rng.normal(size=(50, channels))
    frame = MapContext(width=6, slopes=slopes, samples=samples)
    scaffold = spec.build(frame, rng)
    with torch.no_grad():
        for parameter in scaffold.parameters():
            parameter += draw_normal(rng, *parameter.shape)
    return scaffold


@pytest.mark.parametrize("name", ["mlp", "monotone"])
@given(seed=st.integers(0, 10_000))
def test_roughness_is_the_variation_of_the_slope_over_its_largest(name: str, seed: int) -> None:
    """The roughness is checked by differences of the map between its kinks; at each kink at most a
    hundredth is rounded off."""
    scaffold = shaken(SPECS[name], seed, 1)
    pieces = scaffold.pieces()
    assert pieces is not None
    first_kinks = pieces[0].detach().numpy()
    kinks = np.sort(first_kinks.ravel())
    midpoints = (kinks[1:] + kinks[:-1]) / 2
    inside = np.concatenate([[kinks[0] - 1], midpoints, [kinks[-1] + 1]])
    bounds = np.concatenate([[-np.inf], kinks, [np.inf]])
    differences = np.diff(bounds)
    steps = np.minimum(1e-3, differences / 4)
    both_sides = np.stack([inside - steps, inside + steps])
    at = torch.from_numpy(both_sides[..., None])
    output = scaffold(at).detach().numpy()
    values = output[..., 0]
    kept = steps > 1e-7  # pieces that floats can tell apart
    difference = values[1] - values[0]
    widths = np.where(kept, 2 * steps, 1.0)
    slopes = (difference / widths)[kept]
    differences = np.diff(slopes)
    largest = slopes.max()
    variation = np.abs(differences).sum() / largest
    difference = variation - 0.01 * len(kinks)
    roughness = float(scaffold.roughness().detach())
    assert difference - 1e-3 <= roughness <= variation + 1e-3


@pytest.mark.parametrize("name", SPECS)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 3))
def test_frozen_numbers_give_the_same_values(name: str, seed: int, channels: int) -> None:
    scaffold = shaken(SPECS[name], seed, channels)
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(4, 5, channels)) * 3
    with torch.no_grad():
        actual = scaffold(torch.from_numpy(v)).numpy()
        expected = scaffold.freeze()(v)
        np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-11)


@given(seed=st.integers(0, 10_000), channels=st.integers(1, 3))
def test_every_neuron_of_the_first_layer_starts_with_its_kink_among_the_samples(
    seed: int, channels: int
) -> None:
    rng = np.random.default_rng(seed)
    samples = 3 + rng.uniform(size=(50, channels))  # all on one side of zero
    spec = Mlp(depth=1, train_slopes=True, certified=False)
    slopes = (LOWER, UPPER)
    frame = MapContext(width=6, slopes=slopes, samples=samples)
    scaffold = spec.build(frame, rng)
    parts = scaffold.explicit_parameters()[0]
    w, b, *_ = (part.detach().numpy() for part in parts)
    is_below = samples @ w.T + b < 0
    below = is_below.mean(axis=0)
    is_among_the_samples = (below > 0) & (below < 1)
    assert (is_among_the_samples).all()


def test_neighbouring_kinks_of_one_input_start_with_opposite_bends() -> None:
    rng = np.random.default_rng(0)
    slopes = (LOWER, UPPER)
    samples = rng.normal(size=(50, 1))
    frame = MapContext(width=6, slopes=slopes, samples=samples)
    mlp = Mlp(depth=1, train_slopes=True, certified=False)
    layer = mlp.build(frame, rng).explicit_parameters()[0]
    w, b, *_ = (p.detach() for p in layer)
    order = torch.argsort(-b / w[:, 0])
    bends = torch.sign(w[order, 0])
    expected = -bends[:-1]
    assert (bends[1:] == expected).all()


@pytest.mark.parametrize("name", SPECS)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 3))
def test_zero_maps_to_zero_exactly(name: str, seed: int, channels: int) -> None:
    scaffold = shaken(SPECS[name], seed, channels)
    v = torch.zeros(1, 3, channels, dtype=torch.float64)
    assert (scaffold(v) == 0).all()
    single_precision = scaffold.float()
    output_at_zero = single_precision(v.float())
    assert (output_at_zero == 0).all()


@pytest.mark.parametrize("name", CERTIFIED)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 3))
def test_sampled_jacobians_lie_in_the_certified_ball(name: str, seed: int, channels: int) -> None:
    torch_scaffold = shaken(SPECS[name], seed, channels)
    frozen = torch_scaffold.freeze()
    alpha = (UPPER + LOWER) / 2
    beta = (UPPER - LOWER) / 2
    rng = np.random.default_rng(seed)
    for v in rng.normal(size=(20, channels)) * 4:
        offset = frozen.jacobian(v) - alpha * np.eye(channels)
        norm = np.linalg.norm(offset, 2)
        assert norm <= beta * (1 + 1e-9)


@pytest.mark.parametrize("name", SPECS)
@given(seed=st.integers(0, 10_000), channels=st.integers(1, 3))
def test_every_kind_answers_every_question(name: str, seed: int, channels: int) -> None:
    """JSON keeps every bit; the Jacobian is the derivative and lies in the ball; what is exported
    is the same map."""
    torch_scaffold = shaken(SPECS[name], seed, channels)
    scaffold = torch_scaffold.freeze()
    rng = np.random.default_rng(seed)
    v = 3 * rng.normal(size=(8, channels))
    step = 1e-7
    text = json.dumps(scaffold.to_json())
    content = json.loads(text)
    again = Scaffold.from_json(content)
    assert np.array_equal(again(v), scaffold(v))
    actual = scaffold.as_portable()(v)
    np.testing.assert_allclose(actual, scaffold(v), rtol=1e-9, atol=1e-9)
    bound = interval_bound(scaffold.network) if scaffold.kind == "mlp" else jacobian_ball(scaffold)
    direction = rng.normal(size=channels)
    for at in v:
        ahead = scaffold(at + step * direction)
        behind = scaffold(at - step * direction)
        difference = ahead - behind
        slope = difference / (2 * step)
        actual = scaffold.jacobian(at) @ direction
        np.testing.assert_allclose(actual, slope, atol=1e-4, rtol=1e-4)
        alpha = bound.ball.alpha
        offset = scaffold.jacobian(at) - alpha * np.eye(channels)
        norm = np.linalg.norm(offset, 2)
        beta = bound.ball.beta
        upper_limit = beta * (1 + 1e-9) + 1e-12
        assert norm <= upper_limit


@pytest.mark.parametrize("name", [name for name in SPECS if "mlp" not in name])
def test_what_the_linear_part_takes_is_given_up(name: str) -> None:
    torch_scaffold = shaken(SPECS[name], 3, 2)
    scaffold = torch_scaffold.freeze()
    rng = np.random.default_rng(0)
    v = rng.normal(size=(9, 2))
    centre = scaffold.jacobian_centre()
    if centre is None:
        with pytest.raises(NotImplementedError):
            scaffold.compose_with_output_matrix(np.eye(2))
        return
    m = np.linalg.inv(centre)
    actual = scaffold.compose_with_output_matrix(m)(v)
    expected = scaffold(v) @ m.T
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    actual = scaffold.compose_with_input_matrix(m)(v)
    expected = scaffold(v @ m.T)
    np.testing.assert_allclose(actual, expected, atol=1e-9)


@given(seed=st.integers(0, 10_000))
def test_sampled_secants_lie_in_the_certified_sector(seed: int) -> None:
    """The loop feels secants, not derivatives: `mu <= (S(v) - S(w)) / (v - w) <= nu`."""
    even_points = np.linspace(-5, 5, 301)
    v = even_points[:, None]
    for name in CERTIFIED:
        frozen = shaken(SPECS[name], seed, 1).freeze()
        values = frozen(v)[:, 0]
        for stride in (1, 17):
            difference = values[stride:] - values[:-stride]
            widths = v[stride:, 0] - v[:-stride, 0]
            secant = difference / widths
            smallest = secant.min()
            assert smallest >= LOWER * (1 - 1e-9)
            largest = secant.max()
            assert largest <= UPPER * (1 + 1e-9)


def test_the_free_perceptron_leaves_the_sector() -> None:
    """Negative control: the paper's perceptron, unconstrained, has negative slopes for some
    parameters."""
    cases = itertools.product(range(5), (-2.0, 0.5, 2.0))
    slopes = [
        shaken(SPECS["mlp_free deep"], seed, 1).freeze().jacobian(np.array([v]))[0, 0]
        for seed, v in cases
    ]
    assert min(slopes) < 0


@pytest.mark.parametrize("name", [name for name in SPECS if name != "linear"])
@pytest.mark.parametrize("channels", [1, 2])
def test_gradients_agree_with_finite_differences(name: str, channels: int) -> None:
    scaffold = shaken(SPECS[name], 5, channels)
    rng = np.random.default_rng(6)
    v = draw_normal(rng, 7, channels)
    rng = np.random.default_rng(7)
    weight = draw_normal(rng, 7, channels)
    (scaffold(v) * weight).sum().backward()
    for parameter in scaffold.parameters():
        if not parameter.requires_grad:
            continue
        rng = np.random.default_rng(8)
        direction = draw_normal(rng, *parameter.shape)
        values = []
        with torch.no_grad():
            for step in (1e-6, -2e-6):
                parameter += step * direction
                weighted_output = scaffold(v) * weight
                item = weighted_output.sum().item()
                values.append(item)
            parameter += 1e-6 * direction
        difference = values[0] - values[1]
        expected = difference / 2e-6
        assert parameter.grad is not None
        directional = parameter.grad * direction
        item = directional.sum().item()
        assert item == pytest.approx(expected, rel=1e-5, abs=1e-7)


@given(depth=st.integers(1, 5), channels=st.integers(1, 4), ratio=st.floats(0.001, 0.9))
def test_layer_sectors_compose_to_the_sector_asked(depth: int, channels: int, ratio: float) -> None:
    low, high = layer_slope_bounds(ratio, 1.0, depth, channels)
    assert 0 < low < high
    if channels == 1:
        assert low**depth == pytest.approx(ratio)
        assert high**depth == pytest.approx(1.0)
    centre = (high + low) / 2
    relative = (high - low) / (high + low)
    if channels > 1 and depth > 1:  # the ball of products: centre a^L, radius a^L ((1 + d)^L - 1)
        expected = (1 + ratio) / 2
        assert centre**depth == pytest.approx(expected)
        expected = (1 - ratio) / 2
        radius_of_a_layer = (1 + relative) ** depth - 1
        assert centre**depth * radius_of_a_layer == pytest.approx(expected)


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("distinct", [5, 10_000])
def test_prepared_inputs_pass_as_they_are(name: str, distinct: int) -> None:
    """Once per level, sorted into runs, or directly: the same values and the same gradients."""
    scaffold = shaken(SPECS[name], 11, 1)
    rng = np.random.default_rng(1)
    levels = rng.integers(-distinct, distinct, size=(3, 200, 1))
    u = torch.from_numpy(levels * (2.0 / distinct))
    rng = np.random.default_rng(2)
    weight = draw_normal(rng, 3, 200, 1)
    gradients = []
    evaluations = (lambda: InputMapping(u)(scaffold), lambda: scaffold(u))
    for evaluate in evaluations:
        scaffold.zero_grad()
        values = evaluate()
        if values.requires_grad:
            (values * weight).sum().backward()
        of_parameters = [p.grad.clone() for p in scaffold.parameters() if p.grad is not None]
        gradients.append([values.detach(), *of_parameters])
    for prepared, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(prepared, plain, rtol=1e-9, atol=1e-9)
