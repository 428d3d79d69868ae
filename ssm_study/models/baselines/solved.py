"""Baselines that libraries solve without gradient steps: N4SID (nfoursid) and polynomial NARX
(SysIdentPy)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from ssm_study.models.identified import SSM, Inputs, Outputs, Simulator
from ssm_study.models.spec import ModelSpec, Pairs, scaled
from ssm_study.refusal import BadRequest, at_least, require
from ssm_study.signals import DataSet, Scale
from ssm_study.systems import StateSpace

SLOWEST = 0.9999  # an unstable identified pole is scaled back to this radius, or a free run would overflow
INSTALL = {
    "nfoursid": 'pip install "ssm-study[baselines]"',
    "dynonet": 'pip install "ssm-study[baselines]"',
    "sysidentpy": "pip install --no-deps sysidentpy==0.9.0 (it asks for an older NumPy, and works with this one)",
}
OVERFLOW = 1e3  # scaled units: a free run beyond this has diverged and is held there


class SolvedSpec(ModelSpec, ABC):
    """A model found without training; `solve` returns its explicit numbers."""

    @abstractmethod
    def solve(self, data: DataSet) -> Simulator: ...

    def build(self, data: DataSet, seed: int) -> Any:  # noqa: ARG002
        raise TypeError("solved, which is a training of its own")


@dataclass(frozen=True, kw_only=True)
class N4SID(SolvedSpec):
    """Linear state space by subspace identification with `block_rows` block rows; an SSM without
    nonlinearity.

    A and C are N4SID's. Its D is left out, since the loop samples the output before the input acts,
    and B is fitted
    again without it. N4SID takes one record: several are joined end to end, and each joint is an
    error in A and C.
    """

    gives_ssm: ClassVar[bool] = True

    order: int
    block_rows: int

    def __post_init__(self) -> None:
        at_least(1, "model.order", self.order, "use 8 or so")
        fits = self.block_rows > self.order
        require(
            fits,
            "model.block_rows",
            self.block_rows,
            "must exceed the order",
            "use twice the order",
        )

    def solve(self, data: DataSet) -> SSM:
        nfoursid, pandas = library("nfoursid.nfoursid"), library("pandas")
        u, y = (np.concatenate(parts) for parts in zip(*scaled(data), strict=True))
        names = [f"u{i}" for i in range(u.shape[1])], [f"y{i}" for i in range(y.shape[1])]
        table = pandas.DataFrame(np.hstack([u, y]), columns=[*names[0], *names[1]])
        method = nfoursid.NFourSID(
            table, output_columns=names[1], input_columns=names[0], num_block_rows=self.block_rows
        )
        method.subspace_identification()
        found, _ = method.system_identification(rank=self.order)
        a = found.a * min(1.0, SLOWEST / float(np.abs(np.linalg.eigvals(found.a)).max()))
        b = input_matrix(a, found.c, scaled(data))
        return SSM.of(
            StateSpace(a=a, b=b, c=found.c, d=np.zeros_like(found.d)), data.step_s, data.scale
        )


def input_matrix(
    a: Float[np.ndarray, "n n"], c: Float[np.ndarray, "p n"], records: Pairs
) -> Float[np.ndarray, "n m"]:
    """`argmin over B and each record's x0 of sum |y - C x|^2,  x+ = A x + B u`: linear in both, so
    solved at once."""
    n, m, count = len(a), records[0][0].shape[1], len(records)
    each = StateSpace(a=a, b=np.eye(n), c=c, d=np.zeros((len(c), n)))
    rows, targets = [], []
    for i, (u, y) in enumerate(records):
        pushes = (
            np.eye(n)[:, None, None, :] * u.T[None, :, :, None]
        )  # (n, m, T, n): input j drives state i alone
        driven = each.simulate(pushes.reshape(n * m, len(u), n))[0].reshape(n * m, -1)
        free = each.simulate(np.zeros((n, len(u), n)), np.eye(n))[0].reshape(n, -1)
        starts = np.zeros((count, n, free.shape[1]))
        starts[i] = free
        rows.append(np.concatenate([driven, starts.reshape(count * n, -1)]).T)
        targets.append(y.reshape(-1))
    solved = np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets), rcond=None)[0]
    return solved[: n * m].reshape(n, m)


@dataclass(frozen=True, kw_only=True)
class Polynomial(Simulator, names=("narx",)):
    """`y[k] = sum_i theta_i prod_j factor_ij`; codes as in SysIdentPy: 1000 + l is `y[k-l]`, 2000 +
    l is `u[k-l]`."""

    codes: Int[np.ndarray, "terms degree"]
    theta: Float[np.ndarray, "terms"]
    scale: Scale

    def simulate(self, u: Inputs) -> Outputs:
        lags = int((self.codes % 1000).max())  # the longest delay among the terms
        v = np.pad(self.scale.scaled_input(u)[..., 0], [(0, 0)] * (u.ndim - 2) + [(lags, 0)])
        y = np.zeros_like(v)
        for k in range(lags, v.shape[-1]):
            past = {0: np.ones(v.shape[:-1])}
            past |= {1000 + i: y[..., k - i] for i in range(1, lags + 1)}
            past |= {2000 + i: v[..., k - i] for i in range(1, lags + 1)}
            terms = [np.prod([past[int(code)] for code in row], axis=0) for row in self.codes]
            y[..., k] = np.clip(np.tensordot(self.theta, np.stack(terms), 1), -OVERFLOW, OVERFLOW)
        return self.scale.physical_output(y[..., lags:, None])


@dataclass(frozen=True, kw_only=True)
class NARX(SolvedSpec):
    """Polynomial NARX of `degree` with `lags` past inputs and outputs; `terms` chosen by forward
    regression (FROLS)."""

    sizes: ClassVar = ("lags", "degree", "terms")

    lags: int
    degree: int
    terms: int

    def solve(self, data: DataSet) -> Polynomial:
        channels = (data.scale.inputs, data.scale.outputs)
        require(
            channels == (1, 1),
            "model",
            "NARX",
            "takes one input and one output",
            "choose another model",
        )
        frols, basis = (
            library("sysidentpy.model_structure_selection"),
            library("sysidentpy.basis_function"),
        )
        u, y = (np.concatenate(parts) for parts in zip(*scaled(data), strict=True))
        polynomial, lags = (
            basis.Polynomial(degree=self.degree),
            {"ylag": self.lags, "xlag": self.lags},
        )
        method = frols.FROLS(
            order_selection=False, n_terms=self.terms, basis_function=polynomial, **lags
        )
        own, first = own_rows([len(record) for record in data.training], self.lags), y[: self.lags]

        def of_records(
            psi: Any, y: Any, count: int
        ) -> tuple[Any, ...]:  # what FROLS calls with all rows
            target = y[self.lags :][own]
            return *method.error_reduction_ratio(
                psi[own], np.concatenate([first, target]), count
            ), target

        method.run_mss_algorithm = of_records
        method.fit(X=u, y=y)
        codes, theta = (
            np.asarray(method.final_model, dtype=np.int64),
            np.asarray(method.theta, dtype=float).ravel(),
        )
        return Polynomial(codes=codes, theta=theta, scale=data.scale)


def own_rows(lengths: Sequence[int], lags: int) -> Bool[np.ndarray, "rows"]:
    """Which samples from number `lags` on, of all records in a row, have their `lags` past samples
    in one record."""
    within = np.concatenate([np.arange(length) for length in lengths])
    return within[lags:] >= lags


def library(name: str) -> Any:
    """An optional package; raises `BadRequest` with what to install where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        package, problem = name.split(".")[0], "this baseline needs a package that is not installed"
        remedy = INSTALL.get(package, f"pip install {package}")
        raise BadRequest("model", package, problem, remedy) from error
