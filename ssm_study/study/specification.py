"""From a composed configuration to the frozen parts of one run; whatever is wrong is said here,
before any work."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig

from ssm_study.construction import LARGEST_NUMBER, construct_part
from ssm_study.data.simulated import SimulatedData
from ssm_study.durable import sha256_of_file
from ssm_study.engine.settings import Settings, nodes, plain
from ssm_study.refusal import require
from ssm_study.study.allow_list import PARTS

if TYPE_CHECKING:  # a request is read without what it takes to fulfil it
    from ssm_study.bounds.reduction import Reduction
    from ssm_study.data.excitations.excitation import Excitation
    from ssm_study.data.recorded import RecordedSource
    from ssm_study.loop.regulation import Loop
    from ssm_study.models.spec import ModelSpec
    from ssm_study.plants.plant import Plant
    from ssm_study.synthesis.design import Synthesis
    from ssm_study.training.training import Training


NONE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True)
class Specification:
    """Everything one run depends on. `plant` is None when the data are recorded: the loop then runs
    on the model."""

    plant: "Plant | None"
    excitation: "Excitation"
    data: "SimulatedData | RecordedSource"
    model: "ModelSpec"
    training: "Training"
    reduction: "Reduction"
    synthesis: "Synthesis"
    loop: "Loop"
    seed: int
    loop_seed: int
    refine: int | list[str] | None
    progress: bool
    configuration: Mapping[str, Any]

    @classmethod
    def from_config(cls, config: DictConfig | Settings) -> "Specification":
        """Build and check every part; raises `BadRequest` for the first that cannot be."""
        settings = plain(config)
        # OmegaConf's own search resolves every name, which takes 15 ms a run.
        missing = next((path for path, _, value in nodes(settings) if value == "???"), "")
        require(not missing, missing, "???", "is missing", "give it a value on the command line")
        for name in ("seed", "loop_seed"):
            whole = type(settings[name]) is int and 0 <= settings[name] < 2**32
            require(whole, name, settings[name], "not a whole number from 0 to 2^32 - 1", "use 0")
        parts = {name: construct_part(name, settings[name]) for name in PARTS if name != "plant"}
        recorded = not isinstance(parts["data"], SimulatedData)
        found = cls(
            plant=None if recorded else construct_part("plant", settings["plant"]),
            **parts,
            seed=settings.seed,
            loop_seed=settings.loop_seed,
            refine=_refine(settings.get("refine"), recorded),
            progress=bool(settings.progress),
            configuration=settings,
        )
        found.refuse_sizes()
        if found.plant is not None:
            found.refuse_limits(found.plant.equilibrium().u)
        found.refuse_feedthrough()
        found.refuse_fast_modes()
        return found

    def refuse_feedthrough(self) -> None:
        """Raise `BadRequest` for a model that no loop on the plant can be closed with, before it is
        trained.

        Without a plant it is scored and certified, and no loop is closed.
        """
        loops = self.model.gives_ssm and self.plant is not None
        problem = "the loop samples the output before the input acts"
        remedy = "identify with model.feedthrough=false"
        asked = self.configuration["model"].get("feedthrough")
        require(not (loops and asked), "model.feedthrough", asked, problem, remedy)

    def refuse_fast_modes(self) -> None:
        """Raise `BadRequest` for an internal model beyond half the sampling rate, where that is
        known beforehand."""
        words = getattr(self.synthesis, "modes", ())
        step_s = getattr(self.plant or self.data, "step_s", None)
        if words and step_s:
            from ssm_study.certificates.theorems.integral_action import internal_model

            internal_model(words, step_s, outputs=1)

    def refuse_sizes(self) -> None:
        """Raise `BadRequest` for what no memory holds, and for more states than there are, before
        any is allocated."""
        order = self.configuration["model"].get("order")
        kept = self.reduction.truncate_to
        fits = kept is None or not isinstance(order, int) or kept <= order
        require(
            fits,
            "reduction.truncate_to",
            kept,
            f"the model has {order} states",
            "give fewer, or null for all",
        )
        if self.plant is None:
            return
        assert isinstance(self.data, SimulatedData)
        one = not self.plant.real or (self.loop.initial_conditions == 1 and not self.data.trials)
        problem = "a device runs one case, from where it is"
        remedy = "use loop.initial_conditions=1 +data.trials=false"
        require(one, "plant", type(self.plant).__name__, problem, remedy)
        samples = self.loop.initial_conditions * self.loop.samples(self.plant.step_s)
        counts = {"data.trajectories * samples": self.data.trajectories * self.data.samples}
        for field, count in (
            counts | {"loop.initial_conditions * horizon_s / step_s": samples}
        ).items():
            require(
                count <= LARGEST_NUMBER,
                field,
                count,
                f"more than {LARGEST_NUMBER} samples",
                "use fewer",
            )

    def refuse_limits(self, rest: Float[np.ndarray, "m"]) -> None:
        """Raise `BadRequest` for limits that do not fit the inputs, or that this rest of plant or
        log lies beyond.

        The loop of a log whose reference begins elsewhere need not hold its rest.
        """
        ends = [np.asarray(end) for end in self.loop.limits]
        names = "loop.input_lower, loop.input_upper"
        shown = tuple(end.tolist() for end in ends)
        fits = all(end.shape in ((), rest.shape) for end in ends)
        whose = "plant" if self.plant else "log"
        require(
            fits,
            names,
            shown,
            f"the {whose}'s inputs number {len(rest)}",
            "give one number, or one for each",
        )
        inside = bool(np.all((ends[0] <= rest) & (rest <= ends[1])))
        elsewhere = self.plant is None and bool(self.loop.reference.signal(np.zeros(1)).any())
        problem = f"the {whose} rests at the input {', '.join(f'{u:g}' for u in rest)}"
        require(inside or elsewhere, names, shown, problem, "choose limits around it")

    def select(
        self, *names: str, computed: Mapping[str, Any] = NONE, unkeyed: Mapping[str, Any] = NONE
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Settings and arguments of a stage, made together so that key and argument cannot differ.

        The settings, of which its key is made, are those of the named parts and the `computed`
        values; the arguments the parts themselves, the same values, and those that are `unkeyed`.
        """
        settings = Settings({name: self.configuration[name] for name in names})
        sums = (
            {"files": [sha256_of_file(path) for path in found]}
            if (found := files_of(settings))
            else {}
        )
        arguments = {name: getattr(self, name) for name in names}
        return Settings({**settings, **sums, **computed}), {**arguments, **computed, **unkeyed}

    def dataset_inputs(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Settings and arguments of the run's records: without `data.fresh_sets`, which changes
        none of them."""
        plant = ("plant", "excitation") if self.plant else ()
        settings, arguments = self.select("data", "seed", *plant)
        if isinstance(self.data, SimulatedData):
            own = {name: value for name, value in settings["data"].items() if name != "fresh_sets"}
            settings = Settings({**settings, "data": own})
            arguments["data"] = replace(self.data, fresh_sets=0)
        return settings, arguments

    @property
    def has_fresh_sets(self) -> bool:
        """Whether fresh data sets of the plant are simulated."""
        simulated = isinstance(self.data, SimulatedData) and self.data.fresh_sets > 0
        return simulated and self.plant is not None and not self.plant.real


def files_of(settings: Mapping[str, Any]) -> list[Path]:
    """The files that the settings name: their content is part of what results depend on.

    Raises `BadRequest` for data that cannot be described.
    """
    data = settings.get("data", {})
    recorded = data and not str(data.get("_target_", "")).endswith(".SimulatedData")
    read = construct_part("data", data).files() if recorded else ()
    given = [
        value
        for _, key, value in nodes(settings)
        if key == "path" or (key == "refine" and isinstance(value, list))
    ]
    paths = [
        Path(one)
        for value in given
        for one in (value if isinstance(value, list) else [value])
        if one is not None
    ]
    return sorted({*read, *(path for path in paths if path.is_file())})


def _refine(asked: Any, recorded: bool) -> int | list[str] | None:
    """How often the choice is made again by the closed loop on the plant, or logs of trials, where
    there is none."""
    if recorded and asked is not None:
        logs = [asked] if isinstance(asked, str) else asked
        named = isinstance(logs, list) and bool(logs) and all(isinstance(log, str) for log in logs)
        require(
            named,
            "refine",
            asked,
            "there is no plant to try the controller on",
            "name the log of a trial",
        )
        missing = next((log for log in logs if not Path(log).is_file()), None)
        require(missing is None, "refine", missing, "no such file", "check the spelling")
        return list(logs)
    count = asked is None or (isinstance(asked, int) and not isinstance(asked, bool) and asked > 0)
    require(count, "refine", asked, "is no number of iterations", "use 1, or null for none")
    return asked
