"""What every job of a sweep would find out for itself: imported once by the server its processes are forked from.

The code versions are those of the modules as they are in memory now: a file edited while a sweep runs changes neither
what its jobs compute nor the keys under which they keep it.
"""

import importlib
import pkgutil
from contextlib import suppress
from pathlib import Path

from hydra.core.plugins import Plugins

import ssm_study
from ssm_study.results.allow_list import ROOMS
from ssm_study.results.keys import code_version
from ssm_study.results.provenance import LIBRARIES, provenance

PACKAGE = Path(ssm_study.__file__).parent


def rooms() -> list[str]:
    """Every room, and every module of this one, by the names that stages depend on."""
    inner = [path for path in (*PACKAGE.iterdir(), *(PACKAGE / "results").iterdir()) if not path.name.startswith("_")]
    known = [path for path in inner if path.suffix == ".py" or (path / "__init__.py").is_file()]
    return [".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in known]


def load_specifications() -> None:
    """Import every module of the rooms that configurations name; those whose extra is missing are left out."""
    for room in ROOMS:
        package = importlib.import_module(f"{ssm_study.__name__}.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError):
                importlib.import_module(module.name)


load_specifications()
Plugins.instance()
for _name in (*rooms(), *LIBRARIES):
    code_version(_name)
provenance()
