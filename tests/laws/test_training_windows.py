"""Windows of a record train on the same error as the record, and shooting without defects is single
shooting."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from models_cases import data_set
from test_training_identify import LBFGS, spec, training
from torch import Tensor

from ssm_study.models.baselines.recurrent import RecurrentSpec
from ssm_study.models.scaffolds.mlp import Mlp
from ssm_study.models.scaffolds.monotone import Monotone
from ssm_study.models.spec import ModelSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet, Trajectory
from ssm_study.training.fit import TorchFit, TrainingBatch
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.optimisers import Levenberg, OptimiserSpec
from ssm_study.training.windows import Windows

CERTIFIED_MLP = Mlp(depth=2, train_slopes=True, certified=True)
RING = spec(start="ring", order=5, real_modes=1, scaffold_in=CERTIFIED_MLP)
MODELS = {
    "ssm": spec(order=3, scaffold_out=Monotone()),
    "ring": RING,
    "gru": RecurrentSpec(cell="gru", hidden=3),
    "lstm": RecurrentSpec(cell="lstm", hidden=3),
}
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
SHOOTING = Windows(samples=40, continuity_weight=2.0)


def unequal(samples: int = 100) -> DataSet:
    """Two records, the second shorter; neither a multiple of the windows below."""
    data = data_set(noise=0.1, samples=samples, records=2)
    first, second = data.training
    u = second.u[:-17]
    y = second.y[:-17]
    short = dataclasses.replace(second, u=u, y=y)
    return dataclasses.replace(data, training=(first, short))


def fit_of(
    model: ModelSpec, data: DataSet, windows: Windows | None = None, **settings: Any
) -> TorchFit:
    settings_of_windows = {"windows": windows or Windows(), **settings}
    model_to_train = model.build(data, 0)
    return TorchFit(model_to_train, data, training(**settings_of_windows))


def step_of(fit: TorchFit) -> tuple[Tensor, dict[str, Tensor]]:
    """The objective, and its gradient by the names of the model's parameters."""
    loss = fit.training_loss()
    loss.backward()
    gradients = {}
    for name, parameter in fit.model.named_parameters():
        if parameter.grad is not None:
            gradients[name] = parameter.grad
    return loss.detach(), gradients


