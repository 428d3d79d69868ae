"""Words of a request that are translated for Hydra, refused, or answered with what is near."""

from pathlib import Path

import pytest
from hydra.errors import OverrideParseException
from omegaconf import OmegaConf

from ssm_study.cli.hydra_errors import (
    choices_with_key,
    compose_without_key,
    explain_hydra_error,
    first_error_line,
    groups_with_package,
    refuse_dashed_settings,
    refuse_misspelt_option,
    similar_settings,
    suggest_choice,
    suggest_key,
    suggest_package,
)
from ssm_study.cli.request import compose_request, quote_sines, translate_arguments
from ssm_study.extensions import configuration_folder
from ssm_study.refusal import BadRequest

PLAN = ["--multirun", "hydra/launcher=processes", "dry_run=true"]
TRANSLATIONS: dict[str, list[str]] = {}
TRANSLATIONS["seed=1"] = ["seed=1"]
TRANSLATIONS["seed=1 -m"] = ["--multirun", "seed=1"]
TRANSLATIONS["--multirun seed=1"] = ["--multirun", "seed=1"]
TRANSLATIONS["--strict --retry-failed"] = ["strict=true", "retry_failed=true"]
TRANSLATIONS["seed=1 --open"] = ["seed=1"]
TRANSLATIONS["--dry-run"] = PLAN
TRANSLATIONS["hydra/launcher=slurm --dry-run"] = PLAN
TRANSLATIONS["+hydra.launcher.x=1 --dry-run"] = PLAN
TRANSLATIONS["hydra/launcher=slurm"] = ["hydra/launcher=slurm"]


@pytest.mark.parametrize(("words", "expected"), TRANSLATIONS.items())
def test_options_become_settings_of_hydra(words: str, expected: list[str]) -> None:
    actual = translate_arguments(words.split())
    assert actual == expected


QUOTED = {
    "synthesis.internal_model=[sine(0.5Hz)]": "synthesis.internal_model=['sine(0.5Hz)']",
    "internal_model=[step,sine(1Hz)]": "internal_model=[step,'sine(1Hz)']",
    "internal_model=['sine(1Hz)']": "internal_model=['sine(1Hz)']",
    "seed=range(3)": "seed=range(3)",
}


def test_sines_of_an_internal_model_alone_are_quoted() -> None:
    quoted = quote_sines(QUOTED)
    expected = list(QUOTED.values())
    assert quoted == expected


# Choices and keys.


def test_the_nearest_choice_is_suggested_or_all() -> None:
    near = suggest_choice("plant", "dc_moter", ["tank", "dc_motor", "dc_motors"])
    assert near == "did you mean plant=dc_motor?"
    far = suggest_choice("plant", "xyz", ["tank", "dc_motor"])
    assert far == "choose among tank, dc_motor"


def test_the_place_of_a_group_is_suggested_with_its_value() -> None:
    packages = ["a@b.a", "a@c.a"]
    with_value = suggest_package("a", packages, ["b=2", "a=1"])
    assert with_value == "did you mean a@b.a=1 or a@c.a=1?"
    actual = suggest_package("a", packages[:1], ["b=2"])
    assert actual == "did you mean a@b.a=VALUE?"


KEYS = ["synthesis.rate_controller", "synthesis.rate_observer", "model.order", "loop.order"]


def test_settings_that_begin_with_a_word_come_before_those_like_it() -> None:
    expected = KEYS[:2]
    actual = similar_settings("rate", KEYS)
    assert actual == expected
    expected = KEYS[2:]
    actual = similar_settings("model.ordr", KEYS)
    assert actual == expected
    expected = KEYS[:2]
    actual = similar_settings("other.rate", KEYS)
    assert actual == expected
    assert similar_settings("xyz", KEYS) == []


def write_choices(folder: Path) -> Path:
    """A folder of configuration files."""
    files = {
        "model/small.yaml": "order: 2\nnested:\n  depth: 1\n",
        "model/large.yaml": "order: 9\n",
        "model/inner/one.yaml": "width: 3\n",
        "experiment/a.yaml": "defaults:\n  - /shape@loop.shape: step\n  - /shape@b: x\n",
        "experiment/b.yaml": "defaults:\n  - /shape@b: y\n  - /reshape@c: z\n",
    }
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_choices_that_have_a_key_are_named(tmp_path: Path) -> None:
    folder = write_choices(tmp_path)
    expected = ["model=large", "model=small"]
    actual = choices_with_key("model.order", folder)
    assert actual == expected
    expected = ["model=small"]
    actual = choices_with_key("model.nested.depth", folder)
    assert actual == expected
    expected = ["model/inner=one"]
    actual = choices_with_key("model.inner.width", folder)
    assert actual == expected
    assert choices_with_key("model.width", folder) == []
    assert choices_with_key("order", folder) == []
    one = suggest_key("model.nested.depth", [], folder)
    assert one == "model=small has it: add model=small"
    two = suggest_key("model.order", [], folder)
    assert two == "model=large and model=small have it: add model=large"


def test_places_of_a_group_are_those_of_the_experiments(tmp_path: Path) -> None:
    folder = write_choices(tmp_path)
    expected = ["+shape@b", "+shape@loop.shape"]
    actual = groups_with_package("shape", "", folder)
    assert actual == expected
    actual = groups_with_package("nothing", "", folder)
    assert actual == []
    message = "Did you mean to override one of a@b, a@c?"
    expected = ["a@b", "a@c"]
    actual = groups_with_package("a", message, folder)
    assert actual == expected
    message = "Did you mean to override a@b?"
    expected = ["a@b"]
    actual = groups_with_package("a", message, folder)
    assert actual == expected


