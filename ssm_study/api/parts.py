"""Configuration of the parts of a study (data, model, ...) from YAML files in `conf/`, without
Hydra.

The files are the one home of default values: a script and the command begin from the same numbers.
What Hydra would compose from the same words is compared in `tests/oracles/test_api_parts.py`.
"""

import re
from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from ssm_study.construction import construct_part
from ssm_study.extensions import configuration_folders
from ssm_study.refusal import BadRequest, require, require_seed

Tree = dict[str, Any]
SELF = "_self_"
MISSING = "???"
NAME = re.compile(r"[\w./+-]{1,100}")  # of a choice, as a file can have it
PACKAGE = "_global_"
GROUPS = ("data", "model", "training", "reduction", "synthesis", "loop")
NUMBERS = ("seed", "loop_seed")
# Where a run lies and how it is watched: of no meaning without a run folder.
OF_THE_PLACE = ("study", "results_dir", "run", "progress")
# Settings whose function argument has another name.
ARGUMENTS = {
    "rate_controller": "rate",
    "rate_observer": "observer_rate",
    "slope_lower": "slopes",
    "slope_upper": "slopes",
    "input_lower": "input_limits",
    "input_upper": "input_limits",
}
# Argument after which `st.fit` and `st.control` take overrides, by the part of their keywords.
OVERRIDES_AFTER = {"model": "step_s", "synthesis": "the model"}
NO_FIELD = "has no such field"
REMEDIES = {"neurons": "neurons belong to model='structured'"}
REMEDY = "write key=value, as in model.order=4; sweeps and experiments are for st.study"


def load_choice(group: str, choice: str) -> Tree:
    """Load the settings of one choice of a configuration group, such as `plant=dc_motor`, with its
    defaults merged in.

    Raises `BadRequest` for a choice that no yaml file describes.
    """
    folders = [folder / group for folder in configuration_folders()]
    is_text = isinstance(choice, str)
    is_name = is_text and NAME.fullmatch(choice) is not None
    candidates = [folder / f"{choice}.yaml" for folder in folders] if is_name else []
    choice_files = (candidate for candidate in candidates if candidate.is_file())
    path = next(choice_files, None)
    if path is None:
        files = [file for folder in folders if folder.is_dir() for file in folder.glob("*.yaml")]
        choices = sorted(file.stem for file in files)
        names = ", ".join(choices)
        raise BadRequest(group, choice, "is no choice", f"choose one of {names or 'none'}")
    configuration = OmegaConf.load(path)
    content = OmegaConf.to_container(configuration, resolve=True)
    assert isinstance(content, dict)
    own = {str(key): value for key, value in content.items() if key != "defaults"}
    entries = content.get("defaults") or [SELF]
    if SELF not in entries:
        entries = [*entries, SELF]
    tree: Tree = {}
    for entry in entries:
        other = own if entry == SELF else _load_default(group, entry)
        merge_trees(tree, other)
    return tree


def _load_default(group: str, entry: Any) -> Tree:
    """Load the settings to which one entry of a Hydra defaults list refers."""
    if isinstance(entry, str):
        return load_choice(group, entry)
    ((name, choice),) = entry.items()
    without_override = str(name).removeprefix("override ")
    name = without_override.removeprefix("optional ")
    if PACKAGE in name:  # a choice of another group, made by the command's `data=recorded`
        return {}
    path, _, place = name.partition("@")
    is_absolute = path.startswith("/")
    nested = path.removeprefix("/") if is_absolute else f"{group}/{path}"
    place = place or path.rpartition("/")[2]
    tree: Tree = {}
    nested_settings = load_choice(nested, str(choice))
    replacement = ReplacementSettings(deepcopy(nested_settings))
    assign_creating_levels(tree, place, replacement)
    return tree


class ReplacementSettings(dict[str, Any]):
    """Settings that replace another nested dictionary of settings instead of being merged into
    it."""


def merge_trees(tree: Tree, other: Mapping[str, Any]) -> None:
    """Merge one nested dictionary of settings into another, in place. A subtree that is a
    `ReplacementSettings` is not merged but put in place of the other."""
    for key, value in other.items():
        is_tree = isinstance(value, dict)
        is_merged = is_tree and isinstance(tree.get(key), dict)
        if is_merged and not isinstance(value, ReplacementSettings):
            merge_trees(tree[key], value)
        elif isinstance(value, dict):
            tree[key] = deepcopy(dict(value))
        else:
            tree[key] = deepcopy(value)


