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
from ssm_study.signals import DataSet
from ssm_study.training.fit import Fit
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.optimisers import Levenberg, OptimiserSpec
from ssm_study.training.windows import Windows

CERTIFIED_MLP = Mlp(depth=2, train_slopes=True, certified=True)
MODELS = {
    "ssm": spec(order=3, scaffold_out=Monotone()),
    "ring": spec(start="ring", order=5, real_modes=1, scaffold_in=CERTIFIED_MLP),
    "gru": RecurrentSpec(cell="gru", hidden=3),
    "lstm": RecurrentSpec(cell="lstm", hidden=3),
}
each_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
SHOOTING = Windows(samples=40, continuity_weight=2.0)


def unequal(samples: int = 100) -> DataSet:
    """Two records, the second shorter; neither a multiple of the windows below."""
    data = data_set(noise=0.1, samples=samples, records=2)
    training_u = data.training[1].u
    u = training_u[:-17]
    training_y = data.training[1].y
    y = training_y[:-17]
    short = dataclasses.replace(data.training[1], u=u, y=y)
    training_records = (data.training[0], short)
    return dataclasses.replace(data, training=training_records)


def fit_of(model: ModelSpec, data: DataSet, windows: Windows | None = None, **settings: Any) -> Fit:
    settings_of_windows = {"windows": windows or Windows(), **settings}
    model_to_train = model.build(data, 0)
    return Fit(model_to_train, data, training(**settings_of_windows))


def step_of(fit: Fit) -> tuple[Tensor, dict[str, Tensor]]:
    """The objective, and its gradient by the names of the model's parameters."""
    loss = fit.training_loss()
    loss.backward()
    gradients = {n: p.grad for n, p in fit.model.named_parameters() if p.grad is not None}
    return loss.detach(), gradients


