"""From a composed configuration to the frozen parts of one run; whatever is wrong is said here, before any work."""

from collections.abc import Mapping
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import hydra
from beartype import BeartypeConf
from beartype.door import is_bearable
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf

from ssm_study.bounds.reduction import Reduction
from ssm_study.data.excitation import Excitation
from ssm_study.data.recorded import RecordedSource
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

NUMBERS = BeartypeConf(is_pep484_tower=True)  # a whole number is a number
PARTS = ("plant", "excitation", "data", "model", "training", "reduction", "synthesis", "loop")


@dataclass(frozen=True, kw_only=True)
class Specification:
    """Everything one run depends on. `plant` is None when the data are recorded: the loop then runs on the model."""

    plant: Plant | None
    excitation: Excitation
    data: SimulatedData | RecordedSource
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
        missing = sorted(key for key in OmegaConf.missing_keys(config) if not key.startswith("hydra."))
        require(not missing, missing[0] if missing else "", "???", "is missing", "give it a value on the command line")
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
    """Instantiate one group of the configuration after checking its fields against the constructor's own types."""
    node = OmegaConf.create(dict(plain(config)[name]))
    check_fields(name, node)
    try:
        return hydra.utils.instantiate(node, _convert_="all")
    except InstantiationException as error:
        refusal = _refusal_within(error)
        if refusal is not None:
            raise refusal from error
        cause = " ".join(str(error.__cause__ or error).split()).rstrip(".")
        raise BadRequest(name, node.get("_target_"), cause, f"see conf/{name}/ for its fields") from error


def check_fields(path: str, node: Any) -> None:
    """Unknown or mistyped fields, at any depth: the constructor is the schema. Raises `BadRequest`.

    A whole number given where the constructor wants any number is made a float.
    """
    if isinstance(node, ListConfig):
        for i, item in enumerate(node):
            check_fields(f"{path}[{i}]", item)
    if not isinstance(node, DictConfig) or "_target_" not in node:
        return
    kind = hydra.utils.get_object(node["_target_"])
    hints = get_type_hints(getattr(kind, "__init__", kind) if isinstance(kind, type) else kind)
    known = list(signature(kind).parameters)
    for key in (str(key) for key in node if not str(key).startswith("_")):
        field = f"{path}.{key}"
        value: Any = OmegaConf.to_container(node[key], resolve=True) if OmegaConf.is_config(node[key]) else node[key]
        remedy = f"its fields are {', '.join(known)}"
        require(key in known, field, value, f"{kind.__name__} has no such field", remedy)
        if OmegaConf.is_config(node[key]):
            check_fields(field, node[key])
        elif key in hints:
            fits = is_bearable(value, hints[key], conf=NUMBERS)
            require(fits, field, value, f"is not {_words(hints[key])}", "correct the value")
            if not is_bearable(value, hints[key]):
                node[key] = float(value)


def _words(hint: Any) -> str:
    """A type as a reader would say it."""
    said = {float: "a number", int: "a whole number", bool: "true or false", str: "a text", type(None): "null"}
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return " or ".join(said.get(part, str(part).replace("typing.", "")) for part in parts)


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
