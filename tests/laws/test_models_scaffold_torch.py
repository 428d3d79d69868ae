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

REPOSITORY = Path(__file__).resolve().parents[2]
CONF = REPOSITORY / "conf"


def built(path: Path) -> Trainable:
    text = path.read_text()
    content = yaml.safe_load(text)
    spec = instantiate(content)
    assert isinstance(spec, Trainable)
    return spec


SCAFFOLD_FILES = sorted((CONF / "scaffold").glob("*.yaml"))
FROM_YAML = {path.stem: built(path) for path in SCAFFOLD_FILES}
FROM_CODE = {
    "mlp fixed": Mlp(depth=1, train_slopes=False, certified=True),
    "mlp deep": Mlp(depth=3, train_slopes=True, certified=True),
    "mlp_free deep": Mlp(depth=2, train_slopes=True, certified=False),
    "residual deep": Residual(depth=2),
}
SPECS = FROM_YAML | FROM_CODE
SEEDS = st.integers(0, 10_000)
CHANNELS = st.integers(1, 3)
CERTIFIED = [name for name in SPECS if not name.startswith(("linear", "mlp_free"))]
LOWER = 0.1
UPPER = 1.5


def test_every_yaml_is_under_the_laws() -> None:
    expected = {"linear", "mlp", "mlp_free", "monotone", "residual"}
    assert expected <= set(FROM_YAML)


def draw_normal(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    """Independent standard normal numbers in double precision."""
    values = rng.normal(size=shape)
    return torch.from_numpy(values)


def shaken(spec: Trainable, seed: int, channels: int) -> TorchScaffold:
    """A scaffolding far from where it starts: the certificate must not depend on training."""
    rng = np.random.default_rng(seed)
    slopes = (LOWER, UPPER)
    samples = rng.normal(size=(50, channels))
    frame = MapContext(width=6, slopes=slopes, samples=samples)
    scaffold = spec.build(frame, rng)
    with torch.no_grad():
        for parameter in scaffold.parameters():
            change = draw_normal(rng, *parameter.shape)
            parameter += change
    return scaffold


WITH_ROUGHNESS = ["mlp", "monotone"]


@pytest.mark.parametrize("name", WITH_ROUGHNESS)
@given(seed=SEEDS)
def test_roughness_is_the_variation_of_the_slope_over_its_largest(name: str, seed: int) -> None:
    """The roughness is checked by differences of the map between its kinks; at each kink at most a
    hundredth is rounded off."""
    scaffold = shaken(SPECS[name], seed, 1)
    pieces = scaffold.affine_pieces()
    assert pieces is not None
    first_kinks = pieces[0].detach().numpy()
    all_kinks = first_kinks.ravel()
    kinks = np.sort(all_kinks)
    sums_of_neighbours = kinks[1:] + kinks[:-1]
    midpoints = sums_of_neighbours / 2
    before = kinks[0] - 1
    after = kinks[-1] + 1
    points_inside = [[before], midpoints, [after]]
    inside = np.concatenate(points_inside)
    parts = [[-np.inf], kinks, [np.inf]]
    bounds = np.concatenate(parts)
    differences = np.diff(bounds)
    steps = np.minimum(1e-3, differences / 4)
    points = [inside - steps, inside + steps]
    both_sides = np.stack(points)
    column = both_sides[..., None]
    at = torch.from_numpy(column)
    values_there = scaffold(at).detach()
    output = values_there.numpy()
    values = output[..., 0]
    is_wide = steps > 1e-7  # pieces that floats can tell apart
    difference = values[1] - values[0]
    widths = np.where(is_wide, 2 * steps, 1.0)
    slopes = (difference / widths)[is_wide]
    differences = np.diff(slopes)
    largest = slopes.max()
    sum_of_changes = np.abs(differences).sum()
    variation = sum_of_changes / largest
    difference = variation - 0.01 * len(kinks)
    measured = scaffold.roughness()
    roughness = float(measured.detach())
    assert difference - 1e-3 <= roughness <= variation + 1e-3


@pytest.mark.parametrize("name", SPECS)
@given(seed=SEEDS, channels=CHANNELS)
def test_frozen_numbers_give_the_same_values(name: str, seed: int, channels: int) -> None:
    scaffold = shaken(SPECS[name], seed, channels)
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(4, 5, channels))
    v = normal * 3
    with torch.no_grad():
        inputs = torch.from_numpy(v)
        outputs = scaffold(inputs)
        actual = outputs.numpy()
        expected = scaffold.to_numpy()(v)
        np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-11)


@given(seed=SEEDS, channels=CHANNELS)
def test_every_neuron_of_the_first_layer_starts_with_its_kink_among_the_samples(
    seed: int, channels: int
) -> None:
    rng = np.random.default_rng(seed)
    uniform = rng.uniform(size=(50, channels))
    samples = 3 + uniform  # all on one side of zero
    spec = Mlp(depth=1, train_slopes=True, certified=False)
    slopes = (LOWER, UPPER)
    frame = MapContext(width=6, slopes=slopes, samples=samples)
    scaffold = spec.build(frame, rng)
    parts = scaffold.explicit_parameters()[0]
    w, b, *_ = (part.detach().numpy() for part in parts)
    projected = samples @ w.T + b
    is_below = projected < 0
    below = is_below.mean(axis=0)
    is_among_the_samples = (below > 0) & (below < 1)
    assert is_among_the_samples.all()


