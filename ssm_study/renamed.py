"""Names from earlier versions, and the current name of each.

Old names are understood where files and arguments are read: in stored configurations, in the words
of a command, in `import` lines of other people's code, in the methods that their classes override.
Nowhere else: the package itself uses today's names alone. An old name is read for one version, and
a warning says so once.

The tables of renamed and withdrawn things are `old_names` and `withdrawn`; a test demands that
every entry leads somewhere, and that no withdrawn name is still there. This module imports nothing
of the science: `import ssm_study` installs it before anything else is imported.
"""

import importlib
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from ssm_study.old_names import COLUMNS, METHODS, MODULES, NAMES, SETTINGS
from ssm_study.refusal import BadRequest
from ssm_study.withdrawn import WITHDRAWN_CHOICES, WITHDRAWN_SETTINGS, WITHDRAWN_TARGETS, Withdrawal

OURS = "ssm_study"
CHANGELOG = "CHANGELOG.md, version 0.2.0"


class OldNameWarning(FutureWarning):
    """Warning that an old name was used, which is still understood for one version."""


# Names


@cache
def current_module(module: str) -> str:
    """Current dotted name of a module that may be imported under an old name."""
    inner = module.removeprefix(f"{OURS}.")
    if inner == module:
        return module
    words = inner.split(".")
    for count in range(len(words), 0, -1):
        old = ".".join(words[:count])
        if old in MODULES:
            return ".".join([OURS, MODULES[old], *words[count:]])
    return module


def current_symbol(module: str, name: str) -> tuple[str, str]:
    """Current module and name of a symbol that may be imported under an old name."""
    as_module = current_module(f"{module}.{name}")
    dotted = as_module.removeprefix(f"{OURS}.")
    dotted = NAMES.get(dotted, dotted)
    present = f"{OURS}.{dotted}" if module.split(".")[0] == OURS else f"{module}.{name}"
    holder, _, last = present.rpartition(".")
    return holder, last


def current_target(target: Any) -> Any:
    """Current dotted name of the class that a `_target_` setting names; a value that is no text is
    returned unchanged."""
    if not isinstance(target, str) or not target.startswith(f"{OURS}."):
        return target
    module, _, name = target.rpartition(".")
    return ".".join(current_symbol(module, name))


def withdrawn_target(target: Any) -> Withdrawal | None:
    """Notice for a `_target_` class that was removed; None for any other class."""
    return WITHDRAWN_TARGETS.get(str(target).removeprefix(f"{OURS}."))


def warn_of_old_name(old: str, new: str) -> None:
    """Warn once that a name is out of date, and give the current one."""
    if old not in _WARNED:
        _WARNED.add(old)
        message = f"{old} is now {new}; the old name is read in version 0.2 alone."
        warnings.warn(message, OldNameWarning, stacklevel=3)


_WARNED: set[str] = set()


# Settings


def current_settings(tree: Any, path: str = "") -> Any:
    """Settings of an earlier version, with every old name replaced by the current one.

    Raises `BadRequest` for a withdrawn setting whose value is not the neutral one.
    """
    if isinstance(tree, list):
        return [current_settings(value, f"{path}[]") for value in tree]
    if not isinstance(tree, dict):
        return tree
    present: dict[Any, Any] = {}
    for key, value in tree.items():
        place = f"{path}.{key}".lstrip(".")
        withdrawn = withdrawn_setting(place)
        if withdrawn is not None:
            refuse_withdrawn(place, value, withdrawn)
            continue
        name = SETTINGS.get(place, place).rpartition(".")[2]
        is_target = key == "_target_"
        present[name] = current_target(value) if is_target else current_settings(value, place)
    return type(tree)(present)


def rename_old_settings(config: Any) -> None:
    """Replace the old names in a composed or stored configuration by the current ones, in place.

    Raises `BadRequest` as `current_settings` does.
    """
    from omegaconf import OmegaConf, open_dict

    tree = OmegaConf.to_container(config, resolve=False)
    assert isinstance(tree, dict)
    hydra = tree.pop("hydra", None)
    del hydra  # its own section, whose targets are its own
    present = current_settings(tree)
    with open_dict(config):
        for key in tree:
            if key not in present:
                del config[key]
        for key, value in present.items():
            if key not in tree or value != tree[key]:
                config[key] = value


def withdrawn_setting(path: str) -> Withdrawal | None:
    """Notice for a removed setting, given by its dotted path; None for any other setting."""
    words = path.split(".")
    for pattern, withdrawn in WITHDRAWN_SETTINGS.items():
        parts = pattern.split(".")
        alike = [part in ("*", word) for part, word in zip(parts, words, strict=False)]
        if len(parts) == len(words) and all(alike):
            return withdrawn
    return None


def refuse_withdrawn(path: str, value: Any, withdrawn: Withdrawal) -> None:
    """Raise `BadRequest` for a removed setting, unless its value had no effect."""
    if value != withdrawn.neutral:
        problem = f"was {withdrawn.sentence} ({CHANGELOG})"
        raise BadRequest(path, value, problem, withdrawn.remedy)


def current_override(word: str) -> str:
    """Command-line override such as `model.integrated=true`, with its old name replaced by the
    current one.

    Raises `BadRequest` with the line of the changelog for what was withdrawn.
    """
    key, equals, value = word.partition("=")
    path = key.lstrip("+~")
    marks = key.removesuffix(path)
    withdrawn = withdrawn_setting(path)
    if withdrawn is not None and equals:
        is_neutral = value.lower() == str(withdrawn.neutral).lower()
        refuse_withdrawn(path, withdrawn.neutral if is_neutral else value, withdrawn)
        return ""
    for choice in value.strip("[]").split(",") if equals else ():
        gone = WITHDRAWN_CHOICES.get(f"{path}={choice.strip()}")
        if gone is not None:
            problem = f"was {gone.sentence} ({CHANGELOG})"
            raise BadRequest(path, choice.strip(), problem, gone.remedy)
    if path in SETTINGS:
        warn_of_old_name(path, SETTINGS[path])
        return f"{marks}{SETTINGS[path]}{equals}{value}"
    return f"{key}={current_target(value)}" if path.endswith("_target_") else word


