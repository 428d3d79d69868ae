"""Search for model settings by cross-validation: models tried so far, settings decided so far, and
the resulting choice."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ssm_study.models.bilinear_spec import BilinearSpec
from ssm_study.models.structured_spec import AUTO, AUTOMATIC, StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.training.candidates import (
    LINEAR,
    REGRESSION,
    Candidate,
    CandidateErrors,
    Row,
    Settings,
    best_candidate,
    cross_validate_linear_model,
    cross_validate_structured_model,
    train_further,
)
from ssm_study.training.folds import FOLDS, SHORTEST_FOLD
from ssm_study.training.structured_fit import LinearStarts

STRUCTURED = "structured"
PRODUCTS = "products of input and state"
TOO_SHORT = f"as no record beside the test has {FOLDS * SHORTEST_FOLD} samples"
LINEAR_KINDS = (LINEAR, REGRESSION)


@dataclass(frozen=True, kw_only=True)
class SettingsChoice:
    """Model settings, all of them decided, with the table of candidate models from which they were
    chosen. The table is empty if nothing was tried.

    `linear_kind`: the output-error or ARX model itself is to be taken, of this order and delay.
    `others` are settings of other structures that the folds cannot tell from the chosen one.
    `predictor` are those of a model with products of input and state that predicts far better.
    With `only_if_certified` a model trained so is given up if it has no certificates; `remark`
    names such a model, kept or given up, in the text of the choice. `from_records`: the records
    were long enough to decide.
    """

    spec: StructuredSpec
    rows: tuple[Row, ...] = ()
    error: float | None = None
    linear_kind: str | None = None
    others: tuple[StructuredSpec, ...] = ()
    predictor: BilinearSpec | None = None
    only_if_certified: bool = False
    remark: str = ""
    from_records: bool = False

    def describe(self, automatic_settings: Sequence[str]) -> str:
        """Text that names the model settings chosen from the records, and the number of candidates
        compared."""
        settings = ", ".join(
            f"{setting_text(name)} {setting_text(getattr(self.spec, name))}"
            for name in automatic_settings
        )
        if not settings:
            return ""
        if not self.from_records:
            return f"nothing, {TOO_SHORT}; the defaults: {settings}"
        if not self.rows:
            return f"{settings}: read off the records"
        compared = f"of {len(self.rows)} models compared on {FOLDS} folds"
        predicts = f"; {PRODUCTS} predict" if self.predictor is not None else ""
        remark = f"; {self.remark}" if self.remark else ""
        return f"{settings}: {compared}{predicts}{remark}"


def setting_text(value: object) -> str:
    """Text for the name or value of a setting, such as `dead time`, `yes` or `5`."""
    words = {"True": "yes", "False": "no", "None": "none"}
    text = str(value)
    plain_text = str(value).replace("_", " ")
    return words.get(text, plain_text)


@dataclass(kw_only=True)
class SettingsSearch:
    """Search for model settings by cross-validation, with the models tried and the settings decided
    so far."""

    spec: StructuredSpec
    folds: Sequence[DataSet]
    seed: int
    announce: Callable[[str], None]
    decided: Settings = field(default_factory=dict)
    tried: list[Candidate] = field(default_factory=list)
    chosen: list[Candidate] = field(default_factory=list)
    certified: dict[int, bool] = field(default_factory=dict)  # by identity of the candidate
    remark: str = ""  # of a model that was given up after its training
    linear_starts: list[LinearStarts] = field(init=False)  # of each fold

    def __post_init__(self) -> None:
        self.linear_starts = [{} for _ in self.folds]

    def is_undecided(self, name: str) -> bool:
        """Whether a model setting is to be chosen from the records and is not decided yet."""
        value = getattr(self.spec, name)
        is_automatic = value == AUTO
        return bool(is_automatic) and name not in self.decided

    def score_structured_model(self, question: str, settings: Settings) -> Candidate:
        """Cross-validate a structured model with given settings, and return it as a candidate."""
        spec = self.complete_settings(settings)
        settings = {name: getattr(spec, name) for name in self.spec.automatic_settings}
        tried = self.find_candidate(STRUCTURED, settings)
        if tried is not None:
            return tried
        best = best_candidate(self.tried) if self.tried else None
        trial = cross_validate_structured_model(
            spec, self.folds, self.seed, best, self.linear_starts
        )
        return self.add_candidate(question, STRUCTURED, settings, trial)

    def complete_settings(self, settings: Settings) -> StructuredSpec:
        """Complete model settings with those decided so far and with defaults."""
        wanted_settings = self.decided | settings
        if wanted_settings.get("neurons") == 0:
            wanted_settings["input_path"] = "none"  # there are no neurons for it to reach
        automatic = self.spec.automatic_settings
        wanted_of_automatic = {
            name: wanted_settings[name] for name in automatic if name in wanted_settings
        }
        completed = replace(self.spec, **wanted_of_automatic)
        return fill_in_defaults(completed)

    def score_linear_model(
        self, question: str, order: int, delay: int, kind: str = LINEAR
    ) -> Candidate:
        """Cross-validate a linear output-error or ARX model, and return it as a candidate."""
        settings = {"order": order, "delay": delay}
        tried = self.find_candidate(kind, settings)
        if tried is not None:
            return tried
        trial = cross_validate_linear_model(self.folds, order, delay, kind)
        return self.add_candidate(question, kind, settings, trial)

    def setting_value(self, name: str) -> Any:
        """Value of a model setting as decided so far or as the user set it."""
        own_value = getattr(self.spec, name)
        return self.decided.get(name, own_value)

    @property
    def has_integrator(self) -> bool:
        """Whether the decided settings give the model an integrator at its output."""
        return self.setting_value("integrating_output") is True

    @property
    def allows_linear_model(self) -> bool:
        """Whether the user's settings allow a linear model, without neurons and static maps."""
        open_or_none = (AUTO, 0)
        neurons = self.spec.neurons
        knots = self.spec.knots
        sizes = (neurons, knots)
        are_open = (size in open_or_none for size in sizes)
        return all(are_open) and self.spec.output_knots == 0

    def is_certifiable(self, candidate: Candidate) -> bool:
        """Whether a state feedback and an observer can be certified for a candidate model. It is
        true if the settings do not require it.

        One of the models that were trained on the folds is enough: the chosen candidate is trained
        from many starts, of which those with a certificate come first.
        """
        starts = self.spec.among_starts
        has_certificates = getattr(starts, "has_certificates", None)
        if has_certificates is None or candidate.example is None:
            return True
        if id(candidate) not in self.certified:
            finite = [fit for fit in candidate.fits if np.isfinite(float(fit.loss))]
            models = [fit.as_model() for fit in finite] or [candidate.example]
            are_certifiable = (has_certificates(model) for model in models)
            self.certified[id(candidate)] = any(are_certifiable)
        return self.certified[id(candidate)]

    def train_further(self, candidate: Candidate, steps: int) -> Candidate:
        """Continue the training of a candidate model on all folds, and add the result as another
        candidate."""
        trial = train_further(candidate.fits, self.folds, steps)
        return self.add_candidate("longer training", STRUCTURED, candidate.settings, trial)

    def add_candidate(
        self, question: str, model: str, settings: Settings, errors: CandidateErrors
    ) -> Candidate:
        """Add a candidate model to those tried so far, and print its cross-validation error."""
        median_error = np.median(errors.training_errors)
        training_error = float(median_error)
        fits = tuple(errors.fits)
        candidate = Candidate(
            question=question,
            model=model,
            settings=settings,
            errors=errors.errors,
            start=errors.best_initial_state_source,
            example=errors.example,
            training_error=training_error,
            fits=fits,
        )
        self.tried.append(candidate)
        self.announce(candidate.describe)
        return candidate

    def find_candidate(self, model: str, settings: Settings) -> Candidate | None:
        """Find the candidate model with exactly the given settings among those tried; None if there
        is none."""
        alike = [one for one in self.tried if (one.model, one.settings) == (model, settings)]
        return alike[0] if alike else None

    def adopt_settings(self, candidate: Candidate, settings: Settings) -> None:
        """Give every undecided model setting the value that it has in a candidate model."""
        self.chosen.append(candidate)
        self.decided |= {name: value for name, value in settings.items() if self.is_undecided(name)}

    def build_settings_choice(
        self, candidate: Candidate | None, others: Sequence[Candidate] = ()
    ) -> SettingsChoice:
        """Build the final choice of model settings from all decided settings and a candidate
        model's size. `others` are candidates for further members of a mean of several models."""
        chosen = [*self.chosen]
        error = None
        linear_kind = None
        if candidate is not None:
            chosen.append(candidate)
            error = candidate.mean_error_percent
            linear_kind = candidate.model if candidate.model in LINEAR_KINDS else None
        decided_specs = (self._candidate_settings(other) for other in others)
        other_specs = tuple(decided_specs)
        spec = self._candidate_settings(candidate)
        rows = self.candidate_rows(chosen)
        return SettingsChoice(
            spec=spec,
            rows=rows,
            error=error,
            linear_kind=linear_kind,
            others=other_specs,
            remark=self.remark,
            from_records=True,
        )

    def _candidate_settings(self, candidate: Candidate | None) -> StructuredSpec:
        """Model settings with all values decided so far and with the size of a candidate model."""
        decided = dict(self.decided)
        if candidate is not None:
            decided |= candidate.settings
            if candidate.model in LINEAR_KINDS:
                decided |= {"neurons": 0, "knots": 0, "input_path": "none"}
        automatic = self.spec.automatic_settings
        settings = {name: decided[name] for name in automatic if name in decided}
        return fill_in_defaults(replace(self.spec, **settings))

    def candidate_rows(self, chosen: Sequence[Candidate]) -> tuple[Row, ...]:
        """Rows of the table of all candidate models that were tried."""
        rows = []
        for candidate in self.tried:
            is_chosen = any(candidate is other for other in chosen)
            is_certified = self.certified.get(id(candidate))
            row = candidate.table_row(is_chosen=is_chosen, is_certified=is_certified)
            rows.append(row)
        return tuple(rows)


def fill_in_defaults(spec: StructuredSpec) -> StructuredSpec:
    """Copy of the model settings in which every undecided setting has its default value."""
    defaults = {name: AUTOMATIC[name] for name in spec.automatic_settings}
    return replace(spec, **defaults)
