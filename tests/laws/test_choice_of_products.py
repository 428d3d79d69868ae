"""Products of input and state predict where the folds clearly prefer them, and nowhere else."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "oracles"))
from test_models_bilinear import CHANNELS, known_model, levels

from ssm_study.data.assembly import assemble_dataset
from ssm_study.models.bilinear import Bilinear
from ssm_study.models.structured_spec import AUTO, AUTOMATIC, StructuredSpec
from ssm_study.signals import DataSet, Trajectory
from ssm_study.training.choice_of_products import choose_bilinear_model
from ssm_study.training.folds import make_folds
from ssm_study.training.search import SettingsSearch

DECIDED = {"dead_time": 0, "feedthrough": False, "integrating_output": False}
OPEN = dict.fromkeys(AUTOMATIC, AUTO)


def records(model: Bilinear) -> DataSet:
    u = levels(420, 3)
    rng = np.random.default_rng(0)
    y = model.simulate(u)
    noise = rng.standard_normal(y.shape)
    measured = y + 0.005 * noise
    whole = Trajectory(u=u, y=measured, step_s=0.1)
    training = whole[:260]
    validation = whole[260:340]
    test = whole[340:]
    parts = (training,), (validation,), (test,)
    zero = np.zeros(1)
    rest = (zero, zero)
    return assemble_dataset(parts, rest, CHANNELS, 20)


def search_on(data: DataSet, **settings: object) -> SettingsSearch:
    """Search that has tried a linear model and decided the paths."""
    spec = StructuredSpec(**(OPEN | settings))  # type: ignore[arg-type]
    folds = make_folds(data)
    search = SettingsSearch(spec=spec, folds=folds, seed=0, announce=lambda _: None)
    search.decided |= DECIDED
    search.score_linear_model("size", 2, 1)
    return search


@pytest.fixture(scope="module")
def data() -> DataSet:
    return records(known_model())


def test_the_folds_prefer_products_on_a_plant_that_has_them(data: DataSet) -> None:
    search = search_on(data)
    chosen = choose_bilinear_model(search, data)
    assert chosen is not None
    size_of_model = (chosen.order, chosen.nodes)
    expected_size = (2, 3)
    assert size_of_model == expected_size
    (linear, *products) = search.tried
    assert len(products) == 2
    error_of_products = products[0].mean_error_percent
    half_the_error = 0.5 * linear.mean_error_percent
    assert error_of_products < half_the_error
    rows = search.candidate_rows(search.chosen)
    row = rows[1]
    assert row["model"] == "products of input and state"
    assert row["chosen"]
    choice = search.build_settings_choice(linear)
    changed_choice = replace(choice, predictor=chosen)
    words = changed_choice.describe(["order"])
    assert words.endswith("products of input and state predict")


def test_products_are_tried_where_a_direct_path_was_chosen(data: DataSet) -> None:
    """Neurons take a direct path on such a plant to make up for the product that they lack."""
    search = search_on(data)
    search.decided["feedthrough"] = True
    assert choose_bilinear_model(search, data) is not None


def test_a_linear_plant_keeps_its_model() -> None:
    model = known_model()
    at_rest = model.a[1]
    same = np.stack([at_rest] * 3)
    above = model.b[2]
    below = model.b[1]
    slope = above - below
    column = model.nodes[:, None]
    b = column * slope
    linear = replace(model, a=same, b=b)
    data = records(linear)
    search = search_on(data)
    assert choose_bilinear_model(search, data) is None
    assert search.chosen == []


SET_BY_THE_USER = [({"order": 3}, {}), ({"neurons": 2}, {}), ({"members": 2}, {})]
LACKING_IN_THE_CLASS = [({}, {"dead_time": 3}), ({}, {"integrating_output": True})]
NOT_OVERRULED = SET_BY_THE_USER + LACKING_IN_THE_CLASS


@pytest.mark.parametrize(("settings", "decided"), NOT_OVERRULED)
def test_what_the_class_lacks_or_the_user_set_is_not_overruled(
    data: DataSet, settings: dict, decided: dict
) -> None:
    search = search_on(data, **settings)
    search.decided |= decided
    assert choose_bilinear_model(search, data) is None
    assert len(search.tried) == 1
