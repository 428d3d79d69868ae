"""The rates that the header of the float code claims, decided again from its text alone.

Nothing of the package computes here: the tables are read as 32-bit floats, the slopes of S_u follow
from its break points in rational numbers, and the rate from the small-gain condition at many
frequencies (docs/theory.md, "The gains that are deployed").
"""

import re
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np

from ssm_study.export.targets import write_controller


def tables_of(header: str) -> dict[str, np.ndarray]:
    """The constants of the C code, as the floats that a compiler reads."""
    constants = re.findall(r"static const float controller_(\w+)\[\d+\] = \{([^}]*)\}", header)
    tables = {}
    for name, text in constants:
        numbers = [number.strip().rstrip("f") for number in text.split(",")]
        tables[name] = np.array([np.float32(number) for number in numbers])
    return tables


def slope_interval(tables: dict[str, np.ndarray]) -> tuple[Fraction, Fraction]:
    """Least and largest slope of the one-layer map of the header, between its break points."""
    names = ("s_in_w0", "s_in_b0", "s_in_low0", "s_in_high0", "s_in_w_out")
    columns = []
    for name in names:
        fractions = [Fraction(float(value)) for value in tables[name]]
        columns.append(fractions)
    direct_path = tables["s_in_linear"][0]
    linear = Fraction(float(direct_path))
    weights, biases, *_ = columns
    neurons = list(zip(*columns, strict=True))
    kinks = {-b / w for w, b in zip(weights, biases, strict=True) if w}
    points = sorted(kinks)
    middles = [(left + right) / 2 for left, right in pairwise(points)]
    slopes = []
    first = points[0] - 1
    last = points[-1] + 1
    for v in (first, *middles, last):
        slope = linear
        for w, b, down, up, o in neurons:
            neuron_slope = up if w * v + b >= 0 else down
            slope += o * w * neuron_slope
        slopes.append(slope)
    return min(slopes), max(slopes)


def holds(
    a: np.ndarray, b: np.ndarray, k: np.ndarray, ball: tuple[float, float], rate: float
) -> bool:
    """Whether `|beta K (z I - A_K / r)^-1 B / r| < 1` on the unit circle, `A_K / r` stable."""
    alpha, beta = ball
    r = np.sqrt(1 - rate)
    centre_gain = alpha * b @ k
    closed = (a + centre_gain) / r
    eigenvalues = np.linalg.eigvals(closed)
    sizes = np.abs(eigenvalues)
    spectral_radius = sizes.max()
    if spectral_radius >= 1:
        return False
    angles = np.linspace(0, np.pi, 20_001)
    exponents = 1j * angles
    z = np.exp(exponents)
    points = z[:, None, None]
    identity = np.eye(len(a))
    difference = points * identity - closed
    resolvent = np.linalg.solve(difference, b / r)
    response = beta * (k @ resolvent)
    gains = np.abs(response)
    largest = gains.max()
    return bool(largest < 1)


def test_the_rates_of_the_float_code_hold_for_the_numbers_in_its_header(
    smoke_run: Path, tmp_path: Path
) -> None:
    write_controller(smoke_run, tmp_path / "c", real="float")
    controller_path = tmp_path / "c" / "controller.h"
    header = controller_path.read_text()
    claimed = re.search(r"in float: state feedback ([\d.]+), observer ([\d.]+)\.", header)
    assert claimed is not None
    tables = tables_of(header)
    n = len(tables["b"])
    square = tables["a"].reshape(n, n)
    a = square.astype(float)
    b, c, k, gain = (tables[name].astype(float) for name in "bckl")
    least, largest = slope_interval(tables)
    centre = float((largest + least) / 2)
    radius = float((largest - least) / 2)
    ball = (centre, radius)
    rates = claimed.groups()
    rate, observer_rate = map(float, rates)
    input_column = b[:, None]
    feedback_row = k[None]
    assert holds(a, input_column, feedback_row, ball, rate)
    faster = 1.05 * rate
    assert not holds(a, input_column, feedback_row, ball, faster)
    output_column = c[:, None]
    injection_row = gain[None]
    point = (1.0, 0.0)
    assert holds(a.T, output_column, injection_row, point, observer_rate)
    faster = 1.05 * observer_rate
    assert not holds(a.T, output_column, injection_row, point, faster)