def assert_close(actual: Tensor, expected: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@each_model
def test_two_halves_are_the_whole(model: ModelSpec) -> None:
    """A run over a part, then over the rest from where it ended, is the run over both; `forward`
    agrees."""
    data = unequal()
    net = model.build(data, 0)
    u = torch.randn(3, 60, 1, dtype=torch.float64)
    x0 = torch.randn(3, net.states, dtype=torch.float64)
    whole, end = net.simulate_with_final_state(u, x0)
    head, middle = net.simulate_with_final_state(u[:, :23], x0)
    tail, end_of_tail = net.simulate_with_final_state(u[:, 23:], middle)
    joined = torch.cat([head, tail], 1)
    assert_close(joined, whole, 1e-9)
    assert_close(end_of_tail, end, 1e-9)
    in_one_run = net(u, x0)
    assert_close(in_one_run, whole, 1e-12)
    zero = torch.zeros_like(x0)
    from_zero = net(u, zero)
    assert_close(net(u), from_zero, 1e-9)


@each_model
def test_a_window_as_long_as_the_record_is_the_record(model: ModelSpec) -> None:
    data = data_set(noise=0.1, samples=80, records=2)
    one_window = Windows(samples=80, continuity_weight=1.0)
    windowed_fit = fit_of(model, data, one_window)
    loss, gradient = step_of(windowed_fit)
    whole_fit = fit_of(model, data)
    expected, reference = step_of(whole_fit)
    torch.testing.assert_close(loss, expected, rtol=1e-12, atol=0)
    for name, value in reference.items():
        torch.testing.assert_close(gradient[name], value, rtol=1e-9, atol=1e-12)


@each_model
def test_shooting_without_defects_is_single_shooting(model: ModelSpec) -> None:
    data = unequal()
    fit = fit_of(model, data, SHOOTING)
    whole = fit_of(model, data)
    y_hat, defects = fit.simulate_windows()
    expected = (4, fit.model.states)
    assert defects.shape == expected  # 100 and 83 samples in windows of 40: three each
    largest = defects.abs().max()
    assert largest < 1e-9
    actual = fit.training_records.squared_error(y_hat)
    free_run = whole.simulate_windows()[0]
    expected = whole.training_records.squared_error(free_run)
    torch.testing.assert_close(actual, expected)


def sorted_scored_outputs(records: TrainingBatch) -> Tensor:
    is_scored = records.scored.bool()
    scored = records.y[is_scored]
    return scored.sort().values


@pytest.mark.parametrize("start_up", [0, 7])
@pytest.mark.parametrize("windows", [Windows(samples=30), SHOOTING])
def test_every_sample_is_scored_once(windows: Windows, start_up: int) -> None:
    data = unequal()
    data = dataclasses.replace(data, start_up_samples=start_up)
    gru = MODELS["gru"]
    cut = fit_of(gru, data, windows).training_records
    whole = fit_of(gru, data).training_records
    scored_in_windows = sorted_scored_outputs(cut)
    scored = sorted_scored_outputs(whole)
    assert_close(scored_in_windows, scored, 0)
    actual = cut.weight.max()
    expected = whole.weight.max()
    torch.testing.assert_close(actual, expected)


@torch.no_grad()
def move_parameters(parameters: list[Tensor], direction: list[Tensor], distance: float) -> None:
    """Move all parameters along a direction, in place."""
    for parameter, along in zip(parameters, direction, strict=True):
        parameter += distance * along


def loss_at(
    fit: TorchFit, parameters: list[Tensor], direction: list[Tensor], distance: float
) -> float:
    """The training loss at a distance along a direction; the parameters come back."""
    move_parameters(parameters, direction, distance)
    loss = fit.training_loss()
    move_parameters(parameters, direction, -distance)
    return float(loss)


@each_model
def test_the_gradient_of_shooting_is_that_of_finite_differences(model: ModelSpec) -> None:
    """Along a random direction through all parameters, states of the windows included, away from
    zero defects."""
    data = unequal()
    fit = fit_of(model, data, SHOOTING, integrated_share=0.3)
    assert fit.starts is not None
    generator = torch.Generator()
    rng = generator.manual_seed(1)
    random = {"generator": rng, "dtype": torch.float64}
    parameters = [p for p in fit.parameters() if p.requires_grad]
    with torch.no_grad():
        free = fit.starts.free
        noise = torch.randn(free.shape, **random)
        fit.starts.free += 0.3 * noise
    direction = [torch.randn(p.shape, **random) for p in parameters]
    loss = fit.training_loss()
    gradients = torch.autograd.grad(loss, parameters)
    slope = 0.0
    for gradient, along in zip(gradients, direction, strict=True):
        slope += float((gradient * along).sum())
    ahead = loss_at(fit, parameters, direction, 1e-6)
    behind = loss_at(fit, parameters, direction, -1e-6)
    difference = ahead - behind
    quotient = difference / 2e-6
    assert quotient == pytest.approx(slope, rel=1e-5)


def test_the_residuals_of_shooting_are_its_objective() -> None:
    """Levenberg-Marquardt squares what the others minimise, defects included."""
    data = unequal()
    fit = fit_of(MODELS["ssm"], data, SHOOTING)
    assert fit.starts is not None
    with torch.no_grad():
        fit.starts.free += 0.5
    parameters = [p for p in fit.parameters() if p.requires_grad]
    trained = [parameter.detach().flatten() for parameter in parameters]
    flat = torch.cat(trained)
    objective = fit.training_loss()
    residuals = fit.residuals_at(flat)
    actual = residuals.square().sum()
    expected = objective.detach()
    torch.testing.assert_close(actual, expected)
    defects = fit.simulate_windows()[1]
    squared = defects.square().sum()
    assert squared > 0.1


LONG_WINDOWS = Windows(samples=100, continuity_weight=1.0)
TWO_STEPS = {"steps_per_epoch": 2, "damping": 0.01}
LEVENBERG = Levenberg(longest_step=0.5, **TWO_STEPS)
SHOOTING_METHODS = [(LBFGS, LONG_WINDOWS), (LEVENBERG, LONG_WINDOWS)]


@pytest.mark.parametrize(("optimiser", "windows"), SHOOTING_METHODS)
def test_windows_find_the_system(
    optimiser: OptimiserSpec, windows: Windows, tmp_path: Path
) -> None:
    data = data_set()
    settings = training(optimiser, windows=windows, max_epochs=12)
    identified = settings.identify(spec(), data, 0, tmp_path)
    model = identified.model
    test_fit = records_fit_percent(model, data.test, data)
    assert test_fit > 95.0  # a linear input map stops below 93
    curve = [row["fit_training_percent"] for row in identified.curve]
    training_fit = records_fit_percent(model, data.training, data)
    # The curve shows whole records.
    assert training_fit == pytest.approx(max(curve), abs=0.5)


def cut_from_motion(record: Trajectory) -> Trajectory:
    """Samples 60 to 260 of a record."""
    u = record.u[60:260]
    y = record.y[60:260]
    return dataclasses.replace(record, u=u, y=y)


def test_records_in_motion_are_shot_at_too(tmp_path: Path) -> None:
    """The first window's state is estimated as a whole record's would be; the curve starts whole
    records from it."""
    data = data_set(samples=260, records=4)
    moving = tuple(cut_from_motion(record) for record in data.training)
    data = dataclasses.replace(data, training=moving)
    windows = Windows(samples=50, continuity_weight=1.0)
    models = {}
    training_fits = {}
    for state in ("zero", "estimated"):
        settings = training(initial_state=state, windows=windows, max_epochs=10)
        folder = tmp_path / state
        identified = settings.identify(spec(), data, 0, folder)
        models[state] = identified.model
        last_row = identified.curve[-1]
        training_fits[state] = last_row["fit_training_percent"]
    test_fit = records_fit_percent(models["estimated"], data.test, data)
    assert test_fit > 97.0
    largest = max(97.0, training_fits["zero"] + 1.0)
    assert training_fits["estimated"] > largest


def test_equal_seeds_and_float32_shoot_alike(tmp_path: Path) -> None:
    data = data_set(noise=0.05, samples=120)
    settings = training(windows=SHOOTING, max_epochs=3)
    gru = MODELS["gru"]
    first = settings.identify(gru, data, 3, tmp_path / "first")
    second = settings.identify(gru, data, 3, tmp_path / "second")
    assert first.model.to_json() == second.model.to_json()
    # Two steps an epoch go less far.
    least_fits = ((settings.optimiser, 80.0), (LEVENBERG, 50.0))
    for optimiser, least in least_fits:
        single = dataclasses.replace(settings, precision=32, optimiser=optimiser)
        folder = tmp_path / type(optimiser).__name__
        low = single.identify(spec(), data, 3, folder)
        training_fit = records_fit_percent(low.model, data.training, data)
        assert training_fit > least


NAN = float("nan")
REFUSED_WEIGHTS = [
    ({"samples": 40, "continuity_weight": -1.0}, r"training.windows.continuity_weight = -1"),
    ({"samples": 40, "continuity_weight": NAN}, r"training.windows.continuity_weight = nan"),
    ({"samples": 40, "continuity_weight": 0.0}, r"training.windows.continuity_weight = 0"),
]
REFUSED_SAMPLES = ({"samples": 1}, r"training.windows.samples = 1")


@pytest.mark.parametrize(("changes", "words"), [REFUSED_SAMPLES, *REFUSED_WEIGHTS])
def test_windows_out_of_range_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(BadRequest, match=words):
        Windows(**changes)


def test_a_window_that_no_record_can_fill_is_refused(tmp_path: Path) -> None:
    data = unequal()
    windows = Windows(samples=90)
    settings = training(windows=windows)
    words = r"samples = 90: the record training_1 has only 83 samples"
    model = spec()
    with pytest.raises(BadRequest, match=words):
        settings.identify(model, data, 0, tmp_path)
    late = dataclasses.replace(data, start_up_samples=40)
    settings = training(windows=SHOOTING)
    with pytest.raises(BadRequest, match="40 start-up samples leave nothing"):
        settings.identify(model, late, 0, tmp_path)