def current_overrides(words: Sequence[str]) -> list[str]:
    """Command-line overrides with old names replaced by current ones, and without overrides that
    have no effect any more."""
    present = [current_override(word) for word in words]
    return [word for word in present if word]


# Columns


def add_renamed_columns(record: Mapping[str, Any]) -> dict[str, Any]:
    """Copy of a record that contains every renamed column under its old and its new name."""
    both = dict(record)
    for old, new in COLUMNS.items():
        if new in record:
            both.setdefault(old, record[new])
        elif old in record:
            both[new] = record[old]
    return both


# Imports


class OldModuleFinder(MetaPathFinder):
    """Import hook that redirects imports of renamed modules and makes renamed functions importable
    under their old names."""

    def find_spec(
        self, fullname: str, path: Any = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Module specification for an import under an old name, or of a module with renamed
        contents; None for any other."""
        del target
        if not fullname.startswith(f"{OURS}."):
            return None
        present = current_module(fullname)
        if present != fullname:
            return ModuleSpec(fullname, AliasLoader(present), is_package=True)
        inner = fullname.removeprefix(f"{OURS}.")
        if inner not in _modules_with_renames():
            return None
        spec = _find_module_spec(fullname, path)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                """Run the code of a newly imported module, then add the old names to it."""
                execute(module)
                _restore_old_names(module, inner)

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _find_module_spec(fullname: str, path: Any) -> ModuleSpec | None:
    """Module specification that the other import hooks find for a module name."""
    for finder in sys.meta_path:
        if not isinstance(finder, OldModuleFinder):
            spec = finder.find_spec(fullname, path)
            if spec is not None:
                return spec
    return None


class AliasLoader(Loader):
    """Module loader that returns the renamed module when its old name is imported."""

    def __init__(self, present: str) -> None:
        self.present = present

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Module with the new name, which is used in place of the module with the old name."""
        del spec
        return None

    def exec_module(self, module: ModuleType) -> None:
        """Execute nothing, as the module of the new name is already loaded; only warn of the old
        name."""
        warn_of_old_name(module.__name__, self.present)
        # The import takes what stands in sys.modules afterwards.
        sys.modules[module.__name__] = importlib.import_module(self.present)


@cache
def _modules_with_renames() -> frozenset[str]:
    """Names of all modules that contain a renamed class, function or method."""
    return frozenset(name.rpartition(".")[0] for name in (*NAMES, *METHODS))


def _restore_old_names(module: ModuleType, inner: str) -> None:
    """Make the functions, classes and methods of a newly imported module available under their old
    names."""
    holder = f"{inner}."
    old_names = {
        old.removeprefix(holder): new
        for old, new in NAMES.items()
        if old.rpartition(".")[0] == inner
    }

    def find_renamed_object(name: str) -> Any:
        """Find the object that an old name in a module stands for, and warn that the name is
        old."""
        if name not in old_names:
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        warn_of_old_name(f"{module.__name__}.{name}", f"{OURS}.{old_names[name]}")
        place, _, present = old_names[name].rpartition(".")
        return getattr(importlib.import_module(f"{OURS}.{place}"), present)

    if old_names:
        vars(module).setdefault("__getattr__", find_renamed_object)
    for dotted, methods in METHODS.items():
        place, _, name = dotted.rpartition(".")
        if place == inner:
            support_old_methods(getattr(module, name), methods)


def support_old_methods(base: type, methods: Mapping[str, str]) -> None:
    """Make renamed methods of a class and of its subclasses usable under their old names, for calls
    and for overriding."""
    add_method_aliases(base, methods)
    for kind in _all_subclasses(base):
        add_method_aliases(kind, methods)
    defined = vars(base).get("__init_subclass__")

    def redirect_renamed_overrides(cls: type, **options: Any) -> None:
        """Let a subclass's method with an old name override the renamed method."""
        add_method_aliases(cls, methods)
        if defined is None:
            super(base, cls).__init_subclass__(**options)  # type: ignore[arg-type]
        else:
            function: Callable[..., None] = defined.__func__
            function(cls, **options)

    base.__init_subclass__ = classmethod(redirect_renamed_overrides)  # type: ignore[assignment]


def add_method_aliases(kind: type, methods: Mapping[str, str]) -> None:
    """Make each renamed method of a class available under both its old and its new name."""
    for old, new in methods.items():
        defined = vars(kind)
        if old in defined and new not in defined:
            warn_of_old_name(f"{kind.__name__}.{old}", f"{kind.__name__}.{new}")
            setattr(kind, new, defined[old])
        elif new in defined and old not in defined:
            setattr(kind, old, defined[new])


def _all_subclasses(base: type) -> Iterator[type]:
    """Iterate over all direct and indirect subclasses of a class."""
    subclasses: list[type] = base.__subclasses__()
    for kind in subclasses:
        yield kind
        yield from _all_subclasses(kind)


def install_import_hook() -> None:
    """Install the import hook that makes old module names importable."""
    if not any(isinstance(finder, OldModuleFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, OldModuleFinder())
    for (
        inner
    ) in _modules_with_renames():  # imported before this, by whatever imports the package in parts
        with suppress(KeyError):
            _restore_old_names(sys.modules[f"{OURS}.{inner}"], inner)
