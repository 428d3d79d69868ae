"""One-sentence messages for requests that Hydra refuses, each with the request that was probably
meant."""

import re
from difflib import get_close_matches
from pathlib import Path

import yaml  # type: ignore[import-untyped]
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from ssm_study.cli.request import OPTIONS
from ssm_study.engine.settings import nodes
from ssm_study.refusal import BadRequest, require

ASK = "see `ssm-study run --help`"


def advised(error: BaseException, overrides: list[str], folder: Path) -> BadRequest:
    """The refusal of `overrides` over the configuration in `folder` that Hydra answered with
    `error`."""
    asked = " ".join(overrides) or "(no override)"
    said = one_sentence(error)
    if isinstance(error, OverrideParseException):  # its grammar's tokens say nothing to a reader
        remedy = "write KEY=VALUE, in a sweep KEY=VALUE,VALUE, and close what you open"
        return BadRequest("request", asked, f"{error.override} cannot be read", remedy)
    if found := re.search(r"Could not find '(.+)/([^/']+)' Available options in '.+': (.+)", said):
        group = found[1]
        name = found[2]
        choices = found[3].split()
        near = get_close_matches(name, choices, n=1)
        remedy = (
            f"did you mean {group}={near[0]}?" if near else f"choose among {', '.join(choices)}"
        )
        return BadRequest("request", asked, f"there is no {group}/{name}", remedy)
    if found := re.search(r"Ambiguous value for argument '(.+?)'", said):
        return BadRequest(
            "request",
            asked,
            f"{found[1]} are several values for one run",
            "add -m to sweep over them",
        )
    if "Config group override" in said:
        return BadRequest("request", asked, "a group takes the name of one of its choices", ASK)
    if found := re.search(r"Could not override '([^']+)'", said):
        if at := places(found[1], said, folder):
            value = next(
                (word.partition("=")[2] for word in overrides if word.split("=")[0] == found[1]),
                "VALUE",
            )
            remedy = " or ".join(f"{place}={value}" for place in at)
            return BadRequest(
                "request", asked, f"{found[1]} is named with its place", f"did you mean {remedy}?"
            )
        return BadRequest("request", asked, said, meant(found[1], overrides, folder) or ASK)
    return BadRequest("request", asked, said, ASK)


def one_sentence(error: BaseException) -> str:
    """Hydra's and OmegaConf's messages without their appendices."""
    text = str(error)
    for appendix in ("\n    full_key", "\nConfig search path", "\nSee https://", "\nTo append"):
        text = text.split(appendix)[0]
    return " ".join(text.split()).rstrip(".")


def refuse_dashes(overrides: list[str], folder: Path) -> None:
    """Raise `BadRequest` for a setting that is written like an option, `--model.order 4`, and for
    Hydra's rerun.

    Also for an option that is nearly one of ours; to others Hydra answers.
    """
    near = {
        word: get_close_matches(word, OPTIONS, n=1, cutoff=0.8)
        for word in overrides
        if word not in OPTIONS
    }
    for word in (word for word in near if near[word] and word.startswith("--")):
        raise BadRequest(
            "request", word, "there is no such option", f"did you mean {near[word][0]}?"
        )
    settings = {
        "seed",
        "study",
        "results_dir",
        *(group.name for group in folder.iterdir() if group.is_dir()),
    }
    for word in overrides:
        key = word.removeprefix("--").split("=")[0]
        dashed = word.startswith("--") and ("." in key or key in settings)
        require(not dashed, "request", word, "a setting has no dashes", f"write {key}=VALUE")
        # It would load a pickle: foreign code.
        rerun = word.startswith("--e") and "experimental-rerun".startswith(key)
        require(
            not rerun,
            "request",
            word,
            "a stored job is not run again",
            "use `ssm-study reproduce RUN`",
        )


def meant(key: str, overrides: list[str], folder: Path) -> str:
    """For a key that is not there: the choice that has it, else the nearest key or group, else
    nothing."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    if owners := choices_with(key, folder):
        return f"{' and '.join(owners)} {'have' if len(owners) > 1 else 'has'} it: add {owners[0]}"
    GlobalHydra.instance().clear()  # of the request that failed
    with initialize_config_dir(str(folder), version_base="1.3"):
        chosen = [
            word
            for word in overrides
            if (name := word.split("=")[0]) not in ("", key) and (folder / name).is_dir()
        ]
        # Of a sweep the first choice; what names no choice says nothing about what was meant.
        firsts = [word.split(",")[0] for word in chosen]
        plain = [word for word in firsts if re.fullmatch(r"[^=]+=[\w-]+", word)]
        try:
            config = compose("study", plain)
        except HydraException:
            config = compose("study")
    groups = [path.name for path in folder.iterdir() if path.is_dir()]
    known = [*(path for path, _, _ in nodes(OmegaConf.to_container(config))), *groups]
    near = get_close_matches(key, known, n=1) or [
        group for group in groups if len(key) > 2 and group.startswith(key)
    ]
    return f"did you mean {near[0]}?" if near else ""


def places(group: str, said: str, folder: Path) -> list[str]:
    """`reference` -> `[reference@loop.reference]`: as Hydra says, or of a group that is in no
    request, as we add it."""
    if found := re.search(r"Did you mean to override (?:one of )?(.+)\?", said):
        return found[1].split(", ")
    texts = [path.read_text() for path in sorted((folder / "experiment").glob("*.yaml"))]
    return sorted(
        {f"+{place}" for text in texts for place in re.findall(rf"/({group}@[\w.]+)", text)}
    )


def choices_with(key: str, folder: Path) -> list[str]:
    """`data.path` -> `[data=recorded]`: the choices of a group, not taken here, that have the
    key."""
    parts = key.split(".")
    found = []
    for cut in range(1, len(parts)):
        rest = ".".join(parts[cut:])
        for path in sorted(folder.joinpath(*parts[:cut]).glob("*.yaml")):
            if rest in (at for at, _, _ in nodes(yaml.safe_load(path.read_text()))):
                found.append(f"{'/'.join(parts[:cut])}={path.stem}")
    return found
