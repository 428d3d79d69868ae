"""From a composed configuration to the frozen parts of one run; whatever is wrong is said here, before any work."""

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from inspect import signature
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import hydra
from beartype import BeartypeConf
from beartype.door import is_bearable
from omegaconf import DictConfig, OmegaConf

from ssm_study.bounds.reduction import Reduction
from ssm_study.data.excitation import Excitation
from ssm_study.data.recorded import RecordedSource
from ssm_study.data.simulated import SimulatedData
from ssm_study.loop.regulation import Loop
from ssm_study.models.spec import ModelSpec
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, require
from ssm_study.results.allow_list import refuse_foreign_targets
from ssm_study.results.naming import plain, run_name
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
        tree = OmegaConf.to_container(config, resolve=False)
        missing = [key for key in missing_keys(tree) if not key.startswith("hydra.")]
        require(not missing, missing[0] if missing else "", "???", "is missing", "give it a value on the command line")
        seed = config.seed
        whole = isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32
        require(whole, "seed", seed, "not a whole number from 0 to 2^32 - 1", "use 0")
        folder = run_folder(str(config.results_dir), str(config.study), run_name(config))
        settings = plain(config)
        parts = {name: part(name, settings[name]) for name in PARTS if name != "plant"}
        recorded = not isinstance(parts["data"], SimulatedData)
        return cls(
            plant=None if recorded else part("plant", settings["plant"]),
            **parts,
            seed=seed,
            loop_seed=config.loop_seed,
            progress=bool(config.progress),
            folder=folder,
            store=Path(str(config.results_dir)) / ".store",
            configuration=settings,
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


def missing_keys(tree: Any, prefix: str = "") -> Iterator[str]:
    """The dotted names of the values that nobody gave; as OmegaConf's, which resolves every name and takes 15 ms."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        if value == "???":
            yield f"{prefix}{key}"
        yield from missing_keys(value, f"{prefix}{key}.")


def part(name: str, settings: Mapping[str, Any]) -> Any:
    """One group of the configuration as the object it describes; refuses fields that its constructor does not take."""
    node = copy.deepcopy(dict(settings))
    check_fields(name, node)
    try:
        return built(node)
    except BadRequest:
        raise
    except Exception as error:  # whatever a constructor raises for values that have the right types
        cause = " ".join(str(error).split()).rstrip(".")
        raise BadRequest(name, node.get("_target_"), cause, f"see conf/{name}/ for its fields") from error


def built(node: Any) -> Any:
    """The tree with every `_target_` called on its fields, inner ones first."""
    if isinstance(node, list):
        return [built(item) for item in node]
    if not isinstance(node, dict):
        return node
    fields = {key: built(value) for key, value in node.items() if key != "_target_"}
    return hydra.utils.get_object(node["_target_"])(**fields) if "_target_" in node else fields


def check_fields(path: str, node: Any) -> None:
    """Unknown or mistyped fields, at any depth: the constructor is the schema. Raises `BadRequest`.

    A whole number given where the constructor wants any number is made a float.
    """
    if isinstance(node, list):
        for i, item in enumerate(node):
            check_fields(f"{path}[{i}]", item)
    if not isinstance(node, dict) or "_target_" not in node:
        return
    kind = hydra.utils.get_object(node["_target_"])
    hints, known = fields_of(kind)
    for key, value in node.items():
        field = f"{path}.{key}"
        remedy = f"its fields are {', '.join(known)}"
        require(key in known or key == "_target_", field, value, f"{kind.__name__} has no such field", remedy)
        if isinstance(value, dict | list):
            check_fields(field, value)
        elif key in hints:
            fits = is_bearable(value, hints[key], conf=NUMBERS)
            require(fits, field, value, f"is not {_words(hints[key])}", "correct the value")
            if not is_bearable(value, hints[key]):
                node[key] = float(value)


@cache
def fields_of(kind: type) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The types of a constructor's parameters, and their names."""
    return get_type_hints(kind.__init__), tuple(signature(kind).parameters)  # type: ignore[misc] # of a class


def _words(hint: Any) -> str:
    """A type as a reader would say it."""
    said = {float: "a number", int: "a whole number", bool: "true or false", str: "a text", type(None): "null"}
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return " or ".join(said.get(part, str(part).replace("typing.", "")) for part in parts)
