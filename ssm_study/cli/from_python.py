"""The command line called from Python: compose a configuration, run a study, save a design as a
run."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pandas as pd
from omegaconf import DictConfig

from ssm_study.api.scratch import copy_temporary_logs
from ssm_study.cli import run as command
from ssm_study.cli.hydra_errors import explain_hydra_error
from ssm_study.cli.request import quote_sines
from ssm_study.engine.records import FAILED
from ssm_study.extensions import configuration_folder
from ssm_study.refusal import require
from ssm_study.study import line
from ssm_study.table.gather import gather

if TYPE_CHECKING:
    from ssm_study.api.design import Design

OF_THE_PLACE = ("experiment=", "study=", "results_dir=")


def compose_configuration(overrides: Sequence[str]) -> DictConfig:
    """Compose the configuration of a study that the command line would use for given overrides.

    Raises `BadRequest` as the command does.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    folder = configuration_folder()
    callers_hydra = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()  # the caller may be a Hydra program itself
    try:
        with initialize_config_dir(str(folder.absolute()), version_base="1.3"):
            return compose("study", overrides=quote_sines(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise explain_hydra_error(error, list(overrides), folder) from error
    finally:
        GlobalHydra.instance().hydra = callers_hydra


def study(*overrides: str) -> pd.DataFrame:
    """Run a study from Python as `ssm-study run` does, and return its results table.

    One row per run. Raises `BadRequest` for a wrong request; runs that failed are rows with status
    `failed`.
    """
    try:
        command.run(list(overrides))
    except (
        SystemExit
    ) as stop:  # Hydra lets nothing else out of a callback; the refusal is its cause
        raise stop.__cause__ or stop from None
    place = [word for word in overrides if word.startswith(OF_THE_PLACE)]
    return gather(line.study_folder(compose_configuration(place)))


def save_design_as_run(design: "Design", folder: Path) -> Path:
    """Save a controller design as a run folder, with the files that a study's run would have.

    Model and gains are computed again, with everything that a run's record says beside them.
    Raises `BadRequest` where the run's certificate differs from the design's.
    """
    with TemporaryDirectory(prefix="ssm-study-") as results:
        place = (f"results_dir='{results}'", "study=saved", "progress=false")
        words = tuple(copy_temporary_logs(word, folder / "logs") for word in design.overrides)
        outcome = line.STUDY.run_job(compose_configuration((*words, *place)))
        if outcome.status == FAILED:
            raise RuntimeError(f"{outcome.message} (its traceback is in {outcome.folder})")
        gather(outcome.folder.parent)
        saved = _read_gains(outcome.folder)
        same = saved == {name: gain.tolist() for name, gain in design.certificate.gains.items()}
        problem = "the command designs other gains from the same settings"
        require(same, "design", folder, problem, "report this, please")
        return Path(shutil.copytree(outcome.folder, folder, dirs_exist_ok=True))


def _read_gains(folder: Path) -> dict[str, Any]:
    """Read the gain matrices from the certificate in a run folder, as nested lists."""
    from ssm_study.certificates.certificate import Design as Certificates

    gains = Certificates.load(folder / "certificate.json").gains
    return {name: gain.tolist() for name, gain in gains.items()}
