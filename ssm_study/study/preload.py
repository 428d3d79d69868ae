"""Imports that every job of a sweep needs, made once by the server from which the jobs are forked.

The code versions are those of the modules as they are in memory now: a file edited while a sweep
runs changes neither what its jobs compute nor the keys under which they keep it.
"""

import importlib
import pkgutil
import re
from collections.abc import Iterator, Set
from contextlib import suppress

import numpy as np
from hydra.core.plugins import Plugins

import ssm_study
from ssm_study.engine.fingerprint import CODE
from ssm_study.plants.dc_motor import MotorConstants
from ssm_study.plants.dc_motor_kernel import advance_batch
from ssm_study.study.allow_list import ROOMS

# By the stage that takes it: torch and Lightning, then CVXPY. Together 5 s of a processor, and
# three quarters of the memory whose page table every fork copies.
HEAVY = {
    "model": re.compile(r"ssm_study\.(training\.|models\.(baselines|torch_|structured_spec))"),
    "synthesis": re.compile(
        r"ssm_study\.(bounds\.lipsdp|certificates\.semidefinite|loop\.(comparison|peers)"
        r"|synthesis\.(objectives|bilinear_(design|gains)|\w*lmi))"
    ),
}


def modules_to_preload(stages_to_compute: Set[str]) -> Iterator[str]:
    """Names of the Python modules that the jobs of a sweep will import."""
    left = [modules for stage, modules in HEAVY.items() if stage not in stages_to_compute]
    for room in ROOMS:
        package = importlib.import_module(f"{ssm_study.__name__}.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not any(modules.match(module.name) for modules in left):
                yield module.name


def preload_modules(stages_to_compute: Set[str]) -> None:
    """Import the Python modules that all jobs of a sweep use, in the process from which the jobs
    are forked. `stages_to_compute` is as in `Task.preload_modules`."""
    for name in modules_to_preload(stages_to_compute):
        with suppress(
            Exception
        ):  # a broken module matters to the runs that name it, and they will say so
            importlib.import_module(name)
    # The motor's compiled step, from its cache on disk: a third of a second that each job would
    # spend on its own.
    constants = MotorConstants(*[1.0] * len(MotorConstants._fields))
    u = np.zeros((0, 1))
    d = np.zeros((0, 1))
    advance_batch(constants, np.zeros((0, 4)), u, d, 1.0, 1)
    Plugins.instance()  # Hydra looks for them once per process
    CODE.read_loaded_modules()  # last: what is loaded by now is what counts
