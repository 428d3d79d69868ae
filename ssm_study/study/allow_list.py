"""List of the classes that a configuration may construct, so that a stranger's configuration cannot
run a program."""

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ssm_study.engine.settings import plain_settings, walk_nodes
from ssm_study.extensions import trusted_packages
from ssm_study.refusal import require
from ssm_study.renamed import withdrawn_target

# The rooms whose classes are specifications; the others (cli, study, report) act on the world.
ROOMS = (
    "plants",
    "data",
    "models",
    "training",
    "bounds",
    "certificates",
    "robustness",
    "synthesis",
    "loop",
)
# Hydra's own section: what Hydra instantiates before any of our code is asked.
PLUGINS = re.compile(r"(hydra\._internal\.core_plugins|hydra_plugins)(\.[a-z_]\w*)+\.[A-Z]\w*")
FOLDERS = {
    "hydra.output_subdir": (None,),
    "hydra.run.dir": ("${results_dir}/${study}/${run}",),
    "hydra.sweep.dir": ("${results_dir}/${study}",),
    "hydra.sweep.subdir": ("${run}",),
}
# What a configuration may hold besides its parts: a key that nobody reads is a mistake.
KEYS = frozenset(
    {"seed", "loop_seed", "refine", "study", "run", "results_dir", "hydra"}
    | {"dry_run", "progress", "retry_failed", "strict"}
)
PARTS = ("plant", "excitation", "data", "model", "training", "reduction", "synthesis", "loop")
ENVIRONMENT = re.compile(
    r"(OMP|MKL|OPENBLAS)_NUM_THREADS|OMP_WAIT_POLICY|CUDA_VISIBLE_DEVICES|MALLOC_\w+_"
)
# The interpolations that a configuration may hold: another key, and the name of a run. A resolver's
# name may itself be interpolated, so whatever is nested or has another resolver is refused.
INTERPOLATION = re.compile(r"\$\{\s*(?:[\w.\[\]]+|run_name:[^${}]*)\s*\}")
HYDRAS_INTERPOLATION = re.compile(r"\$\{\s*(?:[\w.\[\]]+|(?:hydra|now|run_name):[^${}]*)\s*\}")
REMEDY = "name a part of ssm_study; your own study: add --with FOLDER"


def refuse_foreign_targets(config: DictConfig) -> None:
    """Raise `BadRequest` if a configuration names a class outside the allow list, before anything
    is constructed.

    Allowed as `_target_`: classes defined in our own specification rooms; in Hydra's section its
    plugins. Refused as well: interpolations that read the environment (secrets would end up in
    saved configurations) or build nodes from text, and logging handlers made by factories.
    """
    tree = OmegaConf.to_container(config, resolve=False)
    assert isinstance(tree, dict)
    hydra = tree.pop("hydra", None)
    _refuse_foreign_classes(
        tree
    )  # before anything is resolved: an interpolation may already read what it must not
    for path, key, value in walk_nodes(hydra, "hydra."):
        _refuse_unsafe_hydra_value(path, key, value)
    if any("${" in str(value) for key, value in tree.items() if key != "run"):
        _refuse_foreign_classes(
            plain_settings(config)
        )  # what the remaining interpolations bring in


def _refuse_foreign_classes(tree: Any) -> None:
    """Raise `BadRequest` for a forbidden class in the settings of a study."""
    problem = "this interpolation reads the environment or builds configuration from text"
    for path, key, value in walk_nodes(tree):
        if key == "_target_" and (gone := withdrawn_target(value)):
            require(False, path, value, gone.sentence, gone.remedy)
        require(
            key != "_target_" or is_allowed_target(value),
            path,
            value,
            "a configuration may not create this class",
            REMEDY,
        )
        is_plain = has_only_allowed_interpolations(INTERPOLATION, value)
        require(is_plain, path, value, problem, "write the value itself")


def has_only_allowed_interpolations(allowed: re.Pattern[str], value: Any) -> bool:
    """Whether a configuration value contains only `${...}` interpolations of an allowed form."""
    return not isinstance(value, str) or value.count("${") == len(allowed.findall(value))


def _refuse_unsafe_hydra_value(path: str, key: str, value: Any) -> None:
    """Raise `BadRequest` for a value in Hydra's own section that could run a program."""
    is_plain = has_only_allowed_interpolations(HYDRAS_INTERPOLATION, value)
    problem = "this interpolation reads the environment or builds configuration from text"
    require(is_plain, path, value, problem, "write the value itself")
    if key == "_target_":
        allowed = PLUGINS.fullmatch(str(value)) is not None
        require(
            allowed,
            path,
            value,
            "a configuration may not create this class",
            "use Hydra's own plugins",
        )
    if (
        key in ("()", "class") and "_logging." in path
    ):  # `()` is the factory of logging.config: any function at all
        standard = key == "class" and str(value).startswith("logging.")
        remedy = "use a handler class of logging"
        require(standard, path, value, "only classes of Python's logging are allowed here", remedy)
    if path in FOLDERS:
        is_usual = value in FOLDERS[path]
        require(
            is_usual,
            path,
            value,
            "a run lies in results_dir/study/run",
            "choose results_dir and study",
        )
    if path.startswith("hydra.job.env_set."):
        require(
            bool(ENVIRONMENT.fullmatch(key)),
            path,
            value,
            "this variable may not be set",
            "set it in your shell",
        )


def is_allowed_target(target: Any) -> bool:
    """Whether a dotted name stands for a class that a configuration file may construct."""
    if not isinstance(target, str):
        return False
    trusted = "|".join([rf"ssm_study\.({'|'.join(ROOMS)})", *map(re.escape, trusted_packages())])
    if not re.fullmatch(rf"({trusted})(\.[a-z]\w*)+\.[A-Z]\w*", target):
        return False
    module, _, name = target.rpartition(".")
    try:
        spec = find_spec(module)  # imports the packages above it, not the module
    except ModuleNotFoundError:
        return False
    source = Path(spec.origin).read_text(encoding="utf-8") if spec and spec.origin else ""
    return (
        re.search(rf"^class {name}\b", source, re.MULTILINE) is not None
    )  # nothing imported from elsewhere
