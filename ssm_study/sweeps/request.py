"""What was asked for, looked at before Hydra acts on it: our two options, and every configuration of a sweep."""

from pathlib import Path

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import setup_globals
from hydra.types import RunMode, TaskFunction
from omegaconf import DictConfig, OmegaConf

from ssm_study.results.allow_list import refuse_foreign_targets
from ssm_study.sweeps.sweep import Job, check_all, jobs_of

OPTIONS = {"--dry-run": ("hydra/launcher=processes", "dry_run=true"), "--retry-failed": ("retry_failed=true",)}
# With --dry-run nothing is launched, so what was said about another launcher does not matter.
LAUNCHER = ("hydra/launcher=", "hydra.launcher.", "+hydra.launcher.")
GRIDS = ("hydra_plugins.ssm_study_launcher.GridSweeper", "hydra._internal.core_plugins.basic_sweeper.BasicSweeper")
JUST_ASKING = ("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--info", "-i", "--shell-completion", "-sc")


def translate(arguments: list[str]) -> list[str]:
    """Our own options of `ssm-study run` as Hydra's arguments; `-m` may stand anywhere."""
    many = any(word in ("-m", "--multirun", "--dry-run") for word in arguments)
    rest = [word for word in arguments if word not in ("-m", "--multirun")]
    if "--dry-run" in rest:
        rest = [word for word in rest if not word.startswith(LAUNCHER)]
    return ["--multirun"] * many + [word for argument in rest for word in OPTIONS.get(argument, (argument,))]


def asks_only(arguments: list[str]) -> bool:
    """Whether Hydra answers by itself: help, versions, the composed configuration."""
    return any(word.split("=")[0] in JUST_ASKING for word in arguments)


def check_request(arguments: list[str], folder: Path, name: str) -> None:
    """Compose what `hydra.main` will compose and refuse foreign targets in it, Hydra's own section included.

    Hydra instantiates callbacks, launcher and sweeper before any code of ours is asked; so this comes first.
    Raises `BadRequest`, and whatever Hydra raises for a request it cannot compose.
    """
    if asks_only(arguments):
        return
    setup_globals()
    asked = get_args_parser().parse_args(arguments)
    search_path = create_config_search_path(str(Path(asked.config_path).absolute() if asked.config_path else folder))
    if asked.config_dir is not None:
        search_path.prepend(provider="command-line", path=f"file://{Path(asked.config_dir).absolute()}")
    loader = ConfigLoaderImpl(config_search_path=search_path)
    mode = RunMode.MULTIRUN if asked.multirun else RunMode.RUN
    config = loader.load_configuration(asked.config_name or name, overrides=asked.overrides, run_mode=mode)
    HydraConfig.instance().set_config(config)
    refuse_foreign_targets(config)


def check_sweep(config: DictConfig, task_function: TaskFunction) -> list[Job]:
    """Compose every job of the sweep, whatever its launcher, and refuse it whole if one of them is wrong.

    For `on_multirun_start`, where `config` is the sweep's own configuration.
    """
    if config.hydra.sweeper._target_ not in GRIDS:
        return []  # a search does not know its jobs beforehand; the launcher checks them as they come
    words = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
    assert isinstance(words, list)
    jobs = jobs_of(GlobalHydra.instance().config_loader(), config, combinations(words), 0)
    check_all(task_function, jobs)
    return jobs


def combinations(words: list[str]) -> list[list[str]]:
    """`a=1,2 b=3` -> `[[a=1, b=3], [a=2, b=3]]`, as Hydra's basic sweeper combines them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    overrides = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader()).parse_overrides(words)
    return BasicSweeper.split_arguments(overrides, max_batch_size=None)[0]
