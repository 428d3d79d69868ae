"""Linear models at the equilibrium: python-control systems and frequency responses."""

from numbers import Integral
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ssm_study.models.identified import SSM
from ssm_study.models.structured import StructuredSSM, linearise_at_equilibrium
from ssm_study.refusal import BadRequest, require

if TYPE_CHECKING:
    import control as python_control


def import_python_control(function: str) -> Any:
    """Import the package python-control, which is optional. Raises `BadRequest` where it is not
    installed."""
    try:
        import control
    except ImportError as error:
        remedy = "pip install 'ssm-study[export]'"
        raise BadRequest(function, "control", "is not installed", remedy) from error
    return control


def linearise_model(model: SSM | StructuredSSM) -> "python_control.StateSpace":
    """Linearise a model at its equilibrium, as a state space in physical units.

    `x+ = A x + B J_u u/s_u,  y = s_y J_y (C x + D J_u u/s_u)`, neurons by their slopes at rest
    within A, B, C, D.
    """
    python_control = import_python_control("to_control")
    linear = linearise_at_equilibrium(model)
    zero_input = np.zeros(model.scaffold_in.inputs)
    input_slope = model.scaffold_in.jacobian(zero_input)
    zero_output = np.zeros(model.scaffold_out.inputs)
    output_slope = model.scaffold_out.jacobian(zero_output)
    inward = input_slope / model.scale.input_scale
    output_scale = model.scale.output_scale
    outward = output_scale[:, None] * output_slope
    b = linear.b @ inward
    c = outward @ linear.c
    d = outward @ linear.d @ inward
    return python_control.StateSpace(linear.a, b, c, d, model.step_s)


def convert_to_continuous(discrete: "python_control.StateSpace") -> "python_control.StateSpace":
    """Convert a discrete-time system, whose input is held between samples, to continuous time. It
    takes the matrix logarithm of `[A B; 0 I]`.

    Raises `BadRequest` where a pole lies on the negative real axis or at zero.
    """
    import scipy

    python_control = import_python_control("to_continuous")
    poles = np.linalg.eigvals(discrete.A)
    is_not_positive = poles.real <= 0
    is_real = np.abs(poles.imag) < 1e-12
    on_axis = is_not_positive & is_real
    problem = (
        f"has a pole at {poles[on_axis][0].real:.3g}, which no continuous system gives"
        if on_axis.any()
        else ""
    )
    remedy = "use the discrete system, to_control()"
    has_pole_on_axis = on_axis.any()
    require(not has_pole_on_axis, "model", "linearised", problem, remedy)
    n, m = discrete.B.shape
    state_rows = [discrete.A, discrete.B]
    input_rows = [np.zeros((m, n)), np.eye(m)]
    exponential = np.block([state_rows, input_rows])
    complex_logarithm = scipy.linalg.logm(exponential)
    logarithm = np.real(complex_logarithm) / discrete.dt
    a = logarithm[:n, :n]
    b = logarithm[:n, n:]
    return python_control.StateSpace(a, b, discrete.C, discrete.D)


def tabulate_frequency_response(
    system: "python_control.StateSpace", inputs: list[str], outputs: list[str], points: int
) -> pd.DataFrame:
    """Table of a linear system's frequency response from each input to each output, up to half the
    sampling rate."""
    is_integer = isinstance(points, Integral)
    is_count = is_integer and not isinstance(points, bool) and points >= 1
    problem = "is no number of frequencies, which is a whole number from 1"
    require(is_count, "points", points, problem, "use 200")
    nyquist = np.pi / system.dt
    omega = np.geomspace(nyquist * 1e-4, nyquist, points)
    exponent = 1j * omega * system.dt
    z = np.exp(exponent)
    states = len(system.A)
    identity = np.eye(states)
    points_on_circle = z[:, None, None]
    scaled_identity = points_on_circle * identity
    resolvent = np.linalg.inv(scaled_identity - system.A)
    state_to_output = system.C @ resolvent
    response = state_to_output @ system.B + system.D
    tables = []
    for i, output in enumerate(outputs):
        for j, name in enumerate(inputs):
            channel = response[:, i, j]
            columns = {"input": name, "output": output, "frequency_rad_s": omega}
            table = pd.DataFrame(columns)
            table["magnitude"] = np.abs(channel)
            phase_rad = np.unwrap(np.angle(channel))
            table["phase_deg"] = np.rad2deg(phase_rad)
            tables.append(table)
    return pd.concat(tables, ignore_index=True)