def assign_value(tree: Tree, path: str, value: Any) -> None:
    """Assign a value to the setting at a dotted path, such as `model.order`. Raises `BadRequest`
    where the path leads through a value."""
    *parents, last = path.split(".")
    place: Any = tree
    for name in parents:
        inner = place.get(name)
        is_part = isinstance(inner, dict)
        require(is_part, path, value, f"there is no part {name}", "check its name")
        place = inner
    place[last] = value


def assign_creating_levels(tree: Tree, path: str, value: Any) -> None:
    """Assign a value to the setting at a dotted path, and create the levels that do not exist
    yet."""
    *parents, last = path.split(".")
    for name in parents:
        tree = tree.setdefault(name, {})
    tree[last] = value


def parse_setting_value(text: str) -> Any:
    """Parse the text of a setting: a number, true, false, null, a list or a text."""
    try:
        return _parse_numbers(yaml.safe_load(text))
    except yaml.YAMLError:
        return text


def _parse_numbers(value: Any) -> Any:
    """Convert texts such as `1e-3`, which YAML does not read as numbers, to numbers, also within
    lists."""
    if isinstance(value, list):
        return [_parse_numbers(item) for item in value]
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def split_settings(settings: Iterable[str]) -> list[tuple[str, str]]:
    """Split settings such as `model.order=4` into pairs of key and value. Raises `BadRequest` for
    texts of another form."""
    pairs = []
    for word in settings:
        _, equals, value = str(word).partition("=")
        key = key_of_setting(word)
        has_sign = bool(equals)
        usable = has_sign and bool(key) and not key.startswith(("-", "~", "hydra"))
        require(usable, "overrides", word, "is no setting", REMEDY)
        pairs.append((key, value.strip()))
    return pairs


def key_of_setting(setting: str) -> str:
    """Key of a setting, such as `model.order` of `+model.order=4`, without plus signs and
    spaces."""
    signed_key = str(setting).partition("=")[0]
    return signed_key.strip().lstrip("+")


def part_of_setting(setting: str) -> str:
    """Part of a study, such as `model`, to which a setting such as `model.order=4` belongs."""
    key = key_of_setting(setting)
    place = key.rpartition("@")[2]
    dotted_key = place.replace("/", ".")
    return dotted_key.partition(".")[0]


