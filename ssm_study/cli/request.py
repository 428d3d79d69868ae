"""A request, checked before Hydra acts on it: our three options, and every configuration of a sweep."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from ssm_study.engine.compose import Command, Composer, combinations
from ssm_study.engine.jobs import Job, jobs_of
from ssm_study.engine.settings import refuse_unbounded
from ssm_study.engine.task import Task
from ssm_study.study.allow_list import refuse_foreign_targets

OPTIONS = {
    "--dry-run": ("hydra/launcher=processes", "dry_run=true"),
    "--retry-failed": ("retry_failed=true",),
    "--strict": ("strict=true",),
}
# With --dry-run nothing is launched, so what was said about another launcher does not matter.
LAUNCHER = ("hydra/launcher=", "hydra.launcher.", "+hydra.launcher.")
SINE = re.compile(r"""(?<!["'\w])(\w+\([^()"']*\))""")
# What Hydra answers by itself: versions, the composed configuration.
JUST_ASKING = ("--hydra-help", "--version", "--cfg", "-c", "--info", "-i", "--shell-completion", "-sc")


def translate(arguments: list[str]) -> list[str]:
    """Our own options of `ssm-study run` as Hydra's arguments; `-m` may stand anywhere."""
    many = any(word in ("-m", "--multirun", "--dry-run") for word in arguments)  # only a launcher can plan
    rest = [word for word in arguments if word not in ("-m", "--multirun")]
    if "--dry-run" in rest:
        rest = [word for word in rest if not word.startswith(LAUNCHER)]
    words = [word for argument in rest for word in OPTIONS.get(argument, (argument,))]
    return ["--multirun"] * many + quoted(words)


def quoted(words: Iterable[str]) -> list[str]:
    """`internal_model=[sine(0.5Hz)]` with the sine in quotes: to Hydra it would be a function."""
    return [SINE.sub(r"'\1'", word) if "internal_model=" in word else word for word in words]


def check_request(arguments: list[str], folder: Path, name: str) -> Command:
    """The request, composed; refused are foreign targets, Hydra's own section included.

    Hydra makes callbacks, launcher and sweeper before any code of ours is asked; so this comes first.
    Raises `BadRequest`, and whatever Hydra raises for a request it cannot compose.
    """
    request = Command(arguments, folder, name)
    refuse_foreign_targets(request.config)
    refuse_unbounded(OmegaConf.to_container(request.config, resolve=False))
    return request


def check_sweep(config: DictConfig, task: Task[Any]) -> list[Job]:
    """Compose every job of the sweep, whatever its launcher, and refuse it whole if one of them is wrong.

    For `on_multirun_start`, where `config` is the sweep's own configuration. A search does not know its jobs
    beforehand; the launcher checks them as they come.
    """
    composer = Composer(GlobalHydra.instance().config_loader(), config, task.refuse)
    jobs = jobs_of(composer, combinations(config))
    for job in jobs:
        job.check(task)
    return jobs
