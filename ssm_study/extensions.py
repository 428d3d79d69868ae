"""Extension packages of users: which are trusted, where they are, and how they are loaded. Also the
folders with configuration files, the project's own and theirs.

Trusted are installed packages that register an entry point of the group `ssm_study`, and the one
folder that is named on the command line by `--with`. Nothing else is imported, and no configuration
of anything else is read. Such a package holds `conf/` (yaml files by group, as ours), the classes
they name by `_target_`, and `figures/`. Importing it makes known what is found by its kind, a
scaffolding for instance.
"""

import os
import sys
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules

from ssm_study.refusal import require

GROUP = "ssm_study"
OPTION = "--with"
FOLDER = "SSM_STUDY_WITH"  # holds it for the processes that work on a study, on other machines too


def pop_extension_option(arguments: list[str]) -> list[str]:
    """Remove `--with FOLDER` from command-line arguments, and trust the extension package in that
    folder. Raises `BadRequest` if the folder holds none."""
    if OPTION not in arguments:
        return arguments
    place = arguments.index(OPTION)
    require(
        len(arguments) > place + 1, OPTION, "", "names no folder", "give the folder of your study"
    )
    trust_package(Path(arguments[place + 1]))
    return arguments[:place] + arguments[place + 2 :]


def trust_package(folder: Path) -> None:
    """Trust the extension package in a folder, so that it can be imported and its classes can be
    named in configurations. Raises `BadRequest` if there is none."""
    folder = folder.resolve()
    whole = folder.name.isidentifier() and (folder / "__init__.py").is_file()
    require(whole, OPTION, folder, "is no study folder", "make one: ssm-study new FOLDER")
    os.environ[FOLDER] = str(folder)
    trusted_packages.cache_clear()
    trusted_packages()


@cache
def trusted_packages() -> dict[str, Path]:
    """Names and folders of all trusted extension packages. Raises `BadRequest` if Python finds
    another package under the folder's name."""
    points = sorted(point.module.split(".")[0] for point in entry_points(group=GROUP))
    trusted_folders = {
        name: folder for name in points if (folder := _package_folder(name)) is not None
    }
    if own := os.environ.get(FOLDER):
        folder = Path(own)
        if str(folder.parent) not in sys.path:
            sys.path.append(str(folder.parent))
        meant = _package_folder(folder.name)
        require(
            meant == folder,
            OPTION,
            own,
            f"the name {folder.name} is taken by {meant}",
            "rename the folder",
        )
        trusted_folders[folder.name] = folder
    return trusted_folders


def configuration_folder() -> Path:
    """Folder of the configuration files, in the installed package or next to the package in a
    clone."""
    package = Path(__file__).resolve().parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def configuration_folders() -> list[Path]:
    """Folders with configuration files: the project's own first, then those of trusted extension
    packages."""
    return [configuration_folder(), *extension_configuration_folders()]


def extension_configuration_folders() -> list[Path]:
    """Folders with the yaml files of trusted extension packages, in the order in which Hydra
    searches them."""
    return [folder / "conf" for folder in trusted_packages().values() if (folder / "conf").is_dir()]


def extension_modules(subfolder: str) -> dict[str, str]:
    """Names and dotted import paths of all modules in one subfolder, such as `figures`, of the
    trusted extension packages."""
    return {
        module.name: f"{package}.{subfolder}.{module.name}"
        for package, folder in trusted_packages().items()
        for module in iter_modules([str(folder / subfolder)])
        if not module.name.startswith("_")
    }


def import_trusted_packages() -> None:
    """Import the trusted extension packages, so that their classes are registered."""
    for name in trusted_packages():
        import_module(name)


def import_trusted_modules(name: str) -> None:
    """Import every module of a given name that lies in a trusted extension package."""
    import_trusted_packages()
    for package, folder in trusted_packages().items():
        for file in sorted(folder.rglob(f"{name}.py")):
            inner_folders = file.relative_to(folder).with_suffix("").parts
            if all(part.isidentifier() for part in inner_folders):
                import_module(".".join((package, *inner_folders)))


def _package_folder(name: str) -> Path | None:
    """Folder of an importable package; None if there is no such package."""
    spec = find_spec(name)
    return Path(spec.origin).parent if spec is not None and spec.origin else None
