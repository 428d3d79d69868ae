"""From a composed configuration to the frozen parts of one run; whatever is wrong is said here, before any work."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ssm_study.bounds.reduction import Reduction
from ssm_study.data.excitation import Excitation
from ssm_study.data.recorded import RecordedData
from ssm_study.data.simulated import SimulatedData
from ssm_study.loop.regulation import Loop
from ssm_study.models.spec import ModelSpec
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, require
from ssm_study.results.allow_list import refuse_foreign_targets
from ssm_study.results.naming import run_name
from ssm_study.results.runs import run_folder
from ssm_study.signals import DataSet
from ssm_study.synthesis.design import Synthesis
from ssm_study.training.training import Training

PARTS = ("plant", "excitation", "data", "model", "training", "reduction", "synthesis", "loop")


@dataclass(frozen=True, kw_only=True)
class Specification:
    """Everything one run depends on. `plant` is None when the data are recorded: the loop then runs on the model."""

    plant: Plant | None
    excitation: Excitation
    data: SimulatedData | RecordedData
    model: ModelSpec
    training: Training
    reduction: Reduction
    synthesis: Synthesis
    loop: Loop
    seed: int
    loop_seed: int
    progress: bool
    folder: Path
    store: Path
    configuration: Mapping[str, Any]

    @classmethod
    def from_config(cls, config: DictConfig) -> "Specification":
        """Build and check every part; raises `BadRequest` for the first that cannot be."""
        refuse_foreign_targets(config)
        seed = config.seed
        whole = isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32
        require(whole, "seed", seed, "not a whole number from 0 to 2^32 - 1", "use 0")
        folder = run_folder(str(config.results_dir), str(config.study), run_name(config))
        parts = {name: part(config, name) for name in PARTS if name != "plant"}
        recorded = not isinstance(parts["data"], SimulatedData)
        return cls(
            plant=None if recorded else part(config, "plant"),
            **parts,
            seed=seed,
            loop_seed=config.loop_seed,
            progress=bool(config.progress),
            folder=folder,
            store=Path(str(config.results_dir)) / ".store",
            configuration=plain(config),
        )

    def files(self) -> tuple[Path, ...]:
        """The recordings the data are read from: their content is part of what the results depend on."""
        return () if isinstance(self.data, SimulatedData) else self.data.files()

    def dataset(self) -> DataSet:
        """Simulate or read the records. Raises `BadRequest` naming the file and what is wrong with it."""
        if isinstance(self.data, SimulatedData):
            assert self.plant is not None
            return self.data.build(self.plant, self.excitation, self.seed)
        return self.data.build(self.seed)


def part(config: DictConfig, name: str) -> Any:
    """Instantiate one group of the configuration; a misspelt or missing field becomes one sentence."""
    try:
        return hydra.utils.instantiate(config[name], _convert_="all")
    except InstantiationException as error:
        refusal = _refusal_within(error)
        if refusal is not None:
            raise refusal from error
        cause = error.__cause__ or error
        raise BadRequest(
            name, config[name].get("_target_"), _sentence(cause), f"see conf/{name}/ for its fields"
        ) from error
    except OmegaConfBaseException as error:
        raise BadRequest(
            name, config[name].get("_target_"), _sentence(error), f"give the missing value of {name}"
        ) from error


def plain(config: DictConfig) -> dict[str, Any]:
    """The resolved configuration without Hydra's own part."""
    kept = [str(key) for key in config if key != "hydra"]
    resolved = OmegaConf.to_container(OmegaConf.masked_copy(config, kept), resolve=True)
    assert isinstance(resolved, dict)
    return {str(key): value for key, value in resolved.items()}


def _refusal_within(error: BaseException) -> BadRequest | None:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, BadRequest):
            return cause
        cause = cause.__cause__ or cause.__context__
    return None


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split("\n    full_key")[0].split()).rstrip(".")
