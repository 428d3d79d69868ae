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
    found = re.findall(r"static const float controller_(\w+)\[\d+\] = \{([^}]*)\}", header)
    return {
        name: np.array([np.float32(number.strip().rstrip("f")) for number in text.split(",")])
        for name, text in found
    }


def slope_interval(tables: dict[str, np.ndarray]) -> tuple[Fraction, Fraction]:
    """Least and largest slope of the one-layer map of the header, between its break points."""
    names = ("s_in_w0", "s_in_b0", "s_in_low0", "s_in_high0", "s_in_w_out")
    weights, biases, low, high, outer = (
        [Fraction(float(value)) for value in tables[name]] for name in names
    )
    linear = Fraction(float(tables["s_in_linear"][0]))
    neurons = list(zip(weights, biases, low, high, outer, strict=True))
    points = sorted({-b / w for w, b, *_ in neurons if w})
    middles = [(left + right) / 2 for left, right in pairwise(points)]
    slopes = []
    for v in (points[0] - 1, *middles, points[-1] + 1):
        parts = [o * w * (up if w * v + b >= 0 else down) for w, b, down, up, o in neurons]
        slopes.append(linear + sum(parts))
    return min(slopes), max(slopes)


def holds(
    a: np.ndarray, b: np.ndarray, k: np.ndarray, ball: tuple[float, float], rate: float
) -> bool:
    """Whether `|beta K (z I - A_K / r)^-1 B / r| < 1` on the unit circle, `A_K / r` stable."""
    alpha, beta = ball
    r = np.sqrt(1 - rate)
    closed = (a + alpha * b @ k) / r
    eigenvalues = np.linalg.eigvals(closed)
    spectral_radius = np.abs(eigenvalues).max()
    if spectral_radius >= 1:
        return False
    z = np.exp(1j * np.linspace(0, np.pi, 20_001))
    difference = z[:, None, None] * np.eye(len(a)) - closed
    resolvent = np.linalg.solve(difference, b / r)
    largest = np.abs(beta * (k @ resolvent)).max()
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
    a = tables["a"].reshape(n, n).astype(float)
    b, c, k, gain = (tables[name].astype(float) for name in "bckl")
    least, largest = slope_interval(tables)
    ball = float((largest + least) / 2), float((largest - least) / 2)
    rate, observer_rate = map(float, claimed.groups())
    assert holds(a, b[:, None], k[None], ball, rate)
    assert not holds(a, b[:, None], k[None], ball, 1.05 * rate)
    assert holds(a.T, c[:, None], gain[None], (1.0, 0.0), observer_rate)
    assert not holds(a.T, c[:, None], gain[None], (1.0, 0.0), 1.05 * observer_rate)
