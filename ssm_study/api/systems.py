"""Conversion of linear systems from python-control, SciPy or tuples of matrices."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.refusal import NO_NUMBERS, BadRequest, require
from ssm_study.systems import StateSpace

LARGEST_FLOAT = float(np.finfo(float).max)
FORMS = "give control.StateSpace, control.TransferFunction, or (A, B, C, D, step_s)"


def read_linear_system(system: Any) -> tuple[StateSpace, float]:
    """Read the matrices and the sampling time of a discrete-time linear system.

    Raises `BadRequest` for a continuous-time system and for any other object.
    """
    if isinstance(system, tuple):
        return _read_matrices(system)
    has_numerator = hasattr(system, "num")
    if has_numerator and hasattr(system, "den"):  # a transfer function
        system = _realise_transfer_function(system)
    matrices = [getattr(system, name, None) for name in "ABCD"]
    kind = type(system).__name__
    complete = all(matrix is not None for matrix in matrices)
    require(complete, "model", kind, "is no model and no linear system", FORMS)
    state_space = _build_state_space(matrices)
    period = getattr(system, "dt", None)
    return state_space, read_sampling_time(period)


def read_sampling_time(step_s: Any) -> float:
    """Check the sampling time of a discrete-time system and convert it to a number. Raises
    `BadRequest` for any other value."""
    is_real_number = isinstance(step_s, float | int)
    is_number = is_real_number and not isinstance(step_s, bool)
    discrete = is_number and 0 < step_s <= LARGEST_FLOAT
    remedy = "give the sampling period in seconds, as in control.StateSpace(A, B, C, D, 0.1)"
    if is_number and step_s == 0:  # python-control's word for continuous time
        remedy = "sample it: control.c2d(system, step_s)"
    require(discrete, "system.dt", step_s, "not a sampling time", remedy)
    return float(step_s)


def read_matrix(
    name: str, values: Any, shape: tuple[int | None, int | None]
) -> Float[np.ndarray, "r c"]:
    """Read a finite matrix and check its shape; None stands for a dimension of any size.

    Raises `BadRequest` that names the matrix, its shape and the one that fits.
    """
    entries = read_numbers(name, values, "is no matrix of numbers")
    matrix = np.atleast_2d(entries)
    is_table = matrix.ndim == 2
    sides = zip(matrix.shape, shape, strict=True) if is_table else ()
    fits = matrix.ndim == 2 and all(wanted_side in (None, side) for side, wanted_side in sides)
    needed = []
    for side, word in zip(shape, ("row", "column"), strict=True):
        if side is not None:
            plural = "" if side == 1 else "s"
            needed.append(f"{side} {word}{plural}")
    problem = f"must have {' and '.join(needed) or 'rows and columns'}"
    require(fits, f"{name} (shape)", matrix.shape, problem, "check the matrices")
    finite_entries = np.isfinite(matrix)
    finite = bool(finite_entries.all())
    require(finite, name, "NaN or infinity", "is not finite", "correct its entries")
    return matrix


def read_matrix_or_vector(
    name: str, values: Any, shape: tuple[int, int | None]
) -> Float[np.ndarray, "r c"]:
    """Read a finite matrix with a given number of rows; a vector is read as a single column."""
    numbers = read_numbers(name, values, "is no matrix of numbers")
    if numbers.shape == shape[:1]:
        numbers = numbers[:, None]
    return read_matrix(name, numbers, shape)


def read_numbers(
    name: str, values: Any, problem: str = "holds no numbers"
) -> Float[np.ndarray, "..."]:
    """Convert values to a new array of real numbers.

    Raises `BadRequest` for complex numbers, whose imaginary part NumPy would drop, for masked
    entries, and for values that are no numbers.
    """
    kind = type(values).__name__
    remedy = "give a NumPy array"
    try:
        raw = np.array(values)
        kind_of_number = raw.dtype.kind
        require(kind_of_number != "c", name, kind, "is complex", "give real numbers")
        is_masked = np.ma.is_masked(values)
        require(not is_masked, name, kind, "has masked entries", "fill them in")
        return np.asarray(raw, dtype=np.float64)
    except BadRequest:
        raise
    except NO_NUMBERS as error:
        raise BadRequest(name, kind, problem, remedy) from error


def read_slope_range(name: str, slopes: Any) -> tuple[float, float]:
    """Read the smallest and the largest slope of a static map from a pair of numbers. Raises
    `BadRequest` unless they are a pair of finite numbers."""
    pair = read_numbers(name, slopes)
    usable = pair.shape == (2,) and bool(np.isfinite(pair).all())
    remedy = "give (lowest, highest), as in (0.8, 1.2)"
    problem = "are no two numbers" if pair.shape != (2,) else "are not finite"
    require(usable, name, slopes, problem, remedy)
    lower = float(pair[0])
    upper = float(pair[1])
    return lower, upper


def read_positive_slope_range(name: str, slopes: Any) -> tuple[float, float]:
    """Read a range of positive slopes of a static map. Raises `BadRequest` with the reason for any
    other range, such as a descending pair or one with zero or negative slopes."""
    lower, upper = read_slope_range(name, slopes)
    swapped = f"give ({upper:g}, {lower:g})"
    require(lower <= upper, name, slopes, "are descending: the lowest comes first", swapped)
    problem = "are negative"
    require(upper >= 0, name, slopes, problem, "change the sign of B or C and of the slopes")
    problem = (
        "hold zero, so an input might have no effect, and no gain can then prove more than the "
        "system does without it"
    )
    require(lower > 0, name, slopes, problem, "give a positive lowest slope, as in (0.8, 1.2)")
    return lower, upper


def read_number(name: str, value: Any) -> float:
    """Read one finite number. Raises `BadRequest` for anything else."""
    numbers = read_numbers(name, value)
    is_single = numbers.size == 1
    is_one = is_single and bool(np.isfinite(numbers).all())
    require(is_one, name, value, "is no finite number", "give one number")
    flat = numbers.reshape(-1)
    return float(flat[0])


def read_channel_values(name: str, values: Any, channels: int) -> Float[np.ndarray, "m"]:
    """Read one finite number for each channel of a signal. Raises `BadRequest` for anything
    else."""
    checked_numbers = read_numbers(name, values)
    numbers = checked_numbers.reshape(-1)
    fits = len(numbers) == channels and bool(np.isfinite(numbers).all())
    problem = f"is not {channels} finite numbers, one for each input"
    require(fits, name, values, problem, "give the limits in the input's unit")
    return numbers


def read_path(name: str, folder: Any) -> Path:
    """Check that an argument is a path, and convert it to one. Raises `BadRequest` for any other
    value."""
    is_path_or_text = isinstance(folder, str | Path)
    is_path = is_path_or_text and "\0" not in str(folder)
    is_text = isinstance(folder, str)
    kind = folder if is_text else type(folder).__name__
    require(is_path, name, kind, "is no path", "give the name of a folder")
    return Path(folder)


def _read_matrices(system: tuple[Any, ...]) -> tuple[StateSpace, float]:
    """Read a linear system that is given as a tuple of matrices and sampling time, `(A, B, C, D,
    step_s)`."""
    require(len(system) == 5, "model", f"a tuple of {len(system)}", "is no linear system", FORMS)
    *matrices, step_s = system
    return _build_state_space(matrices), read_sampling_time(step_s)


def _build_state_space(matrices: list[Any]) -> StateSpace:
    """Build a state space from four matrices, after checking that their shapes fit together."""
    a = read_matrix("A", matrices[0], (None, None))
    n = len(a)
    require(a.size > 0, "A (shape)", a.shape, "there are no states to control", FORMS)
    a = read_matrix("A", a, (n, n))
    b = read_matrix_or_vector("B", matrices[1], (n, None))
    c = read_matrix("C", matrices[2], (None, n))
    d = read_matrix("D", matrices[3], (len(c), b.shape[1]))
    return StateSpace(a=a, b=b, c=c, d=d)


def _realise_transfer_function(transfer_function: Any) -> Any:
    """State-space realisation of a transfer function from python-control or SciPy. Raises
    `BadRequest` for complex coefficients, and if there is none."""
    kind = type(transfer_function).__name__
    try:
        import control as python_control
    except ImportError as error:
        remedy = "pip install 'ssm-study[export]'"
        raise BadRequest("model", kind, "python-control is not installed", remedy) from error
    polynomials = (transfer_function.num, transfer_function.den)
    is_complex = has_complex_numbers(polynomials)
    require(not is_complex, "model", kind, "has complex coefficients", "give real ones")
    try:
        if not isinstance(transfer_function, python_control.TransferFunction):  # SciPy's
            step_s = read_sampling_time(transfer_function.dt)
            transfer_function = python_control.tf(*polynomials, step_s)
        return python_control.tf2ss(transfer_function)
    except BadRequest:
        raise
    except (TypeError, ValueError, python_control.ControlMIMONotImplemented) as error:
        problem = f"has no realisation ({error})"
        raise BadRequest("model", kind, problem, FORMS) from error


def has_complex_numbers(values: Any) -> bool:
    """Whether nested sequences or arrays contain a complex number."""
    if isinstance(values, list | tuple):
        return any(map(has_complex_numbers, values))
    return np.iscomplexobj(values)
