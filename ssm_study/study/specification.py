"""Objects and settings of one run, built from a composed configuration. Every mistake in it is
refused here, before any work."""

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
from ssm_study.engine.settings import Settings, plain_settings, walk_nodes
from ssm_study.refusal import require, require_seed
from ssm_study.study.allow_list import PARTS

if TYPE_CHECKING:  # a request is read without what it takes to fulfil it
    from ssm_study.bounds.reduction import Reduction
    from ssm_study.data.excitations.excitation import Excitation
    from ssm_study.data.recorded import RecordedSource
    from ssm_study.loop.regulation import LoopExperiment
    from ssm_study.models.spec import ModelSpec
    from ssm_study.plants.plant import Plant
    from ssm_study.synthesis.design import Synthesis
    from ssm_study.training.training import Training


NONE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True)
class Specification:
    """Objects and settings that determine one run, such as plant, model and training.

    `plant` is None when the data are recorded: the loop then runs on the model.
    """

    plant: "Plant | None"
    excitation: "Excitation"
    data: "SimulatedData | RecordedSource"
    model: "ModelSpec"
    training: "Training"
    reduction: "Reduction"
    synthesis: "Synthesis"
    loop: "LoopExperiment"
    seed: int
    loop_seed: int
    refine: int | list[str] | None
    progress: bool
    configuration: Mapping[str, Any]

    @classmethod
    def from_config(cls, config: DictConfig | Settings) -> "Specification":
        """Build and check the objects of a run from its configuration. Raises `BadRequest` for the
        first part that is wrong."""
        settings = plain_settings(config)
        # OmegaConf's own search resolves every name, which takes 15 ms a run.
        missing = next((path for path, _, value in walk_nodes(settings) if value == "???"), "")
        require(not missing, missing, "???", "is missing", "give it a value on the command line")
        for name in ("seed", "loop_seed"):
            require_seed(name, settings[name])
        parts = {name: construct_part(name, settings[name]) for name in PARTS if name != "plant"}
        is_recorded = not isinstance(parts["data"], SimulatedData)
        plant = None if is_recorded else construct_part("plant", settings["plant"])
        specification = cls(
            plant=plant,
            **parts,
            seed=settings.seed,
            loop_seed=settings.loop_seed,
            refine=_read_refine_setting(settings.get("refine"), is_recorded),
            progress=bool(settings.progress),
            configuration=settings,
        )
        specification.refuse_excessive_sizes()
        if plant is not None:
            specification.require_valid_input_limits(plant.equilibrium().u)
        specification.refuse_feedthrough()
        specification.refuse_fast_modes()
        return specification

    def refuse_feedthrough(self) -> None:
        """Raise `BadRequest` for a model with direct feedthrough from input to output, with which
        no loop on a plant can be closed.

        This is said before the model is trained. Without a plant it is scored and certified, and no
        loop is closed.
        """
        can_close_loop = self.model.gives_ssm and self.plant is not None
        problem = "the loop samples the output before the input acts"
        remedy = "identify with model.feedthrough=false"
        feedthrough = self.configuration["model"].get("feedthrough")
        is_refused = can_close_loop and feedthrough
        require(not is_refused, "model.feedthrough", feedthrough, problem, remedy)

    def refuse_fast_modes(self) -> None:
        """Raise `BadRequest` for an internal model of reference or disturbance with frequencies
        beyond half the sampling rate.

        Only where the sampling rate is known beforehand.
        """
        words = getattr(self.synthesis, "internal_model_signals", ())
        step_s = getattr(self.plant or self.data, "step_s", None)
        if words and step_s:
            from ssm_study.certificates.theorems.integral_action import internal_model

            internal_model(words, step_s, outputs=1)

    def refuse_excessive_sizes(self) -> None:
        """Raise `BadRequest` for a reduction to more states than the model has, or for more data
        than the memory can hold."""
        order = self.configuration["model"].get("order")
        states = self.reduction.truncate_to
        fits = states is None or not isinstance(order, int) or states <= order
        problem = f"the model has {order} states"
        remedy = "give fewer, or null for all"
        require(fits, "reduction.truncate_to", states, problem, remedy)
        if self.plant is None:
            return
        assert isinstance(self.data, SimulatedData)
        loop = self.loop
        has_one_case = loop.initial_conditions == 1 and not self.data.trials
        problem = "a device runs one case, from where it is"
        remedy = "use loop.initial_conditions=1 +data.trials=false"
        fits = not self.plant.is_physical or has_one_case
        require(fits, "plant", type(self.plant).__name__, problem, remedy)
        counts = {
            "data.trajectories * samples": self.data.trajectories * self.data.samples,
            "loop.initial_conditions * horizon_s / step_s": (
                loop.initial_conditions * loop.horizon_samples(self.plant.step_s)
            ),
        }
        problem = f"more than {LARGEST_NUMBER} samples"
        for field, count in counts.items():
            require(count <= LARGEST_NUMBER, field, count, problem, "use fewer")

    def require_valid_input_limits(self, equilibrium_input: Float[np.ndarray, "m"]) -> None:
        """Raise `BadRequest` for input limits whose number or range does not fit the plant or the
        log.

        They have to number as many as the inputs, and to enclose the equilibrium
        `equilibrium_input`; the loop of a log whose reference begins elsewhere need not hold its
        equilibrium.
        """
        lower, upper = (np.asarray(end) for end in self.loop.limits)
        names = "loop.input_lower, loop.input_upper"
        values = (lower.tolist(), upper.tolist())
        shapes = ((), equilibrium_input.shape)
        fits = lower.shape in shapes and upper.shape in shapes
        owner = "plant" if self.plant else "log"
        count = len(equilibrium_input)
        problem = f"the {owner} has {count} input{'' if count == 1 else 's'}"
        require(fits, names, values, problem, "give one number, or one for each")
        is_inside = bool(np.all((lower <= equilibrium_input) & (equilibrium_input <= upper)))
        first_reference = self.loop.reference.signal(np.zeros(1)) if self.plant is None else None
        begins_elsewhere = first_reference is not None and bool(first_reference.any())
        inputs = ", ".join(f"{u:g}" for u in equilibrium_input)
        problem = f"the {owner} rests at the input {inputs}"
        fits = is_inside or begins_elsewhere
        require(fits, names, values, problem, "choose limits around it")

    def stage_settings(
        self, *names: str, computed: Mapping[str, Any] = NONE, unkeyed: Mapping[str, Any] = NONE
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Settings that identify the stored result of a computing step, and the arguments that the
        step is called with.

        The settings, of which its key is made, are those of the named parts and the `computed`
        values; the arguments the parts themselves, the same values, and those that are `unkeyed`.
        """
        settings = Settings({name: self.configuration[name] for name in names})
        files = input_files(settings)
        checksums = {"files": [sha256_of_file(path) for path in files]} if files else {}
        parts = {name: getattr(self, name) for name in names}
        arguments = {**parts, **computed, **unkeyed}
        return Settings({**settings, **checksums, **computed}), arguments

    def dataset_stage_settings(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Settings and call arguments of the computing step that simulates or reads the records."""
        plant = ("plant", "excitation") if self.plant else ()
        return self._stage_settings_with_data("seed", *plant)

    def sine_stage_settings(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Settings and call arguments of the computing step that tests a controller with single
        sines on a simulated plant."""
        return self._stage_settings_with_data("seed", "plant")

    def _stage_settings_with_data(self, *names: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Settings and call arguments of a computing step that also reads the data source. The
        number of fresh data sets is left out."""
        settings, arguments = self.stage_settings("data", *names)
        if isinstance(self.data, SimulatedData):
            own = {name: value for name, value in settings["data"].items() if name != "fresh_sets"}
            settings = Settings({**settings, "data": own})
            arguments["data"] = replace(self.data, fresh_sets=0)
        return settings, arguments

    @property
    def has_sine_trials(self) -> bool:
        """Whether the controller is tested with single-sine inputs; only a simulated plant allows
        this test."""
        simulated = isinstance(self.data, SimulatedData) and self.data.trials
        return simulated and self.plant is not None and not self.plant.is_physical

    @property
    def simulates_fresh_data(self) -> bool:
        """Whether further data sets of the plant are simulated, to test the model on independent
        data."""
        simulated = isinstance(self.data, SimulatedData) and self.data.fresh_sets > 0
        return simulated and self.plant is not None and not self.plant.is_physical


def input_files(settings: Mapping[str, Any]) -> list[Path]:
    """Files that the settings of a run name and on whose content the results depend.

    Raises `BadRequest` for data that cannot be described.
    """
    data = settings.get("data", {})
    is_recorded = data and not str(data.get("_target_", "")).endswith(".SimulatedData")
    files = set(construct_part("data", data).data_files() if is_recorded else ())
    for _, key, value in walk_nodes(settings):
        is_list = isinstance(value, list)
        if key != "path" and not (key == "refine" and is_list):
            continue
        names = value if is_list else [value]
        paths = [Path(name) for name in names if name is not None]
        files |= {path for path in paths if path.is_file()}
    return sorted(files)


def _read_refine_setting(requested: Any, is_recorded: bool) -> int | list[str] | None:
    """Check the setting `refine`, and return it: a list of trial logs, or a number of
    iterations."""
    if is_recorded and requested is not None:
        logs = [requested] if isinstance(requested, str) else requested
        is_list = isinstance(logs, list) and bool(logs)
        names_logs = is_list and all(isinstance(log, str) for log in logs)
        problem = "the data are a log, so there is no plant to try the controller on"
        require(
            names_logs,
            "refine",
            requested,
            problem,
            "name the file of a trial, as in refine=trial.csv",
        )
        missing = next((log for log in logs if not Path(log).is_file()), None)
        require(missing is None, "refine", missing, "no such file", "check the spelling")
        return list(logs)
    is_whole = isinstance(requested, int) and not isinstance(requested, bool)
    is_count = requested is None or (is_whole and requested > 0)
    require(is_count, "refine", requested, "is no number of iterations", "use 1, or null for none")
    return requested
