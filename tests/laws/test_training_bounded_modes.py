"""A drift of the output that no input causes bounds the modes of output error; a true slow mode
does not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from models_cases import data_set

from ssm_study.models.baselines.output_error import fit_output_error, shrink_roots
from ssm_study.models.metrics import Simulation
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet, Scale
from ssm_study.training.candidates import relative_rms_error
from ssm_study.training.choice_of_size import BOUNDS, choose_linear_order
from ssm_study.training.folds import join_training_and_validation, make_folds
from ssm_study.training.linear_candidates import fit_linear_model, slowest_time_constant
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.search import LARGEST_TIME_CONSTANT, SettingsChoice, SettingsSearch
from ssm_study.training.training import Training, TrainingSession

SPEC = StructuredSpec(order="auto", neurons="auto", knots="auto", among_starts=None)
DECIDED = {"feedthrough": False, "dead_time": 0, "integrating_output": False}
SAMPLES = 1000
TRAINED = 800  # of these; the rest is predicted
DRIFTING = 0  # seed of the drifting log
TRAINING = Training(
    optimiser=Lbfgs(steps_per_epoch=10, history=20),
    max_epochs=1,
    patience=1,
    min_gain_percent=0.0,
    validation_tolerance_percent=0.0,
)
Signal = Float[np.ndarray, "T"]


def lagged(u: Signal, *radii: float) -> Signal:
    """Output of lags in a row, each of gain one."""
    y = u
    for radius in radii:
        late = np.zeros(len(y))
        for k in range(1, len(y)):
            late[k] = radius * late[k - 1] + (1.0 - radius) * y[k - 1]
        y = late
    return y


def drifting_log(seed: int) -> tuple[Signal, Signal]:
    """Two lags, and a random walk of a fifth of their deviation on the output, which ends where the
    test begins."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // 10), 10)
    y = lagged(u, 0.7, 0.9)
    steps = rng.normal(size=TRAINED)
    walk = steps.cumsum()
    drift = np.zeros(SAMPLES)
    drift[:TRAINED] = (walk - walk.mean()) / walk.std()
    return u, y + 0.2 * y.std() * drift


def slow_log(seed: int) -> tuple[Signal, Signal]:
    """A fast lag beside one of 400 samples, and one percent of noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // 20), 20)
    slow = lagged(u, float(np.exp(-1.0 / 400.0)))
    y = lagged(u, 0.8) + 5.0 * slow
    return u, y + 0.01 * y.std() * rng.normal(size=SAMPLES)


def as_data(u: Signal, y: Signal) -> DataSet:
    """Data set of one log: the first part is trained on, the last predicted."""
    data = data_set(samples=400)
    record = replace(data.training[0], u=u[:, None], y=y[:, None], log=1)
    scale = Scale(
        input_scale=u.std(keepdims=True),
        output_scale=y.std(keepdims=True),
        input_equilibrium=np.zeros(1),
        output_equilibrium=np.zeros(1),
    )
    cut = 3 * TRAINED // 4
    return replace(
        data,
        training=(record[:cut],),
        validation=(record[cut:TRAINED],),
        test=(record[TRAINED:],),
        start_up_samples=20,
        scale=scale,
    )


def search_in(data: DataSet) -> SettingsSearch:
    folds = make_folds(data)
    return SettingsSearch(
        spec=SPEC, folds=folds, seed=0, announce=lambda _: None, decided=dict(DECIDED)
    )


def test_roots_outside_a_circle_move_onto_it() -> None:
    outside = np.poly([0.999, 0.5])[1:]
    shrunk = shrink_roots(outside, 0.99)
    roots = np.roots([1.0, *shrunk])
    np.testing.assert_allclose(np.sort(roots), [0.5, 0.99], atol=1e-12)
    assert shrink_roots(shrunk, 0.991) is shrunk


def test_a_bound_that_no_mode_reaches_changes_nothing() -> None:
    data = as_data(*slow_log(0))
    free = fit_output_error(data, 2, 1)
    bounded = fit_output_error(data, 2, 1, 5000)
    np.testing.assert_allclose(bounded.theta, free.theta, rtol=1e-3)


def test_a_drift_bounds_the_time_constants() -> None:
    """Unbounded, the models of three and four states follow the drift and miss held-out pieces."""
    data = as_data(*drifting_log(DRIFTING))
    search = search_in(data)
    chosen = choose_linear_order(search)
    bound = chosen.settings[LARGEST_TIME_CONSTANT]
    assert bound in {round(share * 600) for share in BOUNDS}
    order = int(chosen.settings["order"])
    unbounded = search.score_linear_model("linear order", order, 1)
    assert chosen.mean_error_percent < 0.9 * unbounded.mean_error_percent
    assert chosen.training_error > unbounded.training_error
    records = join_training_and_validation(data)
    model = fit_linear_model(records, order, has_feedthrough=False, largest_time_constant=bound)
    run = Simulation.simulate_records(model, data.test, data.start_up_samples)
    assert relative_rms_error(run, data) < 5.0


def test_a_true_slow_mode_is_not_bounded() -> None:
    search = search_in(as_data(*slow_log(0)))
    chosen = choose_linear_order(search)
    assert LARGEST_TIME_CONSTANT not in chosen.settings
    assert any(LARGEST_TIME_CONSTANT in candidate.settings for candidate in search.tried)


def test_the_bound_holds_in_the_final_training(tmp_path: Path) -> None:
    data = as_data(*drifting_log(DRIFTING))
    search = search_in(data)
    choice = search.build_settings_choice(choose_linear_order(search))
    assert isinstance(choice, SettingsChoice)
    bound = choice.largest_time_constant
    assert bound is not None
    assert f"time constants of at most {bound} samples" in choice.describe(("order",))
    session = TrainingSession(seed=0, folder=tmp_path, progress=False, keep_on_interrupt=False)
    identified = TRAINING._identify_with_chosen_settings(choice, data, session)
    assert slowest_time_constant(identified.model) <= bound * (1.0 + 1e-6)
