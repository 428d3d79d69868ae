"""Check of a request before Hydra acts on it: the program's own options, and every configuration of
a sweep."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import OmegaConf

from ssm_study.engine.compose import (
    Composer,
    FastConfigurationLoader,
    HydraCommandLine,
    grid_combinations,
)
from ssm_study.engine.jobs import create_jobs
from ssm_study.engine.progress import ProgressWatcher
from ssm_study.engine.settings import refuse_nonfinite_settings
from ssm_study.refusal import require
from ssm_study.renamed import current_overrides, rename_old_settings
from ssm_study.study.allow_list import refuse_foreign_targets

OPEN = "--open"  # shows the page at the end
OPTIONS = {
    "--dry-run": ("hydra/launcher=processes", "dry_run=true"),
    "--retry-failed": ("retry_failed=true",),
    "--strict": ("strict=true",),
    OPEN: (),
}
# With --dry-run nothing is launched, so what was said about another launcher does not matter.
LAUNCHER = ("hydra/launcher=", "hydra.launcher.")
SINE = re.compile(r"""(?<!["'\w])(\w+\([^()"']*\))""")
# What Hydra answers by itself: versions, the composed configuration.
JUST_ASKING = (
    "--hydra-help",
    "--version",
    "--cfg",
    "-c",
    "--info",
    "-i",
    "--shell-completion",
    "-sc",
)


def translate_arguments(arguments: list[str]) -> list[str]:
    """Translate the options of `ssm-study run` into command-line arguments for Hydra. `-m` may
    stand anywhere."""
    # Only a launcher can plan.
    many = any(word in ("-m", "--multirun", "--dry-run") for word in arguments)
    rest = [word for word in arguments if word not in ("-m", "--multirun")]
    if "--dry-run" in rest:
        rest = [word for word in rest if not word.lstrip("+~").startswith(LAUNCHER)]
    words = [word for argument in rest for word in OPTIONS.get(argument, (argument,))]
    return ["--multirun"] * many + quote_sines(current_overrides(words))


def quote_sines(arguments: Iterable[str]) -> list[str]:
    """Put quotes around command-line words such as `sine(0.5Hz)`, which Hydra would otherwise read
    as a function call."""
    return [SINE.sub(r"'\1'", word) if "internal_model=" in word else word for word in arguments]


def compose_request(arguments: list[str], folder: Path, name: str) -> HydraCommandLine:
    """Compose the configuration that a command line requests; raise `BadRequest` for a class
    outside the allow list.

    Hydra makes callbacks, launcher and sweeper before any code of ours is asked; so this comes
    first. Raises `BadRequest`, and whatever Hydra raises for a request it cannot compose.
    """
    request = HydraCommandLine(arguments, folder, name)
    refuse_missing_choices(request)
    rename_old_settings(request.config)
    refuse_foreign_targets(request.config)
    refuse_empty_dictionaries(request)
    refuse_nonfinite_settings(OmegaConf.to_container(request.config, resolve=False))
    return request


def parse_overrides(request: HydraCommandLine) -> list[Override]:
    """Parse the overrides of a requested configuration. Raises Hydra's error for an override that
    cannot be parsed."""
    parser = OverridesParser.create(config_loader=request.config_loader)
    return parser.parse_overrides(list(request.asked.overrides))


def refuse_missing_choices(request: HydraCommandLine) -> None:
    """Raise `BadRequest` for a configuration group without a choice, such as `plant=`, which Hydra
    reports unclearly."""
    assert isinstance(request.config_loader, FastConfigurationLoader)
    for override in parse_overrides(request):
        key = str(override.key_or_group)
        if override.is_sweep_override() or not request.config_loader.repository.group_exists(key):
            continue
        value = override.value()
        names = value if isinstance(value, list) else [value]
        are_names = bool(names) and all(isinstance(name, str) for name in names)
        is_choice = value is None or value == {} or are_names
        problem = "is no name of a choice"
        require(is_choice, key, value, problem, "see the choices in `ssm-study run --help`")


def refuse_empty_dictionaries(request: HydraCommandLine) -> None:
    """Raise `BadRequest` for an empty dictionary such as `plant={}`, which Hydra would merge
    without any effect."""
    for override in parse_overrides(request):
        key = str(override.key_or_group)
        value = override.value()
        changes = value != {} or override.type is not OverrideType.CHANGE
        problem = "has no effect, because its entries are merged into those that are there"
        require(changes, key, value, problem, f"write {key}=null for none, or name a choice")


@contextmanager
def check_jobs_before_start(request: HydraCommandLine) -> Iterator[None]:
    """Context manager in which every job of a sweep is checked before Hydra starts. It also shows
    progress where the launcher reports none.

    The jobs that a search asks for are not known beforehand: a wrong one is a failed row.
    """
    from ssm_study.study.line import STUDY, refuse_retry_without_runs

    config, launcher = request.config, str(request.config.hydra.launcher._target_)
    refuse_retry_without_runs(config, "*" if request.is_sweep else str(config.run))
    if not request.is_sweep:
        settings = STUDY.settings(config)
        _ = STUDY.outcome_without_running(settings) or STUDY.request(
            settings
        )  # built only if it is to run
    # Ours checks its jobs, and counts them.
    if not request.is_sweep or launcher.endswith("ProcessesLauncher"):
        yield
        return
    jobs = create_jobs(
        Composer(request.config_loader, config, STUDY.refuse_invalid_configuration),
        grid_combinations(config),
    )
    # On Slurm our launcher checks them, too.
    for job in jobs if "ssm_study" not in launcher else ():
        if STUDY.outcome_without_running(job.settings) is None:
            job.check_settings(STUDY)
    with ProgressWatcher([job.folder for job in jobs]) if jobs else nullcontext():
        yield