@each_model
def test_two_halves_are_the_whole(model: ModelSpec) -> None:
    """`advance` over a part, then over the rest from where it ended, is the run over both;
    `forward` agrees."""
    net = model.build(unequal(), 0)
    u = torch.randn(3, 60, 1, dtype=torch.float64)
    x0 = torch.randn(3, net.states, dtype=torch.float64)
    whole, end = net.advance(u, x0)
    head, middle = net.advance(u[:, :23], x0)
    tail, end_of_tail = net.advance(u[:, 23:], middle)
    actual = torch.cat([head, tail], 1)
    torch.testing.assert_close(actual, whole, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(end_of_tail, end, rtol=1e-9, atol=1e-9)
    actual = net(u, x0)
    torch.testing.assert_close(actual, whole, rtol=1e-12, atol=1e-12)
    from_zero = net(u, torch.zeros_like(x0))
    torch.testing.assert_close(net(u), from_zero, rtol=1e-9, atol=1e-9)


@each_model
def test_a_window_as_long_as_the_record_is_the_record(model: ModelSpec) -> None:
    data = data_set(noise=0.1, samples=80, records=2)
    (loss, gradient), (expected, reference) = (
        step_of(fit_of(model, data, windows))
        for windows in (Windows(samples=80, continuity_weight=1.0), None)
    )
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


@pytest.mark.parametrize("start_up", [0, 7])
@pytest.mark.parametrize("windows", [Windows(samples=30), SHOOTING])
def test_every_sample_is_scored_once(windows: Windows, start_up: int) -> None:
    data = dataclasses.replace(unequal(), start_up_samples=start_up)
    fit = fit_of(MODELS["gru"], data, windows)
    cut = fit.training_records
    fit = fit_of(MODELS["gru"], data)
    whole = fit.training_records
    scored = [records.y[records.scored.bool()].sort().values for records in (cut, whole)]
    torch.testing.assert_close(*scored, rtol=0, atol=0)
    actual = cut.weight.max()
    expected = whole.weight.max()
    torch.testing.assert_close(actual, expected)


@each_model
def test_the_gradient_of_shooting_is_that_of_finite_differences(model: ModelSpec) -> None:
    """Along a random direction through all parameters, states of the windows included, away from
    zero defects."""
    fit = fit_of(model, unequal(), SHOOTING, integrated_share=0.3)
    assert fit.starts is not None
    generator = torch.Generator()
    rng = generator.manual_seed(1)
    parameters = [p for p in fit.parameters() if p.requires_grad]
    with torch.no_grad():
        free = fit.starts.free
        noise = torch.randn(free.shape, generator=rng, dtype=torch.float64)
        fit.starts.free += 0.3 * noise
    direction = [torch.randn(p.shape, generator=rng, dtype=torch.float64) for p in parameters]
    loss = fit.training_loss()
    slope = sum(
        (g * d).sum() for g, d in zip(torch.autograd.grad(loss, parameters), direction, strict=True)
    )
    seen = []
    for side in (1e-6, -1e-6):
        with torch.no_grad():
            for p, d in zip(parameters, direction, strict=True):
                p += side * d
            moved = fit.training_loss()
            for p, d in zip(parameters, direction, strict=True):
                p -= side * d
        seen.append(float(moved))
    difference = seen[0] - seen[1]
    quotient = difference / 2e-6
    assert quotient == pytest.approx(float(slope), rel=1e-5)


def test_the_residuals_of_shooting_are_its_objective() -> None:
    """Levenberg-Marquardt squares what the others minimise, defects included."""
    fit = fit_of(MODELS["ssm"], unequal(), SHOOTING)
    assert fit.starts is not None
    with torch.no_grad():
        fit.starts.free += 0.5
    trained = [p.detach().flatten() for p in fit.parameters() if p.requires_grad]
    flat = torch.cat(trained)
    objective = fit.training_loss()
    actual = fit.residuals_at(flat).square().sum()
    expected = objective.detach()
    torch.testing.assert_close(actual, expected)
    defects = fit.simulate_windows()[1]
    assert defects.square().sum() > 0.1


LONG_WINDOWS = Windows(samples=100, continuity_weight=1.0)
LEVENBERG = Levenberg(steps_per_epoch=2, damping=0.01, longest_step=0.5)


@pytest.mark.parametrize(
    ("optimiser", "windows"), [(LBFGS, LONG_WINDOWS), (LEVENBERG, LONG_WINDOWS)]
)
def test_windows_find_the_system(
    optimiser: OptimiserSpec, windows: Windows, tmp_path: Path
) -> None:
    data = data_set()
    settings = training(optimiser, windows=windows, max_epochs=12)
    found = settings.identify(spec(), data, 0, tmp_path)
    test_fit = records_fit_percent(found.model, data.test, data)
    assert test_fit > 95.0  # a linear input map stops below 93
    shown = max(row["fit_training_percent"] for row in found.curve)
    training_fit = records_fit_percent(found.model, data.training, data)
    assert training_fit == pytest.approx(shown, abs=0.5)  # the curve shows whole records


def test_records_in_motion_are_shot_at_too(tmp_path: Path) -> None:
    """The first window's state is estimated as a whole record's would be; the curve starts whole
    records from it."""
    data = data_set(samples=260, records=4)
    moving = tuple(dataclasses.replace(r, u=r.u[60:260], y=r.y[60:260]) for r in data.training)
    data = dataclasses.replace(data, training=moving)
    windows = Windows(samples=50, continuity_weight=1.0)
    states = ("zero", "estimated")
    fits = {
        state: training(initial_state=state, windows=windows, max_epochs=10).identify(
            spec(), data, 0, tmp_path / state
        )
        for state in states
    }
    shown = {state: found.curve[-1]["fit_training_percent"] for state, found in fits.items()}
    model = fits["estimated"].model
    assert records_fit_percent(model, data.test, data) > 97.0
    largest = max(97.0, shown["zero"] + 1.0)
    assert shown["estimated"] > largest


def test_equal_seeds_and_float32_shoot_alike(tmp_path: Path) -> None:
    data = data_set(noise=0.05, samples=120)
    settings = training(windows=SHOOTING, max_epochs=3)
    names = ("one", "two")
    one, two = (settings.identify(MODELS["gru"], data, 3, tmp_path / name).model for name in names)
    assert one.to_json() == two.to_json()
    levenberg = Levenberg(
        steps_per_epoch=2, damping=0.01, longest_step=0.5
    )  # two steps an epoch go less far
    for optimiser, least in ((settings.optimiser, 80.0), (levenberg, 50.0)):
        single = dataclasses.replace(settings, precision=32, optimiser=optimiser)
        folder = tmp_path / type(optimiser).__name__
        low = single.identify(spec(), data, 3, folder)
        assert records_fit_percent(low.model, data.training, data) > least


REFUSED_WINDOWS = [
    ({"samples": 1}, r"training.windows.samples = 1"),
    ({"samples": 40, "continuity_weight": -1.0}, r"training.windows.continuity_weight = -1"),
    (
        {"samples": 40, "continuity_weight": float("nan")},
        r"training.windows.continuity_weight = nan",
    ),
    ({"samples": 40, "continuity_weight": 0.0}, r"training.windows.continuity_weight = 0"),
]


@pytest.mark.parametrize(("changes", "named"), REFUSED_WINDOWS)
def test_windows_out_of_range_are_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(BadRequest, match=named):
        Windows(**changes)


def test_a_window_that_no_record_can_fill_is_refused(tmp_path: Path) -> None:
    data = unequal()
    windows = Windows(samples=90)
    settings = training(windows=windows)
    with pytest.raises(
        BadRequest, match=r"samples = 90: the record training_1 has only 83 samples"
    ):
        settings.identify(spec(), data, 0, tmp_path)
    late = dataclasses.replace(data, start_up_samples=40)
    settings = training(windows=SHOOTING)
    with pytest.raises(BadRequest, match="40 start-up samples leave nothing"):
        settings.identify(spec(), late, 0, tmp_path)