class StudyParts:
    """Configuration of the parts of a study (data, model, training, ...), from which their objects
    are built.

    `overrides` are those of the command line: `model=ssm`, `model.order=4`,
    `training/optimiser=adam`, `reference@loop.reference=step`. Of two values for one setting the
    later counts. Raises `BadRequest` for any other text.
    """

    def __init__(self, choices: Mapping[str, str], overrides: Iterable[str] = ()) -> None:
        self.given = tuple(overrides)
        pairs = split_settings(self.given)
        self.numbers: dict[str, Any] = {"seed": 0, "loop_seed": 0}
        self.choices = dict(choices)
        self.choices |= {key: value for key, value in pairs if key in GROUPS}
        self.trees = {name: load_choice(name, choice) for name, choice in self.choices.items()}
        self.details: list[str] = []
        self.added: set[str] = set()
        self.arguments: dict[str, str] = {}
        nested = [(key, value) for key, value in pairs if "@" in key or "/" in key]
        settings = [(key, value) for key, value in pairs if "@" not in key and "/" not in key]
        for key, value in nested:
            self._choose_option(key, value)
        for key, value in settings:
            if key not in (*GROUPS, *OF_THE_PLACE):
                self._change_setting(key, value)

    def _choose_option(self, key: str, choice: str) -> None:
        """Choose a named option inside one part of a study, such as `training/optimiser=adam`."""
        group, _, place = key.partition("@")
        place = place or group.replace("/", ".")
        part = place.partition(".")[0]
        is_known_part = part in self.trees
        require(is_known_part, key, choice, "is no part of a model or design", REMEDY)
        self.details.append(f"{key}={choice}")
        tree = load_choice(group, choice)
        assign_value(self.trees, place, tree)

    def _change_setting(self, key: str, text: str) -> None:
        """Set one setting, given by its dotted path, of a part of a study."""
        value = parse_setting_value(text)
        if key in NUMBERS:
            self.set_seed(key, value)
            return
        part = key.partition(".")[0]
        is_known = part in self.trees and "." in key
        require(is_known, key, text, "is no setting of data, model or design", REMEDY)
        self.details.append(f"{self._override_prefix(key)}{key}={text}")
        assign_value(self.trees, key, value)

    def set_seed(self, name: str, value: Any) -> None:
        """Set the seed of the data and the model, or that of the loop. Raises `BadRequest` for
        anything but a whole number from 0 to 2^32 - 1."""
        seed = python_value(value)
        require_seed(name, seed)
        self.numbers[name] = seed

    def _override_prefix(self, path: str) -> str:
        """Prefix of a command-line override: `++` for a setting that the configuration files lack,
        otherwise empty."""
        if not self._has_setting(path):
            self.added.add(path)
        return "++" if path in self.added else ""

    def _has_setting(self, path: str) -> bool:
        """Whether the configuration files have a setting at a dotted path."""
        place: Any = self.trees
        for name in path.split("."):
            is_part = isinstance(place, dict)
            if not is_part or name not in place:
                return False
            place = place[name]
        return True

    def change_settings(self, part: str, **settings: Any) -> None:
        """Set several settings of one part of a study; a setting with the new value None stays
        unchanged."""
        for name, given in settings.items():
            value = python_value(given)
            place = OVERRIDES_AFTER.get(part, part)
            refuse_dotted_name(part, name, value, f"after {place}, not as a keyword")
            if value is not None:
                sign = self._override_prefix(f"{part}.{name}")
                assign_value(self.trees, f"{part}.{name}", value)
                self.arguments[f"{part}.{name}"] = ARGUMENTS.get(name, name)
                self.details.append(f"{sign}{part}.{name}={format_setting_value(value)}")

    def build(self, part: str) -> Any:
        """Build the object that the settings of one part of a study describe. Raises `BadRequest`
        for missing, unknown or unusable settings."""
        tree = self.trees[part]
        texts = {key: value for key, value in tree.items() if isinstance(value, str)}
        missing = next((key for key, value in texts.items() if value == MISSING), None)
        require(missing is None, f"{part}.{missing}", MISSING, "is missing", "give it a value")
        try:
            return construct_part(part, tree)
        except BadRequest as error:
            raise self._name_argument_in_error(error) from error.__cause__

    def _name_argument_in_error(self, error: BadRequest) -> BadRequest:
        """Copy of an error about a setting, with the name of the function argument that gave the
        value."""
        field = error.field.partition(",")[0]
        argument = self.arguments.get(field)
        if argument is None:
            return error
        has_no_field = NO_FIELD in error.problem
        remedy = REMEDIES.get(argument, error.remedy) if has_no_field else error.remedy
        return BadRequest(argument, error.value, error.problem, remedy)

    def overrides_for_parts(self, *names: str) -> tuple[str, ...]:
        """Command-line overrides that set given parts of a study, such as `model` or `seed`."""
        return tuple(word for word in self.given if part_of_setting(word) in names)

    def command_overrides(self) -> tuple[str, ...]:
        """Overrides for the command `ssm-study run` that reproduce all choices and settings."""
        chosen = [f"{name}={choice}" for name, choice in self.choices.items()]
        numbers = [f"{name}={value}" for name, value in self.numbers.items()]
        return (*chosen, *self.details, *numbers)


def refuse_dotted_name(part: str, name: str, value: Any, place: str) -> None:
    """Raise `BadRequest` if a setting of a part is named by its dotted path, which belongs into an
    override; `place` says where overrides are given."""
    override = f"{name}={format_setting_value(python_value(value))}"
    remedy = f'write it as "{override}" {place}'
    require("." not in name, name, value, f"is no setting of the {part}", remedy)


def python_value(value: Any) -> Any:
    """Value with numbers of Python in place of those of NumPy, also within lists and tuples. An
    array becomes a list; any other value is returned unchanged."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return python_value(value.tolist())
    if isinstance(value, list):
        return [python_value(item) for item in value]
    if isinstance(value, tuple):
        return tuple(python_value(item) for item in value)
    return value


def format_setting_value(value: Any) -> str:
    """Text of a setting's value, from which Hydra reads the same value again."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(format_setting_value, value))}]"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    text = str(value)
    before_quotes = re.sub(r"(\\*)'", r"\1\1\\'", text)
    escaped = re.sub(r"(\\+)$", r"\1\1", before_quotes)  # elsewhere a backslash stands for itself
    return f"'{escaped}'"
