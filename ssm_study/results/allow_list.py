"""A configuration from a stranger must not run a program: only what is named here may be instantiated."""

import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ssm_study.refusal import require
from ssm_study.results.naming import plain

# The rooms whose classes are specifications; the others (cli, results, report) act on the world.
ROOMS = ("plants", "data", "models", "training", "bounds", "synthesis", "loop")
TORCH = re.compile(r"torch\.optim\.(lr_scheduler\.)?[A-Z][A-Za-z]+")
LIGHTNING = frozenset(
    {
        f"lightning.pytorch.callbacks.{name}"
        for name in ("EarlyStopping", "LearningRateMonitor", "ModelCheckpoint", "Timer")
    }
    | {
        f"lightning.pytorch.callbacks.{name}"
        for name in ("RichProgressBar", "TQDMProgressBar", "GradientAccumulationScheduler")
    }
    | {
        f"lightning.pytorch.loggers.{name}"
        for name in ("CSVLogger", "TensorBoardLogger", "WandbLogger", "MLFlowLogger")
    }
)
# Hydra's own section: what Hydra instantiates before any of our code is asked.
PLUGINS = re.compile(r"(hydra\._internal\.core_plugins|hydra_plugins)(\.[a-z_]\w*)+\.[A-Z]\w*")
OUR_CALLBACKS = re.compile(r"ssm_study\.cli\.StudyCallback")
PRELOADED = re.compile(r"(ssm_study|torch|lightning|numpy|scipy|cvxpy)(\.\w+)*")
ENVIRONMENT = re.compile(r"(OMP|MKL|OPENBLAS)_NUM_THREADS|OMP_WAIT_POLICY|CUDA_VISIBLE_DEVICES|MALLOC_\w+_")
RESOLVERS = re.compile(r"\$\{\s*(oc\.env|env|oc\.decode|oc\.create|oc\.deprecated)\s*:")
REMEDY = (
    "name a specification of ssm_study, a class of torch.optim, or one of the Lightning parts listed in allow_list.py"
)


def refuse_foreign_targets(config: DictConfig) -> None:
    """Walk the whole tree before anything is instantiated; raises `BadRequest` for the first key that is not ours.

    Allowed as `_target_`: classes defined in our own specification rooms, `torch.optim`, and the named Lightning parts;
    in Hydra's section its plugins and our callbacks. Refused as well: interpolations that read the environment (secrets
    would end up in saved configurations) or build nodes from text, and logging handlers made by factories.
    """
    tree = OmegaConf.to_container(config, resolve=False)
    assert isinstance(tree, dict)
    hydra = tree.pop("hydra", None)
    _walk(tree, "", _refuse_in_task)
    if isinstance(hydra, dict):
        _walk(hydra, "hydra", _refuse_in_hydra)
    _walk(plain(config), "", _refuse_in_task)  # what the remaining interpolations bring in


def _walk(node: Any, path: str, refuse: Callable[[str, str, Any], None]) -> None:
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        inner = f"{path}.{key}" if path else str(key)
        refuse(inner, str(key), value)
        _walk(value, inner, refuse)


def _refuse_in_task(path: str, key: str, value: Any) -> None:
    if key == "_target_":
        require(is_ours(value), path, value, "this may not be instantiated", REMEDY)
    if isinstance(value, str):
        problem = "this interpolation reads the environment or builds configuration from text"
        require(RESOLVERS.search(value) is None, path, value, problem, "write the value itself")


def _refuse_in_hydra(path: str, key: str, value: Any) -> None:
    if key == "_target_":
        allowed = OUR_CALLBACKS if path.startswith("hydra.callbacks.") else PLUGINS
        require(
            bool(allowed.fullmatch(str(value))), path, value, "this may not be instantiated", "use Hydra's own plugins"
        )
    if key in ("()", "class") and "_logging." in path:
        standard = key == "class" and str(value).startswith("logging.")
        require(
            standard, path, value, "logging is not made by foreign classes", "use a handler class of the logging module"
        )
    if path == "hydra.launcher.preload":
        names = value if isinstance(value, list) else [value]
        ours = all(PRELOADED.fullmatch(str(name)) for name in names)
        require(ours, path, value, "foreign modules are not imported", "name modules of ssm_study, torch or lightning")
    if path.startswith("hydra.job.env_set."):
        require(bool(ENVIRONMENT.fullmatch(key)), path, value, "this variable may not be set", "set it in your shell")


def is_ours(target: Any) -> bool:
    """Whether `target` names a class that a configuration may instantiate."""
    if not isinstance(target, str):
        return False
    if TORCH.fullmatch(target) or target in LIGHTNING:
        return True
    return bool(re.fullmatch(rf"ssm_study\.({'|'.join(ROOMS)})(\.[a-z]\w*)+\.[A-Z]\w*", target)) and _is_own_class(
        target
    )


def _is_own_class(target: str) -> bool:
    """A class defined in the very module named: not something that the module has imported."""
    module_name, name = target.rsplit(".", 1)
    try:
        found = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError):
        return False
    return inspect.isclass(found) and found.__module__ == module_name