def test_neighbouring_kinks_of_one_input_start_with_opposite_bends() -> None:
    rng = np.random.default_rng(0)
    slopes = (LOWER, UPPER)
    samples = rng.normal(size=(50, 1))
    frame = MapContext(width=6, slopes=slopes, samples=samples)
    mlp = Mlp(depth=1, train_slopes=True, certified=False)
    layers = mlp.build(frame, rng).explicit_parameters()
    layer = layers[0]
    w, b, *_ = (p.detach() for p in layer)
    kinks = -b / w[:, 0]
    order = torch.argsort(kinks)
    bends_of_neurons = w[order, 0]
    bends = torch.sign(bends_of_neurons)
    expected = -bends[:-1]
    next_bends = bends[1:]
    assert (next_bends == expected).all()


@pytest.mark.parametrize("name", SPECS)
@given(seed=SEEDS, channels=CHANNELS)
def test_zero_maps_to_zero_exactly(name: str, seed: int, channels: int) -> None:
    scaffold = shaken(SPECS[name], seed, channels)
    v = torch.zeros(1, 3, channels, dtype=torch.float64)
    is_zero = scaffold(v) == 0
    assert is_zero.all()
    single_precision = scaffold.float()
    output_at_zero = single_precision(v.float())
    assert (output_at_zero == 0).all()


@pytest.mark.parametrize("name", CERTIFIED)
@given(seed=SEEDS, channels=CHANNELS)
def test_sampled_jacobians_lie_in_the_certified_ball(name: str, seed: int, channels: int) -> None:
    torch_scaffold = shaken(SPECS[name], seed, channels)
    frozen = torch_scaffold.to_numpy()
    alpha = (UPPER + LOWER) / 2
    beta = (UPPER - LOWER) / 2
    rng = np.random.default_rng(seed)
    inputs = rng.normal(size=(20, channels)) * 4
    for v in inputs:
        jacobian = frozen.jacobian(v)
        identity = np.eye(channels)
        offset = jacobian - alpha * identity
        norm = np.linalg.norm(offset, 2)
        assert norm <= beta * (1 + 1e-9)


@pytest.mark.parametrize("name", SPECS)
@given(seed=SEEDS, channels=CHANNELS)
def test_every_kind_answers_every_question(name: str, seed: int, channels: int) -> None:
    """JSON keeps every bit; the Jacobian is the derivative and lies in the ball; what is exported
    is the same map."""
    torch_scaffold = shaken(SPECS[name], seed, channels)
    scaffold = torch_scaffold.to_numpy()
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(8, channels))
    v = 3 * normal
    step = 1e-7
    document = scaffold.to_json()
    text = json.dumps(document)
    content = json.loads(text)
    again = Scaffold.from_json(content)
    outputs = scaffold(v)
    assert np.array_equal(again(v), outputs)
    portable = scaffold.as_portable()
    actual = portable(v)
    np.testing.assert_allclose(actual, outputs, rtol=1e-9, atol=1e-9)
    bound = interval_bound(scaffold.network) if scaffold.kind == "mlp" else jacobian_ball(scaffold)
    direction = rng.normal(size=channels)
    for at in v:
        ahead = scaffold(at + step * direction)
        behind = scaffold(at - step * direction)
        difference = ahead - behind
        slope = difference / (2 * step)
        jacobian = scaffold.jacobian(at)
        actual = jacobian @ direction
        np.testing.assert_allclose(actual, slope, atol=1e-4, rtol=1e-4)
        alpha = bound.ball.alpha
        jacobian = scaffold.jacobian(at)
        identity = np.eye(channels)
        offset = jacobian - alpha * identity
        norm = np.linalg.norm(offset, 2)
        beta = bound.ball.beta
        widened = beta * (1 + 1e-9)
        upper_limit = widened + 1e-12
        assert norm <= upper_limit


NO_PERCEPTRONS = [name for name in SPECS if "mlp" not in name]


@pytest.mark.parametrize("name", NO_PERCEPTRONS)
def test_what_the_linear_part_takes_is_given_up(name: str) -> None:
    torch_scaffold = shaken(SPECS[name], 3, 2)
    scaffold = torch_scaffold.to_numpy()
    rng = np.random.default_rng(0)
    v = rng.normal(size=(9, 2))
    centre = scaffold.jacobian_centre()
    if centre is None:
        identity = np.eye(2)
        with pytest.raises(NotImplementedError):
            scaffold.compose_with_output_matrix(identity)
        return
    m = np.linalg.inv(centre)
    actual = scaffold.compose_with_output_matrix(m)(v)
    expected = scaffold(v) @ m.T
    np.testing.assert_allclose(actual, expected, atol=1e-9)
    actual = scaffold.compose_with_input_matrix(m)(v)
    expected = scaffold(v @ m.T)
    np.testing.assert_allclose(actual, expected, atol=1e-9)


