"""What every job of a sweep would find out for itself: imported once by the server its processes are forked from.

The code versions are those of the modules as they are in memory now: a file edited while a sweep runs changes neither
what its jobs compute nor the keys under which they keep it.
"""

import importlib
import pkgutil
from contextlib import suppress
from pathlib import Path

import numpy as np
from hydra.core.plugins import Plugins

import ssm_study
from ssm_study.plants.dc_motor import MotorConstants
from ssm_study.plants.dc_motor_kernel import advance_batch
from ssm_study.results.allow_list import ROOMS
from ssm_study.results.keys import code_version
from ssm_study.results.provenance import LIBRARIES, provenance

PACKAGE = Path(ssm_study.__file__).parent


def rooms() -> list[str]:
    """Every room, and every module of `results`, by the names that stages depend on."""
    inner = [path for path in (*PACKAGE.iterdir(), *(PACKAGE / "results").iterdir()) if not path.name.startswith("_")]
    known = [path for path in inner if path.suffix == ".py" or (path / "__init__.py").is_file()]
    return [".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in known]


def load_specifications() -> None:
    """Import every module of the rooms that configurations name; those that cannot be are left out."""
    for room in ROOMS:
        package = importlib.import_module(f"{ssm_study.__name__}.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(Exception):  # a broken module matters to the runs that name it, and they will say so
                importlib.import_module(module.name)


def load_kernels() -> None:
    """The motor's compiled step, from its cache on disk: a third of a second that each job would spend on its own."""
    constants = MotorConstants(*[1.0] * len(MotorConstants._fields))
    advance_batch(constants, np.zeros((0, 4)), np.zeros((0, 1)), np.zeros((0, 1)), 1.0, 1)


load_specifications()
load_kernels()
Plugins.instance()
for _name in (*rooms(), *LIBRARIES):
    code_version(_name)
provenance()
