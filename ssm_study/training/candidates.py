"""Candidate settings of a model, scored by their free-run error in cross-validation."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.models.baselines.regression import fit_arx, fit_output_error
from ssm_study.models.identified import SSM
from ssm_study.models.metrics import Simulation
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.models.warm_start import PAST, SAMPLES, states_from_preceding_log
from ssm_study.signals import DataSet, Trajectory
from ssm_study.systems import StateSpace
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.short_starts import STEPS, settings_for_short_training
from ssm_study.training.structured_fit import LinearStarts, StructuredFit

LINEAR = "linear output error"
REGRESSION = "linear ARX"  # the errors of one step: a load that is not in the log weighs less
FIT_RECURSION = {LINEAR: fit_output_error, REGRESSION: fit_arx}
ENDED_LINEAR = {
    LINEAR: "the error of a linear free run no longer falls",
    REGRESSION: "a linear regression has one solution",
}
LARGEST_ERROR = 100.0  # percent: of a free run no better than the mean; one piece decides nothing
NEARLY = 0.05  # of the best error: candidates nearer than this are about as good
HOPELESS = 1.5  # times the best error after two folds: not tried on the others
FEWEST_FOLDS = 2
EXPLAINS_LESS = 1.25  # times the error on the training records of the folds
EXPLAINED = 15.0  # percent: the largest error on these records for which that counts
CHANCE = 2.0  # standard errors that folds may contradict a regression where a load acts
Settings = dict[str, Any]
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Candidate model: settings that were tried, with the free-run error on each cross-validation
    fold.

    Errors are those of `relative_rms_error`. Folds that were left out, because the candidate was
    far behind, are missing at the end of `errors`. `best_initial_state_source` says from where the
    held-out pieces were simulated, `example` is the model trained without the last fold.
    """

    question: str
    model: str
    settings: Settings
    errors: Float[np.ndarray, "folds"]
    start: str = SAMPLES
    example: Any = field(default=None, repr=False, compare=False)
    training_error: float = 0.0  # median over the folds, percent
    fits: tuple[Any, ...] = field(default=(), repr=False, compare=False)  # of the folds

    @property
    def mean_error_percent(self) -> float:
        """Mean free-run error of a candidate model over the cross-validation folds, in percent."""
        return float(self.errors.mean())

    def is_clearly_worse(self, other: "Candidate", tolerance: float = NEARLY) -> bool:
        """Whether a candidate model's cross-validation error is clearly larger than another's. It
        exceeds the other's by the fraction `tolerance`, and by one standard error or on all folds
        but one: a single odd piece makes the standard error large."""
        if len(self.errors) < len(other.errors):
            return True
        other_folds = len(other.errors)
        excess = self.errors[:other_folds] - other.errors
        deviation = excess.std(ddof=1)
        root_of_count = np.sqrt(len(excess))
        standard_error = float(deviation) / root_of_count
        is_worse = excess > tolerance * other.errors
        worse_folds = is_worse.sum()
        fold_count = len(excess)
        is_consistent = int(worse_folds) >= fold_count - 1
        mean_excess = excess.mean()
        large_excess = tolerance * other.mean_error_percent
        is_large = bool(mean_excess > large_excess)
        return is_large and (is_consistent or bool(excess.mean() > standard_error))

    def is_undecided_by_folds(self, other: "Candidate", tolerance: float = NEARLY) -> bool:
        """Whether errors differ so much between folds that the better of two candidate models stays
        undecided.

        One standard error of the difference then exceeds the fraction `tolerance` of the other's
        error.
        """
        other_folds = len(other.errors)
        difference = self.errors[:other_folds] - other.errors
        deviation = difference.std(ddof=1)
        root_of_count = np.sqrt(len(difference))
        standard_error = deviation / root_of_count
        return bool(standard_error > tolerance * other.mean_error_percent)

    def is_worse_beyond_chance(self, other: "Candidate") -> bool:
        """Whether a candidate model's mean cross-validation error exceeds another's by several
        standard errors of the difference."""
        if len(self.errors) < len(other.errors):
            return True
        excess = self.errors[: len(other.errors)] - other.errors
        standard_error = excess.std(ddof=1) / np.sqrt(len(excess))
        return bool(excess.mean() > CHANCE * standard_error)

    def fits_far_worse_than(self, other: "Candidate") -> bool:
        """Whether a candidate model fits the training records far worse than another model with a
        nearly perfect fit.

        If the other model leaves `EXPLAINED` percent or more unexplained, the comparison does not
        count: a load that is not in the log may act, and a better fit to it is chance.
        """
        if other.training_error >= EXPLAINED:
            return False
        return self.training_error > EXPLAINS_LESS * other.training_error

    def fails_where_other_succeeds(self, other: "Candidate") -> bool:
        """Whether a candidate model predicts some fold no better than the output's mean, while
        another predicts all folds better.

        It does not count where the other one explains less of the records: then that fold holds
        motions that no other has, and the last training has them all.
        """
        largest_error = self.errors.max()
        fails = bool(largest_error >= LARGEST_ERROR > other.errors.max())
        return fails and not other.fits_far_worse_than(self)

    def table_row(self, *, is_chosen: bool, is_certified: bool | None) -> Row:
        """Row of the table of candidate models: settings, cross-validation error, and whether the
        model was chosen. `is_certified` is None if that was not examined."""
        fits = 100.0 - self.errors
        row: Row = {"question": self.question, "model": self.model, **self.settings}
        mean_fit = fits.mean()
        row["fit_held_out_percent"] = float(mean_fit)
        worst_fit = fits.min()
        row["fit_worst_fold_percent"] = float(worst_fit)
        fit_texts = (f"{fit:.1f}" for fit in fits)
        row["fits_of_folds_percent"] = " ".join(fit_texts)
        row["fit_training_percent"] = 100.0 - self.training_error
        row["folds"] = len(fits)
        row["piece_start"] = self.start
        row["certified"] = is_certified
        row["chosen"] = is_chosen
        return row

    @property
    def describe(self) -> str:
        """Line of text with a candidate model's settings and cross-validation error."""
        setting_texts = (f"{name} {value}" for name, value in self.settings.items())
        settings = ", ".join(setting_texts)
        return f"{self.question}: {self.model}, {settings}: {100.0 - self.mean_error_percent:.1f} %"


