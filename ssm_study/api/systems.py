"""Conversion of linear systems from python-control, SciPy or tuples of matrices."""

from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import BadRequest, require
from ssm_study.systems import StateSpace

FORMS = "give control.StateSpace, control.TransferFunction, or (A, B, C, D, step_s)"


def read_linear_system(system: Any) -> tuple[StateSpace, float]:
    """Read the matrices and the sampling time of a discrete-time linear system.

    Raises `BadRequest` for a continuous-time system and for what is no such system.
    """
    if isinstance(system, tuple):
        return _read_matrices(system)
    if hasattr(system, "num") and hasattr(system, "den"):  # a transfer function
        system = _realise_transfer_function(system)
    matrices = [getattr(system, name, None) for name in "ABCD"]
    kind = type(system).__name__
    complete = all(matrix is not None for matrix in matrices)
    require(complete, "model", kind, "is no model and no linear system", FORMS)
    return _build_state_space(matrices), read_sampling_time(getattr(system, "dt", None))


def read_sampling_time(step_s: Any) -> float:
    """Check the sampling time of a discrete-time system and convert it to a number. Raises
    `BadRequest` for any other value."""
    is_number = isinstance(step_s, float | int) and not isinstance(step_s, bool)
    discrete = is_number and 0 < float(step_s) < np.inf
    remedy = "give the sampling period: control.StateSpace(P.A, P.B, P.C, P.D, step_s)"
    if is_number and float(step_s) == 0:  # python-control's word for continuous time
        remedy = "sample it: control.c2d(system, step_s)"
    require(discrete, "system.dt", step_s, "not a sampling time", remedy)
    return float(step_s)


def read_matrix(
    name: str, values: Any, shape: tuple[int | None, int | None]
) -> Float[np.ndarray, "r c"]:
    """Read a finite matrix and check its shape; None stands for a dimension of any size.

    Raises `BadRequest` that names the matrix, its shape and the one that fits.
    """
    matrix = np.atleast_2d(read_numbers(name, values, "is no matrix of numbers"))
    sides = zip(matrix.shape, shape, strict=True) if matrix.ndim == 2 else ()
    fits = matrix.ndim == 2 and all(wanted in (None, side) for side, wanted in sides)
    wanted = " by ".join("any" if side is None else str(side) for side in shape)
    require(fits, f"{name} (shape)", matrix.shape, f"is to be {wanted}", "check the matrices")
    finite = bool(np.isfinite(matrix).all())
    require(finite, name, "NaN or infinity", "is not finite", "correct its entries")
    return matrix


def read_numbers(
    name: str, values: Any, problem: str = "holds no numbers"
) -> Float[np.ndarray, "..."]:
    """Convert values to a new array of real numbers.

    Raises `BadRequest` for complex numbers, whose imaginary part NumPy would drop, for masked
    entries, and for what holds no numbers.
    """
    kind = type(values).__name__
    remedy = "give a NumPy array"
    try:
        raw = np.array(values)
        require(raw.dtype.kind != "c", name, kind, "is complex", "give real numbers")
        require(not np.ma.is_masked(values), name, kind, "has masked entries", "fill them in")
        return np.asarray(raw, dtype=np.float64)
    except (TypeError, ValueError) as error:
        if isinstance(error, BadRequest):
            raise
        raise BadRequest(name, kind, problem, remedy) from error


def _read_matrices(system: tuple[Any, ...]) -> tuple[StateSpace, float]:
    """Read a linear system that is given as (A, B, C, D, step_s)."""
    require(len(system) == 5, "model", f"a tuple of {len(system)}", "is no linear system", FORMS)
    *matrices, step_s = system
    return _build_state_space(matrices), read_sampling_time(step_s)


def _build_state_space(matrices: list[Any]) -> StateSpace:
    """Build a state space from four matrices, after checking that their shapes fit together."""
    a = read_matrix("A", matrices[0], (None, None))
    n = len(a)
    a = read_matrix("A", a, (n, n))
    b = read_matrix("B", matrices[1], (n, None))
    c = read_matrix("C", matrices[2], (None, n))
    d = read_matrix("D", matrices[3], (len(c), b.shape[1]))
    return StateSpace(a=a, b=b, c=c, d=d)


def _realise_transfer_function(transfer_function: Any) -> Any:
    """State-space realisation of a transfer function, by python-control."""
    try:
        from control import tf2ss
    except ImportError as error:
        kind = type(transfer_function).__name__
        remedy = "pip install 'ssm-study[export]'"
        raise BadRequest("model", kind, "python-control is not installed", remedy) from error
    return tf2ss(transfer_function)
