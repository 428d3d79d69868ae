"""Files of a run folder that `verify` reads, each only once, and the objects that the run's
configuration describes."""

import json
from contextlib import chdir
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design
from ssm_study.durable import read_limited_bytes
from ssm_study.engine.records import VERSION
from ssm_study.evidence.metrics import Judgement, collect_findings
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment, has_direct_feedthrough
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, require
from ssm_study.renamed import rename_old_settings
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.signals import DataSet, Trajectories, input_limits
from ssm_study.stored_yaml import read_stored_yaml
from ssm_study.study.allow_list import refuse_foreign_targets
from ssm_study.study.read_once import read_data_set
from ssm_study.study.recordings import RecordedCases, read_mismatch_records
from ssm_study.study.specification import Specification
from ssm_study.study.stages.free_run import ModelRun
from ssm_study.study.trials import reproduce_trials

# share of the summed impulse response that is left when a plant counts as at rest
LEFT_AT_REST = 0.02
CONFIGURATION = ".hydra/config.yaml"
OVERRIDES = ".hydra/overrides.yaml"


@dataclass(frozen=True, kw_only=True)
class RunFiles:
    """Files of a finished run, each read when it is first needed.

    A damaged or absent file raises then, whatever its reader raises.
    """

    path: Path
    record: dict[str, Any]

    @cached_property
    def config(self) -> DictConfig:
        """Resolved configuration from which a run was made."""
        there = (self.path / CONFIGURATION).is_file()
        remedy = "give a run folder that the study made"
        require(there, "run", self.path, f"has no {CONFIGURATION}", remedy)
        config = OmegaConf.create(read_stored_yaml(self.path / CONFIGURATION))
        is_mapping = isinstance(config, DictConfig)
        remedy = "run the study again"
        require(is_mapping, CONFIGURATION, "a list", "is no configuration", remedy)
        assert isinstance(config, DictConfig)
        return config

    @cached_property
    def specification(self) -> Specification:
        """Objects of a run (plant, model, training, ...), built from its stored configuration.
        Raises `BadRequest` for classes that are not allowed; old names are understood."""
        config = self.config.copy()
        rename_old_settings(config)
        refuse_foreign_targets(config)
        return Specification.from_config(config)

    @cached_property
    def data(self) -> DataSet:
        """Data set of a run, simulated again or read again from its logs. Relative paths begin
        where the run was made, or in the present folder."""
        try:
            with chdir(self.working_folder):
                return self._data()
        except BadRequest:
            return self._data()

    @cached_property
    def missing_log_reason(self) -> str:
        """Reason why the log of a run cannot be read on this machine; empty if it can. Also empty
        for records that are simulated again, whose errors are raised."""
        try:
            self.data  # noqa: B018  # read once, and kept
        except (BadRequest, OSError) as error:
            plant = self.specification.plant
            if plant is not None and not plant.is_physical:
                raise
            return f"the recorded data cannot be read: {error_text(error)}"
        return ""

    @property
    def working_folder(self) -> Path:
        """Folder from which relative paths in the run's configuration are resolved. It is the
        present folder if the run has been moved."""
        results_dir = str(self.config.results_dir)
        below = Path(results_dir, str(self.config.study), str(self.config.run))
        whole, _, after = str(self.path.absolute()).rpartition(f"/{below}")
        return Path(whole) if whole and not after else Path()

    def _data(self) -> DataSet:
        """Simulate the data set of a run again, or read its logs again, with the closed-loop trials
        of its refinement. Raises `BadRequest` for a real device."""
        spec = self.specification
        real = getattr(self.specification.plant, "is_physical", False)
        problem = "is a device, and a device cannot be simulated again"
        require(not real, "plant", type(spec.plant).__name__, problem, "keep its records")
        source: Any = spec.data
        if spec.plant is None:
            records = read_data_set(source, spec.seed)
        else:
            records = source.build(spec.plant, spec.excitation, spec.seed)
        mismatch_records = (*records.mismatch_records, *reproduce_trials(spec, self.path))
        return replace(records, mismatch_records=mismatch_records)

    @cached_property
    def model_run(self) -> ModelRun:
        """Stored model of a run with its stored free runs, each read when it is first needed."""
        return ModelRun(self.path)

    @property
    def model(self) -> Any:
        """Identified model of a run, read from its file."""
        return self.model_run.model

    @cached_property
    def mismatch_records(self) -> Trajectories:
        """Records of a run that only serve to measure the model error."""
        return read_mismatch_records(self.path)

    @cached_property
    def judgement(self) -> Judgement:
        """Judgement of the evidence for a run's predictions, computed again from data and model."""
        data = self.data
        runs = self.model_run
        mismatch = measure_model_error(
            self.model, data.validation, data.start_up_samples, data.mismatch_records
        )
        return collect_findings(data, self.model, runs.validation, runs.test, mismatch)

    @property
    def record_version(self) -> int:
        """Version of the format of a run's record."""
        return int(self.record.get("record_version", VERSION))

    def may_lack_columns(self, *columns: str) -> bool:
        """Whether a run's record lacks all of the given columns, and was written by a version that
        did not have to state them."""
        return self.record_version < VERSION and not any(name in self.record for name in columns)

    def read_json_object(self, name: str) -> dict[str, Any]:
        """Read the JSON object in a file of the run. Raises `BadRequest` for a file that repeats a
        key."""
        as_object = partial(refuse_repeated_keys, name)
        content = json.loads(read_limited_bytes(self.path / name), object_pairs_hook=as_object)
        is_object = isinstance(content, dict)
        kind = type(content).__name__
        require(is_object, name, kind, "is no object", "run the study again")
        return dict(content)

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """Content of the file `certificate.json` of a run."""
        return self.read_json_object("certificate.json")

    @cached_property
    def design(self) -> Design:
        """Stored controller and observer of a run with their certificates."""
        return Design.from_json(self.certificate)

    @cached_property
    def recorded_training_inputs(self) -> list[Float[np.ndarray, "_ m"]]:
        """Inputs of the training records of a run, as stored in `excitation.mcap`."""
        recording = RecordedCases.from_file(self.path / "excitation.mcap")
        return [signal.values for signal in recording.signals("input")]

    @cached_property
    def training_disturbances(self) -> list[Float[np.ndarray, "_ k"]]:
        """Measured disturbances of a run's training records, as stored in `excitation.mcap`; empty
        if there are none."""
        cases = RecordedCases.from_file(self.path / "excitation.mcap").cases.values()
        return [case["disturbance"].values for case in cases if "disturbance" in case]

    @property
    def training_inputs(self) -> list[Float[np.ndarray, "_ m"]]:
        """Inputs of the training records of a run, with the equilibrium input appended."""
        return self.model.scale.append_equilibrium_input(self.recorded_training_inputs)

    @property
    def next_excitation_settings(self) -> dict[str, float]:
        """Settings for the next excitation signal of the same plant, from a run's input range and
        response time. They are those of `IdentificationExperiment`, with equilibrium
        input and sampling time."""
        problem = "has several inputs"
        remedy = "give --lower and the others for each"
        require(self.model.scale.inputs == 1, "--after", self.path, problem, remedy)
        (lower,), (upper,) = input_limits(None, None, self.training_inputs)
        model = self.model
        impulse_response_length = model.linear.impulse_response_length(
            remaining_fraction=LEFT_AT_REST
        )
        rest = float(model.scale.input_equilibrium[0])
        settle_s = float(impulse_response_length * model.step_s)
        return {
            "lower": float(lower),
            "upper": float(upper),
            "rest": rest,
            "step_s": float(model.step_s),
            "settle_s": settle_s,
        }

    @property
    def sine_frequencies(self) -> tuple[float, ...]:
        """Frequencies (rad/sample) of the single sines that test a run's closed loop. Empty without
        a design."""
        from ssm_study.robustness.sine_trials import frequencies_to_test

        if not self.has_certifiable_model:
            return ()
        if not self.design.feasible:
            return ()
        model = self.model
        validation = self.model_run.validation
        mismatch = measure_model_error(
            model, validation.records, validation.start_up_samples, self.mismatch_records
        )
        balls = certified_balls(model)
        return frequencies_to_test(model, self.design.gain_pair, balls, mismatch)

    @property
    def loop_experiment(self) -> LoopExperiment:
        """Settings of the closed-loop experiment of a run. Without a plant, its input limits are
        the input range of the log."""
        loop = self.specification.loop
        if self.specification.plant:
            return loop
        return loop.with_default_limits(self.training_inputs)

    @property
    def plant(self) -> Plant:
        """Plant that the controller of a run was applied to, or the identified model if the run has
        no plant."""
        return self.specification.plant or IdentifiedPlant.from_model(self.model)

    @property
    def has_certifiable_model(self) -> bool:
        """Whether the model of a run can be certified, so that the run has a controller design."""
        return self.specification.model.gives_ssm

    @property
    def can_close_loop(self) -> bool:
        """Whether a run has a controller, an observer, and a plant or model to close the loop
        on."""
        if not self.has_certifiable_model or not self.design.feasible:
            return False
        return self.specification.plant is not None or not has_direct_feedthrough(self.model)


def refuse_repeated_keys(file: str, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a dictionary from the keys and values of a JSON object, and raise `BadRequest` for a
    repeated key, of which one reader takes the first value and another the last."""
    keys = [key for key, _ in pairs]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    require(twice is None, file, twice, "appears twice in one object", "run the study again")
    return dict(pairs)


def find_unknown_entries(stored: Any, written: Any, parent_path: str = "") -> list[str]:
    """Find entries of a stored JSON object that the program would ignore, by their dotted paths.

    No check covers them.
    """
    paths: list[str] = []
    if isinstance(stored, list) and isinstance(written, list):
        for pair in zip(stored, written, strict=False):
            paths += find_unknown_entries(*pair, parent_path)
    elif isinstance(stored, dict):
        for name, value in stored.items():
            path = f"{parent_path}{name}"
            if isinstance(written, dict) and name in written:
                paths += find_unknown_entries(value, written[name], f"{path}.")
            else:
                paths.append(path)
    return paths


def error_text(error: BaseException) -> str:
    """Text of an error in a single line of limited length."""
    text = " ".join(str(error).split())
    return (text or type(error).__name__)[:300]