NEAR = {
    "model.ordr": "did you mean model.order?",
    "plnt": "did you mean plant?",
    "exp": "did you mean experiment?",
    "rate": "did you mean synthesis.rate_controller or synthesis.rate_observer?",
    "qqqqqq": "",
    "zz": "",
}


@pytest.fixture
def few_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """A configuration of a few keys, so that nothing is composed."""
    config = OmegaConf.create(
        {"model": {"order": 4}, "synthesis": {"rate_controller": 1, "rate_observer": 2}}
    )
    place = "ssm_study.cli.hydra_errors.compose_without_key"
    monkeypatch.setattr(place, lambda *_: config)


@pytest.mark.usefixtures("few_keys")
@pytest.mark.parametrize(("key", "suggestion"), NEAR.items())
def test_a_key_is_answered_with_what_is_near(key: str, suggestion: str) -> None:
    actual = suggest_key(key, [], configuration_folder())
    assert actual == suggestion


def test_only_choices_stay_of_the_other_words() -> None:
    words = ["model=gru,lstm", "seed=3", "mdel.x=1", "model.order=9", "synthesis=[lmi]"]
    config = compose_without_key("mdel.x", words, configuration_folder())
    target = str(config.model._target_)
    assert "gru" in target.lower() or "gru" in str(config.model).lower()
    assert config.seed != 3


# Errors.

ERRORS: list[tuple[Exception, str, str]] = []
ERRORS.append(
    (
        ValueError("Could not find 'plant/tenk' Available options in 'plant': tank motor"),
        "there is no plant/tenk",
        "did you mean plant=tank?",
    )
)
ERRORS.append(
    (
        ValueError("Ambiguous value for argument 'seed=0,1'"),
        "seed=0,1 are several values for one run",
        "add -m to sweep over them",
    )
)
ERRORS.append(
    (
        ValueError("Config group override must be a string"),
        "a group takes the name of one of its choices",
        "see `ssm-study run --help`",
    )
)
ERRORS.append(
    (
        ValueError("Could not override 'reference'. Did you mean to override reference@loop.r?"),
        "reference is named with its place",
        "did you mean reference@loop.r=step?",
    )
)
ERRORS.append(
    (
        ValueError("Could not override 'qqqqqq'.\nTo append"),
        "Could not override 'qqqqqq'",
        "see `ssm-study run --help`",
    )
)
ERRORS.append((ValueError("Something\n  else."), "Something else", "see `ssm-study run --help`"))


@pytest.mark.usefixtures("few_keys")
@pytest.mark.parametrize(("error", "problem", "remedy"), ERRORS)
def test_an_error_of_hydra_is_one_sentence(error: Exception, problem: str, remedy: str) -> None:
    request = explain_hydra_error(error, ["reference=step"], configuration_folder())
    expected = (problem, remedy)
    actual = (request.problem, request.remedy)
    assert actual == expected
    assert request.value == "reference=step"


@pytest.mark.usefixtures("few_keys")
def test_a_key_of_a_sweep_is_named_whole() -> None:
    error = ValueError("Key 'ordr' is not in struct\n    full_key: model.ordr\n    more")
    request = explain_hydra_error(error, ["a"], configuration_folder())
    assert request.problem == "Could not override 'model.ordr'"
    assert request.remedy == "did you mean model.order?"


def test_what_cannot_be_parsed_is_quoted() -> None:
    error = OverrideParseException(override="a=[1", message="mismatched input '<EOF>'")
    request = explain_hydra_error(error, [], configuration_folder())
    assert request.problem == "a=[1 cannot be read"
    assert request.value == "(no override)"


def test_only_the_first_line_of_a_library_is_told() -> None:
    appendices = ("\n    full_key: a", "\nConfig search path: b", "\nSee https://c", "\nTo append")
    for appendix in appendices:
        error = ValueError(f"one\ntwo.{appendix} more")
        assert first_error_line(error) == "one two"


# Dashes.

DASHED = {
    "--seed=1": "write seed=VALUE",
    "--model.order": "write model.order=VALUE",
    "--plant=tank": "write plant=VALUE",
    "--experimental-rerun=x": "use `ssm-study reproduce RUN`",
    "--ex": "use `ssm-study reproduce RUN`",
    "--dryrun": "did you mean --dry-run?",
    "--retry-faild": "did you mean --retry-failed?",
}


@pytest.mark.parametrize(("word", "remedy"), DASHED.items())
def test_a_setting_with_dashes_is_refused(word: str, remedy: str) -> None:
    with pytest.raises(BadRequest) as caught:
        refuse_dashed_settings(["seed=1", word], configuration_folder())
    assert caught.value.remedy == remedy


def test_other_options_are_hydra_s() -> None:
    words = ["--dry-run", "--cfg", "-m", "--multirun", "--help", "model.order=4", "--open"]
    refuse_dashed_settings(words, configuration_folder())
    refuse_misspelt_option("dry-run")


EMPTY = {
    "plant={}": "has no effect, because its entries are merged into those that are there",
    "model=[]": "is no name of a choice",
    "model=[1]": "is no name of a choice",
    "model=3": "is no name of a choice",
}


@pytest.mark.parametrize(("word", "problem"), EMPTY.items())
def test_a_group_without_a_choice_is_refused(word: str, problem: str) -> None:
    with pytest.raises(BadRequest) as caught:
        compose_request([word], configuration_folder(), "study")
    assert caught.value.problem == problem


def test_other_empty_settings_are_composed() -> None:
    words = ["+loop.extra={}", "seed=1"]
    request = compose_request(words, configuration_folder(), "study")
    assert request.config.seed == 1
