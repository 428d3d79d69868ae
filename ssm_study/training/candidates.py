"""Candidates of a choice: settings, the errors of their free runs on held-out folds, and how two
are compared."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.models.baselines.regression import output_error
from ssm_study.models.identified import SSM
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet
from ssm_study.systems import StateSpace
from ssm_study.training.metrics import mean_fit
from ssm_study.training.structured_fit import StructuredFit

LARGEST_ERROR = 100.0  # percent: of a free run no better than the mean; one piece decides nothing
NEARLY = 0.05  # of the best error: candidates nearer than this are about as good
STEPS = 20  # of a training on a fold, inside the contracting set
DRAWS = 3  # of random neurons for such a training
HOPELESS = 1.5  # times the best error after two folds: not tried on the others
FEWEST_FOLDS = 2
Settings = dict[str, Any]
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Settings that were tried, and the error of the free run on each held-out fold.

    An error is `100 - fit`, in percent, at most `LARGEST_ERROR`. Folds that were left out, because
    the candidate was far behind, are missing at the end of `errors`.
    """

    question: str
    model: str
    settings: Settings
    errors: Float[np.ndarray, "folds"]

    @property
    def mean_error(self) -> float:
        """Mean over the folds, percent."""
        return float(self.errors.mean())

    def is_behind(self, other: "Candidate", by: float = NEARLY) -> bool:
        """Whether its error exceeds the other's by that share of it and by one standard error."""
        if len(self.errors) < len(other.errors):
            return True
        excess = self.errors[: len(other.errors)] - other.errors
        standard_error = float(excess.std(ddof=1)) / np.sqrt(len(excess))
        return bool(excess.mean() > max(by * other.mean_error, standard_error))

    def row(self, *, chosen: bool) -> Row:
        """Line of the table of what was tried."""
        fits = 100.0 - self.errors
        return {
            "question": self.question,
            "model": self.model,
            **self.settings,
            "fit_held_out_percent": float(fits.mean()),
            "fit_worst_fold_percent": float(fits.min()),
            "folds": len(fits),
            "chosen": chosen,
        }

    @property
    def words(self) -> str:
        """One line for whoever watches."""
        settings = ", ".join(f"{name} {value}" for name, value in self.settings.items())
        return f"{self.question}: {self.model}, {settings}: {100.0 - self.mean_error:.1f} %"


def best_of(candidates: Iterable[Candidate]) -> Candidate:
    """The candidate of the least mean error among those tried on most folds."""
    return min(candidates, key=lambda candidate: (-len(candidate.errors), candidate.mean_error))


def first_not_behind(candidates: Sequence[Candidate], by: float = NEARLY) -> Candidate:
    """The first candidate, in the order given, that is not behind the best of all."""
    best = best_of(candidates)
    return next(candidate for candidate in candidates if not candidate.is_behind(best, by))


def linear_errors(folds: Sequence[DataSet], order: int, delay: int) -> Float[np.ndarray, "folds"]:
    """Errors of a linear output-error model on each held-out fold; delay 1 is no dead time, 0 a
    direct path."""
    errors = []
    for fold in folds:
        part = fold.shift_out_dead_time(delay - 1) if delay > 1 else fold
        with np.errstate(all="ignore"):
            model = linear_model(part, order, direct=delay == 0)
            errors.append(bounded_error(mean_fit(model, part.test, part)))
    return np.array(errors)


def linear_model(data: DataSet, order: int, *, direct: bool) -> SSM:
    """A linear output-error model as a state space, `x+ = A x + B u, y = C x + D u`.

    The state of a held-out piece can then be estimated from many samples; the recursion itself
    would start from as many noisy outputs as it has lags.
    """
    model = output_error(data, order, 0 if direct else 1)
    f = model.theta[1 : order + 1]
    gains = model.theta[order + 1 :].reshape(-1, order).T  # (lags, inputs)
    d = gains[:1] if direct else np.zeros((1, gains.shape[1]))
    by_lag = np.concatenate([gains[1:], 0.0 * d]) if direct else gains
    a = np.eye(order, k=1)
    a[:, 0] = f
    system = StateSpace(a=a, b=by_lag + f[:, None] * d, c=np.eye(1, order), d=d)
    offset = data.scale.output_scale * model.theta[0] / (1.0 - f.sum())
    scale = replace(data.scale, output_equilibrium=data.scale.output_equilibrium + offset)
    return SSM.of(system, data.step_s, scale)


def structured_errors(
    spec: StructuredSpec, folds: Sequence[DataSet], seed: int, best: Candidate | None
) -> Float[np.ndarray, "folds"]:
    """Errors of a structured model trained for a few steps without each fold; the last folds are
    left out where it is far behind `best`."""
    brief = replace(spec, draws=min(DRAWS, spec.draws))
    errors: list[float] = []
    for fold in folds:
        if best is not None and is_hopeless(errors, best):
            break
        part = fold.shift_out_dead_time(int(spec.dead_time)) if spec.dead_time else fold
        fit = StructuredFit(brief, part, seed)
        fit.advance(STEPS)
        errors.append(
            bounded_error(mean_fit(fit.stored(), part.test, part))
            if np.isfinite(float(fit.loss))
            else LARGEST_ERROR
        )
    return np.array(errors)


def is_hopeless(errors: Sequence[float], best: Candidate) -> bool:
    """Whether the errors so far are `HOPELESS` times those of the best candidate."""
    count = len(errors)
    so_far = float(np.sum(errors))
    return count >= FEWEST_FOLDS and so_far > HOPELESS * float(best.errors[:count].sum())


def bounded_error(fit_percent: float) -> float:
    """`100 - fit` within zero and `LARGEST_ERROR`."""
    if not np.isfinite(fit_percent):
        return LARGEST_ERROR
    return float(np.clip(100.0 - fit_percent, 0.0, LARGEST_ERROR))
