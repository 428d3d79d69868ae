"""Identification of a model from data: from the settings of `conf/training/*.yaml` to stored
numbers."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssm_study.refusal import require, require_at_least, require_one_of
from ssm_study.signals import DataSet
from ssm_study.training.loggers import NoLogger
from ssm_study.training.optimisers import OptimiserSpec
from ssm_study.training.windows import Windows

if TYPE_CHECKING:
    from ssm_study.models.spec import ModelSpec
    from ssm_study.models.structured_spec import StructuredSpec
    from ssm_study.training.metrics import Identification
    from ssm_study.training.search import SettingsChoice
    from ssm_study.training.structured_problem import Theta


@dataclass(frozen=True, kw_only=True)
class Training:
    """Settings of a training, with the method that identifies a model by them. It minimises the
    simulation error until validation gains less than `min_gain_percent` in `patience` epochs.

    The settings: conf/training/default.yaml. `validation_tolerance_percent`: see
    `BestModelCheckpoint`; the weights: see `roughness_penalty`; `integrated_share`: see
    `TrainingBatch`; `windows`: see `Windows`. Precision 32 is polished in float64.
    """

    optimiser: OptimiserSpec
    max_epochs: int
    patience: int
    min_gain_percent: float
    validation_tolerance_percent: float
    precision: int = 64
    initial_state: str = "auto"
    roughness_weight: float = 0.0
    integrated_share: float = 0.0
    windows: Windows = field(default_factory=Windows)
    starts: int = 1
    logger: NoLogger = field(default_factory=NoLogger)
    checkpoint_every_s: float = 10.0
    accelerator: str = "cpu"

    def __post_init__(self) -> None:
        share = self.integrated_share
        is_share = 0 <= share <= 1
        require(
            is_share,
            "training.integrated_share",
            share,
            "must be a share of the loss, from 0 to 1",
            "use 0 to 1",
        )
        for name in ("max_epochs", "patience", "starts"):
            number = getattr(self, name)
            require_at_least(1, f"training.{name}", number, "use a positive whole number")
        for name in (
            "min_gain_percent",
            "validation_tolerance_percent",
            "checkpoint_every_s",
            "roughness_weight",
        ):
            require_at_least(0, f"training.{name}", getattr(self, name), "use 0")
        precisions = (32, 64)
        require_one_of(precisions, "training.precision", self.precision)
        initial_states = ("auto", "zero", "estimated")
        require_one_of(initial_states, "training.initial_state", self.initial_state)

    def identify(
        self,
        spec: "ModelSpec",
        data: DataSet,
        seed: int,
        folder: Path,
        progress: bool = False,
        keep_on_interrupt: bool = False,
    ) -> "Identification":
        """Identify a model with given settings from a data set. `folder` receives `best.ckpt` and,
        while running, `last.ckpt`.

        With `keep_on_interrupt` Ctrl-C ends the training, and the best model so far is returned if
        there is one.
        """
        from ssm_study.models.baselines.solved import SolvedSpec
        from ssm_study.models.structured_spec import StructuredSpec
        from ssm_study.training.metrics import Identification

        refuse_unsupported_disturbances(spec, data)
        began = time.perf_counter()
        if isinstance(spec, SolvedSpec):
            model = spec.fit_model(data)
            seconds = time.perf_counter() - began
            return Identification.from_model(
                model, data, seconds=seconds, curve=[], ended="solved without training"
            )
        session = TrainingSession(
            seed=seed, folder=folder, progress=progress, keep_on_interrupt=keep_on_interrupt
        )
        if isinstance(spec, StructuredSpec) and spec.automatic_settings:
            return self._choose_settings_and_identify(spec, data, session)
        members = getattr(spec, "members", 1)
        if isinstance(spec, StructuredSpec) and spec.neurons == 0:
            spec = spec.settings_without_neurons()
        requested = getattr(spec, "training_run_count", self.starts)
        trainings = max(requested, members)
        starts = [spec.settings_of_training_run(k) for k in range(trainings)]
        return self._train_and_select_best(starts, data, session, members)

    def _choose_settings_and_identify(
        self, spec: "StructuredSpec", data: DataSet, session: "TrainingSession"
    ) -> "Identification":
        """Choose undecided model settings from the records, and identify a model with them."""
        from ssm_study.training.choice import iterate_model_choices, make_progress_printer
        from ssm_study.training.folds import join_training_and_validation

        began = time.perf_counter()
        printer = make_progress_printer(session.progress)
        choices = iterate_model_choices(spec, data, session.seed, printer)
        best: Identification | None = None
        for k, choice in enumerate(choices):
            folder = session.folder / f"choice_{k}" if k else session.folder
            own_session = replace(session, folder=folder)
            identified = self._identify_with_chosen_settings(choice, data, own_session)
            chosen = choice.describe(spec.automatic_settings)
            described = replace(identified, choice=choice.rows, chosen=chosen)
            if can_be_certified(choice.spec, identified.model):
                best = described
                break
            if not choice.only_if_certified:
                best = best or described
        assert best is not None
        if choice.predictor is not None:
            records = join_training_and_validation(data) if spec.refit else data
            predictor = choice.predictor.fit_model(records)
            best = replace(best, members=(predictor,))
        now_s = time.perf_counter()
        return replace(best, seconds=now_s - began)

    def _identify_with_chosen_settings(
        self, choice: "SettingsChoice", data: DataSet, session: "TrainingSession"
    ) -> "Identification":
        """Identify a model with chosen settings; if the records chose them, also train it on the
        validation records."""
        from ssm_study.training.choice import REFIT_WORDS
        from ssm_study.training.folds import join_training_and_validation
        from ssm_study.training.metrics import records_fit_percent

        if not (choice.from_records and choice.spec.refit):
            return self._train_chosen_model(choice, data, session)
        all_records = join_training_and_validation(data)
        best = self._train_chosen_model(choice, all_records, session)
        ended = best.ended + REFIT_WORDS
        fit = records_fit_percent(best.model, data.validation, data)
        return replace(best, ended=ended, refitted=True, fit_validation_percent=fit)

    def _train_chosen_model(
        self, choice: "SettingsChoice", data: DataSet, session: "TrainingSession"
    ) -> "Identification":
        """Train the linear or structured model that chosen settings describe."""
        if choice.linear_kind is None:
            best = self._train_from_best_short_runs(choice.spec, data, session)
            return self._replace_by_other_structures(best, choice, data, session)
        from ssm_study.training.candidates import ENDED_LINEAR, fit_linear_model
        from ssm_study.training.metrics import Identification

        began = time.perf_counter()
        dead_time = int(choice.spec.dead_time)
        records = data.shift_out_dead_time(dead_time) if dead_time else data
        direct = choice.spec.feedthrough is True
        order = int(choice.spec.order)
        model: Any = fit_linear_model(
            records, order, has_feedthrough=direct, kind=choice.linear_kind
        )
        if dead_time:
            model = model.with_dead_time(dead_time)
        seconds = time.perf_counter() - began
        ended = ENDED_LINEAR[choice.linear_kind]
        return Identification.from_model(model, data, seconds=seconds, curve=[], ended=ended)

    def _replace_by_other_structures(
        self,
        best: "Identification",
        choice: "SettingsChoice",
        data: DataSet,
        session: "TrainingSession",
    ) -> "Identification":
        """Replace some of the models whose outputs are averaged by models of other structure.

        Folds cannot tell these from the chosen one; where structures err differently, their mean
        errs less than that of one structure's trainings.
        """
        other_count = len(choice.others)
        member_count = len(best.members)
        count = min(other_count, member_count - 1)
        if count < 1:
            return best
        first_members = best.members[: len(best.members) - count]
        members = [*first_members]
        seconds = best.seconds
        other_specs = choice.others[:count]
        for k, spec in enumerate(other_specs, start=1):
            own_folder = session.folder / f"structure_{k}"
            apart = replace(session, folder=own_folder)
            single_spec = replace(spec, members=1)
            other = self._train_from_best_short_runs(single_spec, data, apart)
            members.append(other.model)
            seconds += other.seconds
        all_members = tuple(members)
        return replace(best, members=all_members, seconds=seconds)

    def _train_from_best_short_runs(
        self, spec: "StructuredSpec", data: DataSet, session: "TrainingSession"
    ) -> "Identification":
        """Train a model to the end from the best of many short training runs."""
        from ssm_study.training.choice import make_progress_printer
        from ssm_study.training.short_starts import (
            best_starts,
            count_short_and_full_runs,
            settings_for_short_training,
        )

        brief = settings_for_short_training(spec)
        announce = make_progress_printer(session.progress, "short starts")
        start_counts = count_short_and_full_runs(spec)
        parameters_by_seed = best_starts(brief, data, session.seed, *start_counts, announce)
        starts = [brief] * len(parameters_by_seed)
        prepared_session = replace(session, initial_parameters=parameters_by_seed)
        return self._train_and_select_best(
            starts,
            data,
            prepared_session,
            spec.members,
            only_certified=True,
            seeds=[*parameters_by_seed],
        )

    def _train_and_select_best(
        self,
        starts: Sequence["ModelSpec"],
        data: DataSet,
        session: "TrainingSession",
        members: int,
        only_certified: bool = False,
        seeds: Sequence[int] | None = None,
    ) -> "Identification":
        """Train a model several times from different initial parameters, and return the best
        result.

        With `only_certified` those without a certified state feedback and observer are dropped, if
        any has both.
        The `members` that fit the training records best predict together.
        """
        stored_dead_time = getattr(starts[0], "dead_time", 0)
        dead_time = int(stored_dead_time)
        records = data.shift_out_dead_time(dead_time) if dead_time else data
        seeds = seeds or [session.seed + 1000 * k for k in range(len(starts))]
        identified = self._train_several_times(starts, seeds, records, session)
        averaged = select_by_training_fit(identified, records, members)
        rule = getattr(starts[0], "among_starts", None)
        if only_certified:
            certified = [
                result for result in identified if can_be_certified(starts[0], result.model)
            ]
            identified = certified or identified
        if rule is None:
            best = max(identified, key=lambda start: start.fit_validation_percent)
        else:
            best = rule(identified)
        seconds = sum(start.seconds for start in identified)
        if dead_time:
            averaged = [model.with_dead_time(dead_time) for model in averaged]
            delayed_model = best.model.with_dead_time(dead_time)  # type: ignore[attr-defined]
            best = replace(best, model=delayed_model)
        averaged_models = tuple(averaged)
        return replace(best, members=averaged_models, seconds=seconds)

    def _train_several_times(
        self,
        starts: Sequence["ModelSpec"],
        seeds: Sequence[int],
        data: DataSet,
        session: "TrainingSession",
    ) -> list["Identification"]:
        """Train a model several times, each time from other initial parameters, and return all
        results. After Ctrl-C the finished ones remain."""
        from ssm_study.training import saving  # loads torch's compiler, as any optimiser does

        identified: list[Identification] = []
        for k, (spec, seed) in enumerate(zip(starts, seeds, strict=True)):
            folder = session.folder / f"start_{k}" if k else session.folder
            own_session = replace(session, seed=seed, folder=folder)
            try:
                start = saving.train_with_lightning(self, spec, data, own_session)
            except KeyboardInterrupt:
                if not session.keep_on_interrupt or not identified:
                    raise
                break
            identified.append(start)
            if start.ended.startswith(saving.INTERRUPTED):
                break
        return identified


def select_by_training_fit(
    identified: Sequence["Identification"], data: DataSet, count: int
) -> list[Any]:
    """Select the models with the best fits to the training records, whose outputs are to be
    averaged.

    A mean of models that were not ranked can be worse than one of them.
    """
    from ssm_study.training.metrics import records_fit_percent

    if count < 2:
        return []
    models = [start.model for start in identified]
    best_first = sorted(models, key=lambda model: -records_fit_percent(model, data.training, data))
    return best_first[:count]


def can_be_certified(spec: "ModelSpec", model: Any) -> bool:
    """Whether some state feedback and some observer can be certified for a model. It is true if the
    settings do not require it."""
    rule = getattr(spec, "among_starts", None)
    has_certificates = getattr(rule, "has_certificates", None)
    return has_certificates is None or bool(has_certificates(model))


def refuse_unsupported_disturbances(spec: "ModelSpec", data: DataSet) -> None:
    """Raise `BadRequest` for data with measured disturbances if the model structure has no input
    for them."""
    from ssm_study.models.spec import SSMSpec
    from ssm_study.models.structured_spec import StructuredSpec

    names_of_disturbances = (channel.name for channel in data.disturbances)
    names = ", ".join(names_of_disturbances)
    takes = not data.disturbances or isinstance(spec, SSMSpec | StructuredSpec)
    problem = f"{type(spec).__name__} has no path for measured disturbances"
    remedy = "use model=log, structured, ssm or linear, or name the column an input"
    require(takes, "data.disturbance", names, problem, remedy)


@dataclass(frozen=True, kw_only=True)
class TrainingSession:
    """Seed, folder and options that all training runs of one identification have in common.

    `initial_parameters` are those of structured models whose runs began before, by seed.
    """

    seed: int
    folder: Path
    progress: bool = False
    keep_on_interrupt: bool = False
    initial_parameters: "dict[int, Theta]" = field(default_factory=dict)
