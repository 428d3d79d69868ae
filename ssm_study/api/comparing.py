"""Comparison of several models on one record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from typing_extensions import TypeAliasType

from ssm_study.api.arguments import Values
from ssm_study.api.model import Model
from ssm_study.api.scoring import require_varying_outputs, simulate_given_record
from ssm_study.refusal import require
from ssm_study.signals import fit_percent, rmse

Outputs = Float[np.ndarray, "T p"]
Records = Sequence[Float[np.ndarray, "_ p"]]  # of any lengths

Models = TypeAliasType("Models", Sequence[Model] | Mapping[str, Model])


@dataclass(frozen=True, kw_only=True, repr=False)
class ModelComparison:
    """Free-run simulations of several models on one record, with the fit and the error of each.

    `print(comparison)` shows the table, `comparison.plot()` draws the runs with their residuals.
    `table` has one row per model: fit in percent of each output and in total, root mean square
    error in the output's unit, largest error, states. `simulated` holds the outputs by name.
    """

    table: pd.DataFrame
    measured: Float[np.ndarray, "T p"]
    simulated: dict[str, Float[np.ndarray, "T p"]]
    time_s: Float[np.ndarray, "T"]
    output_names: list[str]
    start_up_samples: int = 0
    record_words: str = "the test record"

    def __repr__(self) -> str:
        return self.table.to_string(float_format=lambda value: f"{value:.4g}")

    def _repr_html_(self) -> str:
        """Render the scores of several models as an HTML table for notebooks."""
        text: str = self.table.to_html(float_format=lambda value: escape(f"{value:.4g}"))
        return text

    def plot(self) -> Any:
        """Draw the measured and simulated outputs of a model comparison, with the residuals below.
        Returns the Matplotlib figure."""
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.free_run import free_run_picture

        picture = free_run_picture(
            self.time_s,
            self.measured,
            self.simulated,
            self.output_names,
            self.start_up_samples,
            self.record_words,
        )
        return draw_picture(picture)


def compare(
    models: Models,
    u: Values,
    y: Values,
    disturbance: Values | None = None,
    *,
    start_up_samples: int | None = None,
) -> ModelComparison:
    """Simulate several models on one record and compare their fits. The scores are those of
    `Model.score`.

    `models` is a list, or a mapping from names to models. Best fit first. A measured disturbance is
    given to the models that have a path for it. Raises `BadRequest` for no models, and where a
    model has other channels than the record.

    >>> import numpy as np, ssm_study as st
    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.uniform(-3, 3, 100), 8)
    >>> y = np.zeros(801)
    >>> for k in range(800): y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    >>> model = st.fit(u, y[:800], 0.1, model="linear", order=1, progress=False)
    >>> bool(st.compare({"linear": model}, u, y[:800]).table.loc["linear", "fit_percent"] > 95)
    True
    """
    named = named_models(models)
    first = next(iter(named.values()))
    if start_up_samples is None:
        start_ups = (model.data.start_up_samples for model in named.values())
        start_up_samples = max(start_ups)
    simulations = {}
    for name, model in named.items():
        own_disturbance = disturbance if model.disturbance_names else None
        run = simulate_given_record(model, u, y, own_disturbance, start_up_samples, name)
        require_varying_outputs(run)
        simulations[name] = run
    states = {name: getattr(model.simulator, "order", None) for name, model in named.items()}
    first_simulation = next(iter(simulations.values()))
    first_record = first_simulation.records[0]
    measured = first_record.y
    simulated = {name: run.simulated for name, run in simulations.items()}
    return compare_simulations(
        [measured],
        simulated,
        output_names=first.output_names,
        step_s=first.data.step_s,
        states=states,
        start_up_samples=start_up_samples,
        record_words="the given record",
    )


def named_models(models: Any) -> dict[str, Model]:
    """Read models by name from a mapping, a list or a single model. Raises `BadRequest` for any
    other value."""
    if isinstance(models, Model):
        models = [models]
    remedy = "give a list of models, as st.fit returns them"
    several = isinstance(models, Mapping | list | tuple)
    kind = type(models).__name__
    require(several, "models", kind, "is no list of models", remedy)
    has_models = len(models) > 0
    require(has_models, "models", "none", "there is nothing to compare", remedy)
    each = models.values() if isinstance(models, Mapping) else models
    for model in each:
        is_model = isinstance(model, Model)
        kind = type(model).__name__
        require(is_model, "models", kind, "is no model", remedy)
    if isinstance(models, Mapping):
        return {str(name): model for name, model in models.items()}
    return _name_models_by_kind(models)


def compare_simulations(
    measured: Records,
    simulated: Mapping[str, Records],
    *,
    output_names: list[str],
    step_s: float,
    states: Mapping[str, int | None],
    start_up_samples: int = 0,
    record_words: str = "the test record",
) -> ModelComparison:
    """Compare simulations of the same records by several models in a table, sorted by fit, best
    first. The longest record is drawn.

    The first `start_up_samples` of each record are not scored: they tell the initial state.
    """
    scored = slice(start_up_samples, None)
    scored_records = [record[scored] for record in measured]
    whole = np.concatenate(scored_records)
    rows = {}
    for name, outputs in simulated.items():
        scored_outputs = [values[scored] for values in outputs]
        output = np.concatenate(scored_outputs)
        scores = _score_row(whole, output, output_names)
        rows[name] = scores | {"states": states[name]}
    unsorted = pd.DataFrame.from_dict(rows, orient="index")
    table = unsorted.sort_values("fit_percent", ascending=False)
    table.index.name = "model"
    lengths = [len(record) for record in measured]
    longest = int(np.argmax(lengths))
    samples = len(measured[longest])
    time_s = np.arange(samples) * step_s
    longest_simulations = {str(name): simulated[str(name)][longest] for name in table.index}
    return ModelComparison(
        table=table,
        measured=measured[longest],
        simulated=longest_simulations,
        time_s=time_s,
        output_names=output_names,
        start_up_samples=start_up_samples,
        record_words=record_words,
    )


def _name_models_by_kind(models: Sequence[Model]) -> dict[str, Model]:
    """Name models by their kind, such as `ssm`, numbered if several models are of the same kind."""
    kinds = [kind_of_model(model) for model in models]
    names = []
    for i, kind in enumerate(kinds):
        is_unique = kinds.count(kind) == 1
        names.append(kind if is_unique else f"{kind} {kinds[: i + 1].count(kind)}")
    models_by_name = zip(names, models, strict=True)
    return dict(models_by_name)


def _score_row(
    measured: Outputs, simulated: Outputs, output_names: Sequence[str]
) -> dict[str, Any]:
    """Table row with the fit and the errors of one model's simulation of a record."""
    fit_of_all = fit_percent(measured, simulated)
    row: dict[str, Any] = {"fit_percent": fit_of_all}
    if measured.shape[1] > 1:
        for j, name in enumerate(output_names):
            column = slice(j, j + 1)
            measured_channel = measured[:, column]
            simulated_channel = simulated[:, column]
            row[f"fit_percent of {name}"] = fit_percent(measured_channel, simulated_channel)
    row["rmse"] = rmse(measured, simulated)
    absolute_errors = np.abs(measured - simulated)
    row["largest_error"] = float(absolute_errors.max())
    return row


def kind_of_model(model: Model) -> str:
    """Kind of an identified model, such as `structured`, or else the name of its class."""
    for word in model.overrides:
        name, _, value = word.partition("=")
        if name == "model":
            return value
    return type(model.simulator).__name__
