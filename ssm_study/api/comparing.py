"""Compare models on one record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.api.model import Model, Values
from ssm_study.data.arrays import signal
from ssm_study.refusal import require
from ssm_study.signals import fit_percent, rmse


@dataclass(frozen=True, kw_only=True, repr=False)
class ModelComparison:
    """Free runs of several models on one record, and their scores.

    `table` has one row per model: fit in percent of each output and in total, root mean square
    error in the output's unit, largest error, states. `simulated` holds the outputs by name.
    """

    table: pd.DataFrame
    measured: Float[np.ndarray, "T p"]
    simulated: dict[str, Float[np.ndarray, "T p"]]
    time_s: Float[np.ndarray, "T"]
    output_names: list[str]

    def __repr__(self) -> str:
        return self.table.to_string(float_format=lambda value: f"{value:.4g}")

    def _repr_html_(self) -> str:
        text: str = self.table.to_html(float_format=lambda value: escape(f"{value:.4g}"))
        return text

    def plot(self) -> Any:
        """Draw measured and simulated outputs, residuals below. Returns the Matplotlib figure."""
        from ssm_study.api.plots import plot_overlay

        return plot_overlay(self)


def compare(models: Sequence[Model] | Mapping[str, Model], u: Values, y: Values) -> ModelComparison:
    """Simulate models on one record, from rest, and score them.

    `models` is a list, or a mapping from names to models. Best fit first. Raises `BadRequest` for
    no models, and where a model has other channels than the record.

    >>> import numpy as np, ssm_study as st
    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.uniform(-3, 3, 100), 8)
    >>> y = np.zeros(801)
    >>> for k in range(800): y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    >>> model = st.fit(u, y[:800], 0.1, model="linear", order=1, progress=False)
    >>> bool(st.compare({"linear": model}, u, y[:800]).table.loc["linear", "fit_percent"] > 95)
    True
    """
    named = dict(models) if isinstance(models, Mapping) else _name_models(models)
    require(bool(named), "models", "none", "there is nothing to compare", "give a list of models")
    measured = signal(y, "y")[1]
    simulated = {}
    rows = {}
    for name, model in named.items():
        output = signal(model.predict(u), "y")[1]
        problem = f"{name} answers with {output.shape}"
        remedy = "give the outputs of this input"
        require(output.shape == measured.shape, "y", measured.shape, problem, remedy)
        simulated[name] = output
        rows[name] = _score_row(model, measured, output)
    table = pd.DataFrame.from_dict(rows, orient="index").sort_values("fit_percent", ascending=False)
    table.index.name = "model"
    first = next(iter(named.values()))
    time_s = np.arange(len(measured)) * first.data.step_s
    return ModelComparison(
        table=table,
        measured=measured,
        simulated=simulated,
        time_s=time_s,
        output_names=first.output_names,
    )


def _name_models(models: Sequence[Model]) -> dict[str, Model]:
    """Models by the name of their class, numbered where several share one."""
    kinds = [type(model.simulator).__name__ for model in models]
    names = []
    for i, kind in enumerate(kinds):
        is_unique = kinds.count(kind) == 1
        names.append(kind if is_unique else f"{kind} {kinds[: i + 1].count(kind)}")
    return dict(zip(names, models, strict=True))


def _score_row(
    model: Model, measured: Float[np.ndarray, "T p"], simulated: Float[np.ndarray, "T p"]
) -> dict[str, Any]:
    """Scores of one model on a record."""
    row: dict[str, Any] = {"fit_percent": fit_percent(measured, simulated)}
    if measured.shape[1] > 1:
        for j, name in enumerate(model.output_names):
            column = slice(j, j + 1)
            row[f"fit_percent of {name}"] = fit_percent(measured[:, column], simulated[:, column])
    row["rmse"] = rmse(measured, simulated)
    row["largest_error"] = float(np.abs(measured - simulated).max())
    row["states"] = getattr(model.simulator, "order", None)
    return row