def best_candidate(candidates: Iterable[Candidate]) -> Candidate:
    """Candidate with the smallest mean cross-validation error, among those evaluated on the largest
    number of folds."""
    return min(
        candidates, key=lambda candidate: (-len(candidate.errors), candidate.mean_error_percent)
    )


def simplest_good_candidate(
    candidates: Sequence[Candidate], tolerance: float = NEARLY
) -> Candidate:
    """First candidate model, in order of increasing size, that is not clearly worse than the best
    one."""
    return good_candidates(candidates, tolerance)[0]


def good_candidates(candidates: Sequence[Candidate], tolerance: float = NEARLY) -> list[Candidate]:
    """Candidate models that are not clearly worse than the best one, in their given order.

    They are clearly worse neither on held-out pieces nor on the records on which they were trained,
    and none fails on a fold where the best does not. On the training records they are also compared
    with candidates that the folds cannot distinguish from the best.
    """
    best = best_candidate(candidates)
    near = [
        candidate
        for candidate in candidates
        if not (
            candidate.is_clearly_worse(best, tolerance)
            or candidate.fails_where_other_succeeds(best)
        )
    ]
    rivals = [candidate for candidate in near if candidate.is_undecided_by_folds(best, tolerance)]
    rivals_and_best = [best, *rivals]
    explains_most = min(rivals_and_best, key=lambda candidate: candidate.training_error)
    return [candidate for candidate in near if not candidate.fits_far_worse_than(explains_most)]


