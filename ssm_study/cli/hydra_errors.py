"""One-sentence messages for requests that Hydra refuses, each with a suggestion."""

import re
from difflib import get_close_matches
from pathlib import Path

import yaml  # type: ignore[import-untyped]
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from ssm_study.cli.request import OPTIONS
from ssm_study.engine.settings import walk_nodes
from ssm_study.refusal import BadRequest, require

ASK = "see `ssm-study run --help`"
MOST_SUGGESTED = 2  # settings
UNKNOWN_CHOICE = re.compile(r"Could not find '(.+)/([^/']+)' Available options in '.+': (.+)")


def explain_hydra_error(error: BaseException, overrides: list[str], folder: Path) -> BadRequest:
    """Explain an error that Hydra raised in plain words, with a suggestion."""
    message = first_error_line(error)
    if isinstance(error, OverrideParseException):  # its grammar's tokens say nothing to a reader
        problem = f"{error.override} cannot be read"
        remedy = "write KEY=VALUE, in a sweep KEY=VALUE,VALUE, and close all brackets and quotes"
    elif match := UNKNOWN_CHOICE.search(message):
        group = match[1]
        name = match[2]
        problem = f"there is no {group}/{name}"
        remedy = suggest_choice(group, name, match[3].split())
    elif match := re.search(r"Ambiguous value for argument '(.+?)'", message):
        problem = f"{match[1]} are several values for one run"
        remedy = "add -m to sweep over them"
    elif "Config group override" in message:
        problem = "a group takes the name of one of its choices"
        remedy = ASK
    elif match := re.search(r"Could not override '([^']+)'", message):
        key = match[1]
        at = groups_with_package(key, message, folder)
        problem = f"{key} is named with its place" if at else message
        remedy = (
            suggest_package(key, at, overrides)
            if at
            else suggest_key(key, overrides, folder) or ASK
        )
    elif match := re.search(r"Key '([^']+)' is not in struct", message):  # of a sweep
        full_key = re.search(r"full_key: (\S+)", str(error))
        key = full_key[1] if full_key is not None else match[1]
        problem = f"Could not override '{key}'"
        remedy = suggest_key(key, overrides, folder) or ASK
    else:
        problem = message
        remedy = ASK
    return BadRequest("request", " ".join(overrides) or "(no override)", problem, remedy)


def suggest_choice(group: str, name: str, choices: list[str]) -> str:
    """Suggestion for a wrong choice of a configuration group: the nearest valid choice, or all of
    them where none is similar."""
    near = get_close_matches(name, choices, n=1)
    return f"did you mean {group}={near[0]}?" if near else f"choose among {', '.join(choices)}"


def suggest_package(key: str, packages: list[str], overrides: list[str]) -> str:
    """Suggestion for a configuration group that has to be named with its place, such as
    `reference@loop.reference`."""
    values = [word.partition("=")[2] for word in overrides if word.split("=")[0] == key]
    value = values[0] if values else "VALUE"
    suggestions = " or ".join(f"{place}={value}" for place in packages)
    return f"did you mean {suggestions}?"


def first_error_line(error: BaseException) -> str:
    """First line of the message of an error from Hydra or OmegaConf."""
    text = str(error)
    for appendix in ("\n    full_key", "\nConfig search path", "\nSee https://", "\nTo append"):
        text = text.split(appendix)[0]
    return " ".join(text.split()).rstrip(".")


def refuse_dashed_settings(overrides: list[str], folder: Path) -> None:
    """Raise `BadRequest` for a setting that is written with dashes like an option, such as
    `--model.order 4`.

    It is also raised for an option that resembles one of `ssm-study`; Hydra answers to all others.
    """
    for word in overrides:
        refuse_misspelt_option(word)
    groups = {group.name for group in folder.iterdir() if group.is_dir()}
    settings = {"seed", "study", "results_dir", *groups}
    for word in overrides:
        key = word.removeprefix("--").split("=")[0]
        dashed = word.startswith("--") and ("." in key or key in settings)
        require(not dashed, "request", word, "a setting has no dashes", f"write {key}=VALUE")
        # It would load a pickle: foreign code.
        rerun = word.startswith("--e") and "experimental-rerun".startswith(key)
        remedy = "use `ssm-study reproduce RUN`"
        require(
            not rerun, "request", word, "a stored job of Hydra cannot be run again here", remedy
        )


