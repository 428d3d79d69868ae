"""Settings of models that are solved without iterative training in torch: N4SID, ARX, NARX and
output error."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ssm_study.models.baselines.regression import (
    NarxModel,
    fit_arx,
    fit_narx_models,
    fit_output_error,
)
from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.initial_system import Pairs
from ssm_study.models.spec import ModelSpec, scale_records
from ssm_study.refusal import BadRequest, require, require_at_least
from ssm_study.signals import DataSet
from ssm_study.systems import StateSpace

# an unstable identified pole is scaled back to this radius, or a free run would overflow
SLOWEST = 0.9999
MODELS = {"nfoursid": "n4sid"}  # by the package that they need
INSTALL = {"nfoursid": 'pip install "ssm-study[baselines]"'}
MOST_TERMS = 20


class SolvedSpec(ModelSpec, ABC):
    """Base class of settings of models that are fitted by direct computation instead of gradient
    training. `fit_model` returns the fitted model."""

    @abstractmethod
    def fit_model(self, data: DataSet) -> Simulator:
        """Fit a model to the training records by direct computation."""

    def build(self, data: DataSet, seed: int) -> Any:  # noqa: ARG002
        """Raise an error, because a model that is fitted by direct computation has no trainable
        form in torch."""
        raise TypeError("this model has a training of its own: it is solved for, without torch")


@dataclass(frozen=True, kw_only=True)
class N4SID(SolvedSpec):
    """Settings of subspace identification of a linear state-space model by N4SID. The result is an
    SSM without nonlinearity.

    A and C are N4SID's. Its D is left out, since the loop samples the output before the input acts,
    and B is fitted again without it. N4SID takes one record: several are joined end to end, and
    each joint is an error in A and C.
    """

    gives_ssm: ClassVar[bool] = True

    order: int
    block_rows: int

    def __post_init__(self) -> None:
        require_at_least(1, "model.order", self.order, "use 8 or so")
        rows = self.block_rows
        problem = "must exceed the order"
        has_enough_rows = rows > self.order
        require(has_enough_rows, "model.block_rows", rows, problem, "use twice the order")

    def fit_model(self, data: DataSet) -> SSM:
        """Identify a linear state-space model from the training records by the subspace method
        N4SID."""
        nfoursid = import_library("nfoursid.nfoursid")
        pandas = import_library("pandas")
        scaled_records = scale_records(data)
        u, y = (np.concatenate(parts) for parts in zip(*scaled_records, strict=True))
        input_count = u.shape[1]
        inputs = [f"u{i}" for i in range(input_count)]
        output_count = y.shape[1]
        outputs = [f"y{i}" for i in range(output_count)]
        signals = np.hstack([u, y])
        names = [*inputs, *outputs]
        table = pandas.DataFrame(signals, columns=names)
        columns = {"output_columns": outputs, "input_columns": inputs}
        method = nfoursid.NFourSID(table, num_block_rows=self.block_rows, **columns)
        method.subspace_identification()
        identified, _ = method.system_identification(rank=self.order)
        eigenvalues = np.linalg.eigvals(identified.a)
        moduli = np.abs(eigenvalues)
        radius = float(moduli.max())
        shrinkage = min(1.0, SLOWEST / radius)
        a = identified.a * shrinkage
        records = scale_records(data)
        b = estimate_input_matrix(a, identified.c, records)
        no_feedthrough = np.zeros_like(identified.d)
        system = StateSpace(a=a, b=b, c=identified.c, d=no_feedthrough)
        return SSM.from_linear(system, data.step_s, data.scale)


def estimate_input_matrix(
    a: Float[np.ndarray, "n n"], c: Float[np.ndarray, "p n"], records: Pairs
) -> Float[np.ndarray, "n m"]:
    """Estimate the input matrix B of a linear state-space model with given A and C, by least
    squares. `argmin over B and each record's x0 of sum |y - C x|^2, x+ = A x + B u`: linear in
    both, so solved at once."""
    n = len(a)
    first_inputs = records[0][0]
    m = first_inputs.shape[1]
    count = len(records)
    every_state = np.eye(n)
    output_count = len(c)
    each = StateSpace(a=a, b=every_state, c=c, d=np.zeros((output_count, n)))
    rows = []
    targets = []
    for i, (u, y) in enumerate(records):
        samples = len(u)
        # (n, m, T, n): input j drives state i alone
        inputs_by_state = u.T[None, :, :, None]
        pushes = np.eye(n)[:, None, None, :] * inputs_by_state
        flat_pushes = pushes.reshape(n * m, samples, n)
        by_push, _ = each.simulate(flat_pushes)
        no_input_shape = (n, samples, n)
        every_start = np.eye(n)
        by_start, _ = each.simulate(np.zeros(no_input_shape), every_start)
        driven = by_push.reshape(n * m, -1)
        free = by_start.reshape(n, -1)
        free_width = free.shape[1]
        starts = np.zeros((count, n, free_width))
        starts[i] = free
        flat_starts = starts.reshape(count * n, -1)
        columns = np.concatenate([driven, flat_starts])
        rows.append(columns.T)
        targets.append(y.reshape(-1))
    all_rows = np.concatenate(rows)
    all_targets = np.concatenate(targets)
    solution = np.linalg.lstsq(all_rows, all_targets, rcond=None)
    solved = solution[0]
    input_entries = solved[: n * m]
    return input_entries.reshape(n, m)


@dataclass(frozen=True, kw_only=True)
class NARX(SolvedSpec):
    """Settings of a polynomial NARX model, which is linear ARX for degree one. `terms` of them are
    chosen by forward regression. Of degree one with every term it is ARX; then `terms` may be
    null."""

    sizes: ClassVar = ("lags", "degree")

    lags: int
    degree: int
    terms: int | None = None
    delay: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(0, "model.delay", self.delay, "use 1, or 0 where the input acts at once")
        if self.terms is not None:
            require_at_least(1, "model.terms", self.terms, "use 12 or so, or null for all")

    def fit_model(self, data: DataSet) -> NarxModel:
        """Fit a polynomial NARX model to the training records by forward regression."""
        _refuse_several_outputs(data, "NARX")
        _refuse_short_records(data, self.lags + self.delay)
        if self.degree == 1 and self.terms is None:
            return fit_arx(data, self.lags, self.delay)
        count = MOST_TERMS if self.terms is None else self.terms
        models = fit_narx_models(data, self.lags, self.degree, self.delay, [count])
        return next(models)


@dataclass(frozen=True, kw_only=True)
class OutputError(SolvedSpec):
    """Settings of a linear output-error model of given order. Its free run, not its one-step
    prediction, has the least error."""

    sizes: ClassVar = ("order",)

    order: int
    delay: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(0, "model.delay", self.delay, "use 1, or 0 where the input acts at once")

    def fit_model(self, data: DataSet) -> NarxModel:
        """Fit a linear output-error model to the training records by the Levenberg-Marquardt
        method."""
        _refuse_several_outputs(data, "OutputError")
        _refuse_short_records(data, self.order + self.delay)
        return fit_output_error(data, self.order, self.delay)


def _refuse_several_outputs(data: DataSet, model: str) -> None:
    """Raise `BadRequest` for data with several outputs and a model structure that can have only
    one."""
    problem = f"takes one output, and there are {data.scale.outputs}"
    output_count = data.scale.outputs
    require(output_count == 1, "model", model, problem, "choose another model")


def _refuse_short_records(data: DataSet, lags: int) -> None:
    """Raise `BadRequest` for training records that have fewer samples than the model needs past
    values."""
    lengths = (len(record) for record in data.training)
    longest = max(lengths)
    problem = f"the longest training record has {longest} samples"
    require(lags < longest, "model.lags", lags, problem, "use fewer lags")


def import_library(name: str) -> Any:
    """Import an optional Python package, or raise `BadRequest` that says what to install."""
    try:
        return import_module(name)
    except ImportError as error:
        package = name.split(".")[0]
        problem = f"needs the package {package}, which is not installed"
        remedy = INSTALL.get(package, f"pip install {package}")
        model = MODELS.get(package, package)
        raise BadRequest("model", model, problem, remedy) from error
