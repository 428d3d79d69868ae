"""Model identification as an estimator in scikit-learn's conventions."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from ssm_study.api.arguments import Signals, Slopes, Values
from ssm_study.api.fitting import fit
from ssm_study.api.model import Model
from ssm_study.api.parts import refuse_dotted_name
from ssm_study.refusal import BadRequest, require


@dataclass(kw_only=True, eq=False)
class Estimator:
    """Model identification as an estimator in scikit-learn's conventions.

    The parameters are those of `fit`; `settings` are further fields of the model. A fold of a
    search begins in the middle of a motion, so the first `start_up_samples` of what is scored
    estimate the initial state and are not scored. Folds must be stretches of time: use
    `TimeSeriesSplit`, or `KFold` without shuffling. `model_` is the fitted `Model`, as `st.fit`
    returns it. So scikit-learn's `GridSearchCV` chooses settings, and `st.control` takes its
    result:

        grid = {"order": [2, 4]}
        search = GridSearchCV(st.Estimator(step_s=0.1, model="ssm"), grid, cv=TimeSeriesSplit(3))
        design = st.control(search.fit(u, y).best_estimator_.model_)

    >>> import numpy as np, ssm_study as st
    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.uniform(-3, 3, 100), 8)
    >>> y = np.zeros(801)
    >>> for k in range(800): y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    >>> estimator = st.Estimator(step_s=0.1, model="arx").set_params(seed=1)
    >>> estimator.fit(u[:600], y[:600]).score(u[600:], y[600:800]) > 95
    True
    """

    step_s: float | None = None
    model: str = "log"
    order: int | str | None = None
    neurons: int | None = None
    slopes: Slopes | None = None
    feedthrough: bool | str | None = None
    seed: int | None = None
    settings: Mapping[str, Any] | None = None
    overrides: tuple[str, ...] = ()
    start_up_samples: int = 20
    model_: Model = field(init=False, repr=False)

    def get_params(self, deep: bool = True) -> dict[str, Any]:  # noqa: ARG002
        """Settings of the estimator by name, in the form that scikit-learn requires. `deep` changes
        nothing, since no setting has settings of its own."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.init}

    def set_params(self, **parameters: Any) -> "Estimator":
        """Change settings of the estimator by name. Raises `BadRequest` for an unknown name."""
        names = self.get_params()
        for name, value in parameters.items():
            known_names = ", ".join(names)
            require(name in names, name, value, "is no parameter", f"use one of {known_names}")
            setattr(self, name, value)
        return self

    def fit(self, u: Signals, y: Signals, disturbance: Signals | None = None) -> "Estimator":
        """Identify the model from inputs and outputs. Raises `BadRequest` for all data that
        `st.fit` refuses."""
        settings = {} if self.settings is None else self.settings
        kind = type(settings).__name__
        is_mapping = isinstance(settings, Mapping) and all(isinstance(one, str) for one in settings)
        remedy = 'give names and values, as in {"hidden_width": 8}'
        require(is_mapping, "settings", kind, "are no settings by name", remedy)
        for name, value in settings.items():
            refuse_dotted_name("model", name, value, "in overrides, not in settings")
        self.model_ = fit(
            u,
            y,
            self.step_s,
            *self.overrides,
            disturbance=disturbance,
            model=self.model,
            order=self.order,
            neurons=self.neurons,
            slopes=self.slopes,
            feedthrough=self.feedthrough,
            seed=self.seed,
            progress=False,
            **settings,
        )
        return self

    def predict(self, u: Values, disturbance: Values | None = None) -> Values:
        """Simulate the outputs of the identified model from its equilibrium. Raises `BadRequest`
        before `fit`."""
        model = self._fitted_model()
        return model.predict(u, disturbance)

    def score(self, u: Values, y: Values, disturbance: Values | None = None) -> float:
        """Fit of the identified model on a record, in percent, with the initial state estimated
        from the first samples.

        Measured disturbances stay at their mean where they are not given. Raises `BadRequest`
        before `fit`, and for a record that is no longer than its start.
        """
        model = self._fitted_model()
        return model.score(u, y, disturbance, start_up_samples=self.start_up_samples)

    def _fitted_model(self) -> Model:
        """Identified model of a fitted estimator. Raises `BadRequest` before `fit`."""
        if not hasattr(self, "model_"):
            raise BadRequest("estimator", "Estimator", "is not fitted", "call fit(u, y) first")
        return self.model_

    def __sklearn_tags__(self) -> Any:
        """Tags by which scikit-learn recognises the estimator's abilities."""
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags

        target_tags = TargetTags(required=True, multi_output=True)
        return Tags(
            estimator_type="regressor",
            target_tags=target_tags,
            regressor_tags=RegressorTags(),
            input_tags=InputTags(),
        )