def refuse_misspelt_option(word: str) -> None:
    """Raise `BadRequest` for an option that resembles one of the options of `ssm-study`."""
    if word in OPTIONS or not word.startswith("--"):
        return
    near = get_close_matches(word, OPTIONS, n=1, cutoff=0.8)
    if near:
        remedy = f"did you mean {near[0]}?"
        raise BadRequest("request", word, "there is no such option", remedy)


def suggest_key(key: str, overrides: list[str], folder: Path) -> str:
    """Suggestion for a configuration key that does not exist, such as a similar key. It names the
    choice that has the key, else the nearest keys or group; it is empty where nothing is near."""
    if owners := choices_with_key(key, folder):
        verb = "have" if len(owners) > 1 else "has"
        return f"{' and '.join(owners)} {verb} it: add {owners[0]}"
    config = compose_without_key(key, overrides, folder)
    keys = [path for path, _, _ in walk_nodes(OmegaConf.to_container(config))]
    groups = [path.name for path in folder.iterdir() if path.is_dir()]
    near = get_close_matches(key, keys + groups, n=1)
    if not near and len(key) > 2:
        near = [group for group in groups if group.startswith(key)]
    if not near:
        near = similar_settings(key, keys)
    return f"did you mean {' or '.join(near[:MOST_SUGGESTED])}?" if near else ""


def similar_settings(key: str, keys: list[str]) -> list[str]:
    """Settings whose last name resembles the last part of a key, such as
    `synthesis.rate_controller` for `rate`."""
    last = key.rpartition(".")[2]
    named: dict[str, list[str]] = {}
    for path in keys:
        named.setdefault(path.rpartition(".")[2], []).append(path)
    near = [name for name in named if name.startswith(f"{last}_")]
    near = near or get_close_matches(last, list(named), n=1)
    return [path for name in near for path in named[name]]


def compose_without_key(key: str, overrides: list[str], folder: Path) -> DictConfig:
    """Compose the configuration without the command-line overrides of a misspelt key. Only
    overrides that name a choice stay; of a sweep over choices, the first.

    Other overrides say nothing about what was meant.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    choices = []
    for word in overrides:
        name = word.split("=")[0]
        first = word.split(",")[0]
        is_choice = name not in ("", key) and (folder / name).is_dir()
        if is_choice and re.fullmatch(r"[^=]+=[\w-]+", first):
            choices.append(first)
    GlobalHydra.instance().clear()  # of the request that failed
    with initialize_config_dir(str(folder), version_base="1.3"):
        try:
            return compose("study", choices)
        except HydraException:
            return compose("study")


def groups_with_package(group: str, message: str, folder: Path) -> list[str]:
    """Overridable names of a configuration group, each with its place, such as
    `reference@loop.reference`."""
    if match := re.search(r"Did you mean to override (?:one of )?(.+)\?", message):
        return match[1].split(", ")
    found_places: set[str] = set()
    for path in (folder / "experiment").glob("*.yaml"):
        in_file = re.findall(rf"/({group}@[\w.]+)", path.read_text())
        found_places |= {f"+{place}" for place in in_file}
    return sorted(found_places)


def choices_with_key(key: str, folder: Path) -> list[str]:
    """Choices of configuration groups whose files have a given key."""
    parts = key.split(".")
    choices = []
    for cut in range(1, len(parts)):
        group = "/".join(parts[:cut])
        setting = ".".join(parts[cut:])
        for path in sorted((folder / group).glob("*.yaml")):
            settings = [at for at, _, _ in walk_nodes(yaml.safe_load(path.read_text()))]
            if setting in settings:
                choices.append(f"{group}={path.stem}")
    return choices
