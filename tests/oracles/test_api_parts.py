"""Parts composed without Hydra are those that Hydra composes from the same words."""

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

from ssm_study.api import fitting
from ssm_study.api.parts import (
    GROUPS,
    StudyParts,
    format_setting_value,
    load_choice,
    part_of_setting,
)
from ssm_study.cli.from_python import compose_configuration
from ssm_study.engine.settings import plain_settings
from ssm_study.extensions import configuration_folders
from ssm_study.refusal import BadRequest

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"
CHOICES: list[tuple[str, str]] = []
for group_name in (*GROUPS, "plant"):
    yamls = sorted((CONF / group_name).glob("*.yaml"))
    CHOICES += [(group_name, path.stem) for path in yamls]
WORDS_OF_MODELS = (
    ("model=ssm", "model.order=4", "scaffold@model.scaffold_in=monotone"),
    ("model=structured", "model.ridge=1e-3", "model.kinds=[tanh,relu]"),
)
WORDS_OF_OTHERS = (
    ("training/optimiser=adam", "training.max_epochs=7"),
    ("synthesis=riccati", "synthesis.rate_controller=0.2"),
    ("reference@loop.reference=step", "loop.horizon_s=3"),
)
WORDS = (*WORDS_OF_MODELS, *WORDS_OF_OTHERS)


def test_the_folder_is_ours() -> None:
    assert configuration_folders()[0] == CONF


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_choice_is_what_hydra_composes(group: str, choice: str) -> None:
    config = compose_configuration([f"{group}={choice}", "study=any"])
    settings = plain_settings(config)
    theirs = settings[group]
    tree = load_choice(group, choice)
    assert tree == dict(theirs)


@pytest.mark.parametrize("words", WORDS)
def test_settings_are_what_hydra_composes(words: tuple[str, ...]) -> None:
    defaults = {"model": "ssm", "training": "default"}
    defaults |= {"synthesis": "auto", "loop": "regulation"}
    parts = StudyParts(defaults, words)
    config = compose_configuration([*words, "study=any"])
    theirs = plain_settings(config)
    for name, tree in parts.trees.items():
        assert tree == dict(theirs[name])
    overrides = parts.command_overrides()
    config = compose_configuration([*overrides, "study=any"])
    again = plain_settings(config)
    for name in parts.trees:
        assert again[name] == theirs[name]


NO_SETTINGS = [(("order=4",), "is no setting"), (("-m",), "is no setting")]
NO_PARTS = [
    (("model=none",), "is no choice"),
    (("model.order.deep=4",), "there is no part order"),
    (("scaffold@plant.scaffold=mlp",), "is no part of a model"),
]
NO_SEED = (("seed=-1",), "not a whole number")


@pytest.mark.parametrize(("words", "message"), [*NO_SETTINGS, *NO_PARTS, NO_SEED])
def test_other_words_are_refused(words: tuple[str, ...], message: str) -> None:
    choices = {"model": "ssm"}
    with pytest.raises(BadRequest, match=message):
        StudyParts(choices, words)


def test_a_missing_value_is_named() -> None:
    parts = StudyParts({"data": "recorded"})
    with pytest.raises(BadRequest, match=r"data\.path = \?\?\?: is missing"):
        parts.build("data")


VALUES = {"feedthrough": False, "slope_lower": 0.1, "nodes": 3}
UNQUOTED_WORD = re.compile(r"(?<![\w\"])\w+(?![\w\"])")


def parts_with_model(model: str) -> StudyParts:
    """The parts of a fit with this model."""
    choices = fitting.CHOICES | {"model": model}
    return StudyParts(choices)


def test_the_help_of_fit_names_settings_that_each_model_takes() -> None:
    """Written `"ssm" [order, slopes]`; another model refuses them."""
    text = inspect.getdoc(fitting.fit) or ""
    listed = re.findall(r'"(\w+)" \[([^\]]*)\]', text)
    assert len(listed) >= 8
    for model, words in listed:
        names = UNQUOTED_WORD.findall(words.replace("as ", ""))
        for name in names:
            field = "slope_lower" if name == "slopes" else name
            value = VALUES.get(field, 2)
            parts = parts_with_model(model)
            parts.change_settings("model", **{field: value})
            parts.build("model")
    parts = parts_with_model("arx")
    parts.change_settings("model", order=2)
    with pytest.raises(BadRequest, match="order"):
        parts.build("model")


def test_numbers_of_an_array_and_words_with_spaces_are_settings() -> None:
    """A loop over an array gives NumPy's numbers."""
    parts = StudyParts(fitting.CHOICES | {"model": "ssm"}, ["training.max_epochs = 5", "seed = 3"])
    orders = np.arange(1, 3)
    parts.change_settings("model", order=orders[1])
    parts.set_seed("loop_seed", orders[0])
    assert parts.build("training").max_epochs == 5
    assert parts.build("model").order == 2
    assert parts.numbers == {"seed": 3, "loop_seed": 1}
    assert parts.overrides_for_parts("seed") == ("seed = 3",)
    assert {"training.max_epochs=5", "model.order=2"} <= set(parts.command_overrides())


@pytest.mark.parametrize(
    "word", ["+synthesis.cover=1", " +synthesis.cover=1", "++synthesis.cover = 1"]
)
def test_a_setting_with_spaces_and_signs_reaches_its_part(word: str) -> None:
    """`st.fit` keeps it for `st.control`; with a space before the sign it was lost."""
    parts = StudyParts(fitting.CHOICES, [word])
    kept = parts.overrides_for_parts("synthesis")
    assert part_of_setting(word) == "synthesis"
    assert kept == (word,)
    assert parts.trees["synthesis"]["cover"] == 1


LOWEST = np.float64(-1)
STEPS = np.array([15, 20, 10])
NUMPY_SETTINGS = [
    ([LOWEST], "[-1.0]"),
    ((LOWEST, None), "[-1.0,null]"),
    (list(STEPS), "[15,20,10]"),
    (STEPS, "[15,20,10]"),
    (np.True_, "true"),
]


@pytest.mark.parametrize(("given", "text"), NUMPY_SETTINGS)
def test_numbers_of_numpy_within_a_setting_are_read_again(given: object, text: str) -> None:
    """The command of a design had `[np.float64(-1.0)]`, which Hydra cannot read."""
    parts = StudyParts(fitting.CHOICES)
    parts.change_settings("loop", input_lower=given)
    command = parts.command_overrides()
    assert f"loop.input_lower={text}" in command
    loop = parts.trees["loop"]
    stored = loop["input_lower"]
    assert "np." not in repr(stored)
    assert format_setting_value(stored) == text