@given(seed=SEEDS)
def test_sampled_secants_lie_in_the_certified_sector(seed: int) -> None:
    """The loop feels secants, not derivatives: `mu <= (S(v) - S(w)) / (v - w) <= nu`."""
    even_points = np.linspace(-5, 5, 301)
    v = even_points[:, None]
    for name in CERTIFIED:
        torch_scaffold = shaken(SPECS[name], seed, 1)
        frozen = torch_scaffold.to_numpy()
        values = frozen(v)[:, 0]
        for stride in (1, 17):
            later = values[stride:]
            earlier = values[:-stride]
            difference = later - earlier
            later_v = v[stride:, 0]
            earlier_v = v[:-stride, 0]
            widths = later_v - earlier_v
            secant = difference / widths
            smallest = secant.min()
            assert smallest >= LOWER * (1 - 1e-9)
            largest = secant.max()
            assert largest <= UPPER * (1 + 1e-9)


def test_the_free_perceptron_leaves_the_sector() -> None:
    """Negative control: the paper's perceptron, unconstrained, has negative slopes for some
    parameters."""
    points = (-2.0, 0.5, 2.0)
    cases = itertools.product(range(5), points)
    slopes = []
    for seed, v in cases:
        scaffold = shaken(SPECS["mlp_free deep"], seed, 1).to_numpy()
        jacobian = scaffold.jacobian(np.array([v]))
        slopes.append(jacobian[0, 0])
    assert min(slopes) < 0


NONLINEAR = [name for name in SPECS if name != "linear"]


@pytest.mark.parametrize("name", NONLINEAR)
@pytest.mark.parametrize("channels", [1, 2])
def test_gradients_agree_with_finite_differences(name: str, channels: int) -> None:
    scaffold = shaken(SPECS[name], 5, channels)
    rng = np.random.default_rng(6)
    v = draw_normal(rng, 7, channels)
    rng = np.random.default_rng(7)
    weight = draw_normal(rng, 7, channels)
    loss = (scaffold(v) * weight).sum()
    loss.backward()
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
                loss = weighted_output.sum()
                item = loss.item()
                values.append(item)
            parameter += 1e-6 * direction
        difference = values[0] - values[1]
        expected = difference / 2e-6
        assert parameter.grad is not None
        directional = parameter.grad * direction
        total = directional.sum()
        item = total.item()
        approximate = pytest.approx(expected, rel=1e-5, abs=1e-7)
        assert item == approximate


DEPTHS = st.integers(1, 5)
MORE_CHANNELS = st.integers(1, 4)
RATIOS = st.floats(0.001, 0.9)


@given(depth=DEPTHS, channels=MORE_CHANNELS, ratio=RATIOS)
def test_layer_sectors_compose_to_the_sector_asked(depth: int, channels: int, ratio: float) -> None:
    low, high = layer_slope_bounds(ratio, 1.0, depth, channels)
    assert 0 < low < high
    if channels == 1:
        approximate_ratio = pytest.approx(ratio)
        assert low**depth == approximate_ratio
        approximate_one = pytest.approx(1.0)
        assert high**depth == approximate_one
    centre = (high + low) / 2
    relative = (high - low) / (high + low)
    if channels > 1 and depth > 1:  # the ball of products: centre a^L, radius a^L ((1 + d)^L - 1)
        expected = (1 + ratio) / 2
        approximate_centre = pytest.approx(expected)
        assert centre**depth == approximate_centre
        expected = (1 - ratio) / 2
        grown = (1 + relative) ** depth
        radius_of_a_layer = grown - 1
        radius = centre**depth * radius_of_a_layer
        approximate_radius = pytest.approx(expected)
        assert radius == approximate_radius


LEVELS = [5, 10_000]


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("distinct", LEVELS)
def test_prepared_inputs_pass_as_they_are(name: str, distinct: int) -> None:
    """Once per level, sorted into runs, or directly: the same values and the same gradients."""
    scaffold = shaken(SPECS[name], 11, 1)
    rng = np.random.default_rng(1)
    levels = rng.integers(-distinct, distinct, size=(3, 200, 1))
    values_of_u = levels * (2.0 / distinct)
    u = torch.from_numpy(values_of_u)
    rng = np.random.default_rng(2)
    weight = draw_normal(rng, 3, 200, 1)
    gradients = []
    evaluations = (lambda: InputMapping(u)(scaffold), lambda: scaffold(u))
    for evaluate in evaluations:
        scaffold.zero_grad()
        values = evaluate()
        if values.requires_grad:
            loss = (values * weight).sum()
            loss.backward()
        of_parameters = [p.grad.clone() for p in scaffold.parameters() if p.grad is not None]
        detached = values.detach()
        gradients.append([detached, *of_parameters])
    pairs = zip(*gradients, strict=True)
    for prepared, plain in pairs:
        torch.testing.assert_close(prepared, plain, rtol=1e-9, atol=1e-9)