@dataclass
class CandidateErrors:
    """Free-run errors of one candidate model on the folds so far, for initial states found in
    either of two ways. One is estimated from the first samples, one simulated from the log before
    (`models.warm_start`)."""

    by_start: dict[str, list[float]] = field(default_factory=lambda: {SAMPLES: [], PAST: []})
    example: Any = None
    training_errors: list[float] = field(default_factory=list)
    fits: list[StructuredFit] = field(default_factory=list)

    def add_error_on_fold(self, model: Any, fold: DataSet, training_error: float = 0.0) -> None:
        """Add the free-run error of a model on the held-out part of one more fold. A model that is
        None counts as failed."""
        self.example = model
        self.training_errors.append(training_error)
        states = () if model is None else states_from_preceding_log(model, fold, fold.test)
        record_count = len(states)
        starts = {SAMPLES: (None,) * record_count, PAST: states}
        for name, errors in self.by_start.items():
            if model is None:
                errors.append(LARGEST_ERROR)
                continue
            run = Simulation.simulate_records(model, fold.test, fold.start_up_samples, starts[name])
            errors.append(relative_rms_error(run, fold))

    def add_error_of_fit(self, fit: StructuredFit, fold: DataSet) -> None:
        """Add the free-run error of a trained structured model on the fold that was held out from
        its training."""
        loss = float(fit.loss)
        self.fits.append(fit)
        is_finite = np.isfinite(loss)
        model = fit.as_model() if is_finite else None
        relative_error = np.sqrt(loss)
        self.add_error_on_fold(model, fold, 100.0 * relative_error)

    @property
    def best_initial_state_source(self) -> str:
        """Way of finding initial states that gives the smaller mean error of a candidate."""
        errors_with_past = self.by_start[PAST]
        errors_with_samples = self.by_start[SAMPLES]
        return PAST if sum(errors_with_past) < sum(errors_with_samples) else SAMPLES

    @property
    def errors(self) -> Float[np.ndarray, "folds"]:
        """Errors of a candidate model on the folds, for the better of two ways of finding initial
        states."""
        errors_of_kind = self.by_start[self.best_initial_state_source]
        return np.array(errors_of_kind)


def cross_validate_linear_model(
    folds: Sequence[DataSet], order: int, delay: int, kind: str = LINEAR
) -> CandidateErrors:
    """Fit a linear model on every cross-validation fold, and compute its errors on the held-out
    parts. A delay of 1 is no dead time, 0 a direct path; the kind is output error or ARX."""
    trial = CandidateErrors()
    for fold in folds:
        part = fold.shift_out_dead_time(delay - 1) if delay > 1 else fold
        with np.errstate(all="ignore"):
            model = fit_linear_model(part, order, has_feedthrough=delay == 0, kind=kind)
            fit_training = records_fit_percent(model, part.training, part)
            trial.add_error_on_fold(model, part, 100.0 - fit_training)
    return trial


def fit_linear_model(
    data: DataSet, order: int, *, has_feedthrough: bool, kind: str = LINEAR
) -> SSM:
    """Fit a linear output-error or ARX model to the training records, as a state-space model. `x+ =
    A x + B u + B_d d, y = C x + D u`.

    The state of a held-out piece can then be estimated from many samples; the recursion itself
    would start from as many noisy outputs as it has lags. Measured disturbances are further inputs
    of the recursion, from one sample before on.
    """
    records = delay_disturbances(data) if has_feedthrough else data
    fit_recursion = FIT_RECURSION[kind]
    records_with_inputs = records.with_disturbances_as_inputs()
    delay = 0 if has_feedthrough else 1
    model = fit_recursion(records_with_inputs, order, delay)
    f = model.theta[1 : order + 1]
    input_coefficients = model.theta[order + 1 :]
    both = input_coefficients.reshape(-1, order).T  # (lags, inputs and disturbances)
    input_count = data.scale.inputs
    gains = both[:, :input_count]
    d = gains[:1] if has_feedthrough else np.zeros((1, gains.shape[1]))
    by_lag = np.concatenate([gains[1:], 0.0 * d]) if has_feedthrough else gains
    a = np.eye(order, k=1)
    a[:, 0] = f
    scaled_constant = data.scale.output_scale * model.theta[0]
    denominator_sum = f.sum()
    offset = scaled_constant / (1.0 - denominator_sum)
    moved_equilibrium = data.scale.output_equilibrium + offset
    scale = replace(data.scale, output_equilibrium=moved_equilibrium)
    b = by_lag + f[:, None] * d
    first_state = np.eye(1, order)
    system = StateSpace(a=a, b=b, c=first_state, d=d)
    if not data.disturbances:
        return SSM.from_linear(system, data.step_s, scale)
    gain_count = gains.shape[1]
    identity_in = LinearScaffold.identity(gain_count)
    identity_out = LinearScaffold.identity(1)
    disturbance_start = gains.shape[1]
    return SSM(
        linear=system,
        scaffold_in=identity_in,
        scaffold_out=identity_out,
        scale=scale,
        step_s=data.step_s,
        b_d=both[:, disturbance_start:],
    )


