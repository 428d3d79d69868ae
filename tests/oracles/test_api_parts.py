"""Parts composed without Hydra are those that Hydra composes from the same words."""

import inspect
import re
from pathlib import Path

import pytest

from ssm_study.api import fitting
from ssm_study.api.parts import GROUPS, Parts, configuration_folders, load_choice
from ssm_study.cli.from_python import compose_configuration
from ssm_study.engine.settings import plain_settings
from ssm_study.refusal import BadRequest

CONF = Path(__file__).parents[2] / "conf"
CHOICES = [
    (group, path.stem)
    for group in (*GROUPS, "plant")
    for path in sorted((CONF / group).glob("*.yaml"))
]
WORDS = (
    ("model=ssm", "model.order=4", "scaffold@model.scaffold_in=monotone"),
    ("model=structured", "model.ridge=1e-3", "model.kinds=[tanh,relu]"),
    ("training/optimiser=adam", "training.max_epochs=7"),
    ("synthesis=riccati", "synthesis.rate_controller=0.2"),
    ("reference@loop.reference=step", "loop.horizon_s=3"),
)


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
    defaults = {
        "model": "ssm", "training": "default", "synthesis": "auto", "loop": "regulation",
    }  # fmt: skip
    parts = Parts(defaults, words)
    config = compose_configuration([*words, "study=any"])
    theirs = plain_settings(config)
    for name, tree in parts.trees.items():
        assert tree == dict(theirs[name])
    config = compose_configuration([*parts.command_overrides(), "study=any"])
    again = plain_settings(config)
    for name in parts.trees:
        assert again[name] == theirs[name]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("model=none",), "is no choice"),
        (("order=4",), "is no setting"),
        (("-m",), "is no setting"),
        (("model.order.deep=4",), "there is no part order"),
        (("seed=-1",), "not a whole number"),
        (("scaffold@plant.scaffold=mlp",), "is no part of a model"),
    ],
)
def test_other_words_are_refused(words: tuple[str, ...], message: str) -> None:
    choices = {"model": "ssm"}
    with pytest.raises(BadRequest, match=message):
        Parts(choices, words)


def test_a_missing_value_is_named() -> None:
    parts = Parts({"data": "recorded"})
    with pytest.raises(BadRequest, match=r"data\.path = \?\?\?: is missing"):
        parts.build("data")


VALUES = {"feedthrough": False, "slope_lower": 0.1, "nodes": 3}


def test_the_help_of_fit_names_settings_that_each_model_takes() -> None:
    """Written `"ssm" [order, slopes]`; another model refuses them."""
    text = inspect.getdoc(fitting.fit) or ""
    listed = re.findall(r'"(\w+)" \[([^\]]*)\]', text)
    assert len(listed) >= 8
    for model, words in listed:
        for name in re.findall(r"(?<![\w\"])\w+(?![\w\"])", words.replace("as ", "")):
            field = "slope_lower" if name == "slopes" else name
            parts = Parts(fitting.CHOICES | {"model": model})
            parts.set_fields("model", **{field: VALUES.get(field, 2)})
            parts.build("model")
    parts = Parts(fitting.CHOICES | {"model": "arx"})
    parts.set_fields("model", order=2)
    with pytest.raises(BadRequest, match="order"):
        parts.build("model")