def delay_disturbances(data: DataSet) -> DataSet:
    """Copy of a data set in which the measured disturbances are delayed by one sample. An effect
    within the sample for the input is then one of the sample before for them."""
    delayed_records = (delay_disturbance(record) for record in data.training)
    late = tuple(delayed_records)
    return replace(data, training=late)


def delay_disturbance(record: Trajectory) -> Trajectory:
    """Copy of a record in which the measured disturbances are delayed by one sample."""
    if record.d is None:
        return record
    first_value = record.d[:1]
    earlier_values = record.d[:-1]
    late = np.vstack([first_value, earlier_values])
    return replace(record, d=late)


def cross_validate_structured_model(
    spec: StructuredSpec,
    folds: Sequence[DataSet],
    seed: int,
    best: Candidate | None,
    linear_starts: Sequence[LinearStarts],
) -> CandidateErrors:
    """Train a structured model briefly on every cross-validation fold, and compute its errors on
    the held-out parts. The last folds are left out if it is far behind `best`.

    `linear_starts` holds, for each fold, the linear starts of models trained before; new ones are
    added.
    """
    brief = settings_for_short_training(spec)
    trial = CandidateErrors()
    for fold, starts in zip(folds, linear_starts, strict=True):
        if best is not None and is_far_worse_than_best(trial.errors, best):
            break
        part = fold.shift_out_dead_time(int(spec.dead_time)) if spec.dead_time else fold
        fit = StructuredFit(brief, part, seed, starts)
        fit.start_training(STEPS)
        trial.add_error_of_fit(fit, part)
    return trial


def train_further(
    fits: Sequence[StructuredFit], folds: Sequence[DataSet], steps: int
) -> CandidateErrors:
    """Continue the training of a candidate's model on every fold, and compute the errors again."""
    trial = CandidateErrors()
    for fit, fold in zip(fits, folds, strict=True):
        dead_time = int(fit.spec.dead_time)
        fit.continue_training(steps)
        shifted_fold = fold.shift_out_dead_time(dead_time) if dead_time else fold
        trial.add_error_of_fit(fit, shifted_fold)
    return trial


def is_far_worse_than_best(
    errors: Sequence[float] | Float[np.ndarray, "folds"], best: Candidate
) -> bool:
    """Whether a candidate model's errors on the first folds are many times those of the best
    candidate."""
    count = len(errors)
    so_far = float(np.sum(errors))
    return count >= FEWEST_FOLDS and so_far > HOPELESS * float(best.errors[:count].sum())


def relative_rms_error(run: Simulation, data: DataSet) -> float:
    """Root mean square simulation error relative to the output's standard deviation, in percent.

    A piece in which the output hardly moves then has little weight.
    """
    squares = []
    for record, simulated in zip(run.records, run.simulated, strict=True):
        output_error = record.y - simulated
        error = output_error[run.start_up_samples :] / data.scale.output_scale
        squares.append(error**2)
    with np.errstate(all="ignore"):
        all_squares = np.concatenate(squares)
        mean_square = np.mean(all_squares)
        error_percent = 100.0 * float(np.sqrt(mean_square))
    is_finite = np.isfinite(error_percent)
    return min(error_percent, LARGEST_ERROR) if is_finite else LARGEST_ERROR
