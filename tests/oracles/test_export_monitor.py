"""Monitor in the exported C: the sum that it keeps, by a route of its own; what it promises for any
plant; plants that it must and must not flag."""

import itertools
import subprocess
from pathlib import Path

import numpy as np
import pytest
from export_cases import compiled, products
from test_coverage import BALLS, MODEL, design, premise, scaled_model

from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.export.c import render_c_files
from ssm_study.export.c_monitor import Monitor, free_decay_energy
from ssm_study.export.device import Device
from ssm_study.export.portable import convert_controller
from ssm_study.models.identified import SSM
from ssm_study.robustness.coverage import running_constraint_sum
from ssm_study.synthesis.measured_discs_run import add_coverage_certificate, certificate_weights

SAMPLES = 600
BELOW_ALL = np.array([-np.inf])
ABOVE_ALL = np.array([np.inf])
UNLIMITED = (BELOW_ALL, ABOVE_ALL)
MAIN = """#include <stdio.h>
#include "controller.h"
int main(void) {
    controller_state state;
    double y[1], u[1];
    controller_reset(&state);
    while (scanf("%lf %lf", &y[0], &u[0]) == 2) {
        controller_advance(&state, y, u);
        printf("%.17g %d ", state.excess, state.flag);
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def covered() -> tuple[SSM, Design]:
    model = SSM.from_linear(MODEL, 0.01)
    records = premise(scaled_model(0.4), noise=0.01)
    return model, add_coverage_certificate(design(), model, BALLS, records)


@pytest.fixture(scope="module")
def monitor(covered: tuple[SSM, Design]) -> Monitor:
    made = Monitor.for_design(*covered)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def device(covered: tuple[SSM, Design]) -> Device:
    return Device.from_controller(convert_controller(*covered), "double", *UNLIMITED)


@pytest.fixture(scope="module")
def watched(device: Device, monitor: Monitor, tmp_path_factory: pytest.TempPathFactory):
    """Sum and flag of the C code at each sample, for outputs and applied inputs."""
    folder = tmp_path_factory.mktemp("monitor")
    for file, text in render_c_files(device, origin_text="test", monitor=monitor).items():
        (folder / file).write_text(text)
    (folder / "main.c").write_text(MAIN)
    compiled(folder, "-std=c99", "-DMONITOR")  # the replay is what it is without

    words = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-DMONITOR"]
    subprocess.run(["gcc", *words, "main.c", "-o", "main"], cwd=folder, check=True)

    def watch(y: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        samples = [f"{a!r} {b!r}" for a, b in zip(y.tolist(), u.tolist(), strict=True)]
        text = " ".join(samples)
        program = [folder / "main"]
        done = subprocess.run(program, input=text, capture_output=True, text=True, check=True)
        numbers = np.array(done.stdout.split(), dtype=float)
        table = numbers.reshape(-1, 2)
        flags = table[:, 1].astype(bool)
        return table[:, 0], flags

    return watch


def part_of(made: Design) -> MeasuredDiscs:
    part = made.extra_certificates[MeasuredDiscs.part]
    assert isinstance(part, MeasuredDiscs)
    return part


def loop(made: Design, plant, start: float, samples: int = SAMPLES) -> tuple[np.ndarray, ...]:
    """The loop on `y = plant(m, k)` with m from the model's state, the estimate from rest: y, u, m,
    and the states of model and estimate."""
    gains = made.gains
    identity = np.eye(2)
    x = np.linalg.solve(identity - MODEL.a, MODEL.b)[:, 0]
    output = float((MODEL.c @ x)[0])
    x *= start / output
    xh = np.zeros(2)
    rows = []
    for k in range(samples):
        u = float((gains["k"] @ xh)[0])
        m = float((MODEL.c @ x)[0])
        y = plant(m, k)
        rows.append((y, u, m, *x, *xh))
        injected = MODEL.c @ xh - y
        model_input = MODEL.b[:, 0] * u
        x = MODEL.a @ x + model_input
        predicted = MODEL.a @ xh + MODEL.b[:, 0] * u
        xh = predicted + gains["l"] @ injected
    table = np.array(rows)
    return table[:, 0], table[:, 1], table[:, 2], table[:, 3:]


def test_the_sum_is_the_running_sum_of_the_premise_that_never_falls_below_zero(
    covered: tuple[SSM, Design], monitor: Monitor, watched
) -> None:
    part = part_of(covered[1])
    rng = np.random.default_rng(0)
    levels = rng.uniform(-1, 1, SAMPLES // 20)
    y = np.repeat(levels, 20)
    y[0] = 0.5
    u = rng.uniform(-1, 1, SAMPLES)
    m = MODEL.simulate(u[:, None])[0]
    e = y[:, None] - m
    weights = certificate_weights(part)
    whole = running_constraint_sum(weights, part.centre, part.kappa, u[:, None], m, e)
    added = np.diff(whole, prepend=0.0) - monitor.allowance
    expected = np.zeros(SAMPLES)
    last = 0.0
    for k, more in enumerate(added):
        last = max(last + more, 0.0)
        expected[k] = last
    sums, flags = watched(y, u)
    np.testing.assert_allclose(sums, expected, rtol=1e-9, atol=1e-12)
    limit = monitor.sum_limit(y[:1])
    assert expected.max() > limit > monitor.limit > 0
    assert flags[-1]
    largest_so_far = np.maximum.accumulate(expected)
    np.testing.assert_array_equal(flags, largest_so_far > limit)


@pytest.mark.parametrize("seed", range(3))
def test_the_sum_bounds_the_energy_of_any_plant(covered: tuple[SSM, Design], seed: int) -> None:
    """The plant is a stream of random numbers; the stored P is the witness: `xi' P xi` is at most
    that at the start and the sum, at every sample."""
    part = part_of(covered[1])
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(SAMPLES).cumsum() / 10
    y, u, m, states = loop(covered[1], lambda m, k: rng.uniform(-1, 2) * m + noise[k], 0.0)
    e = (y - m)[:, None]
    signals = (u[:, None], m[:, None], e)
    weights = certificate_weights(part)
    sums = running_constraint_sum(weights, part.centre, part.kappa, *signals)
    estimation_error = states[:, 2:] - states[:, :2]
    xi = np.hstack([states[:, :2], estimation_error])
    of_output = filter_states(part.weight_output, m)
    of_input = filter_states(part.weight_input, u)
    filtered = np.hstack([of_output, of_input])
    xi = np.hstack([xi, filtered])
    energies = np.einsum("ti,ij,tj->t", xi, part.p, xi)
    allowed = energies[0] + sums[:-1] + 1e-9
    assert (energies[1:] <= allowed).all()
    assert energies.max() > 1e-3


def filter_states(weight: np.ndarray, signal: np.ndarray) -> np.ndarray:
    order = len(weight) - 1
    states = np.zeros((len(signal), order))
    for k in range(len(signal) - 1):
        kept_state = weight[:order, :order] @ states[k]
        states[k + 1] = kept_state + weight[:order, -1] * signal[k]
    return states


def test_a_plant_of_the_records_raises_no_flag(covered: tuple[SSM, Design], watched) -> None:
    rng = np.random.default_rng(1)
    cases = itertools.product((-0.5, 0.2, 0.5), (0.7, 1.4, 3.0))
    for start, share in cases:
        noise = 0.01 * rng.standard_normal(SAMPLES)

        def plant(m: float, k: int, share: float = share, noise: np.ndarray = noise) -> float:
            return share * m + noise[k]

        y, u, _, _ = loop(covered[1], plant, start / share)
        last_outputs = np.abs(y[-100:])
        assert last_outputs.max() < 0.05
        assert not watched(y, u)[1].any()


def test_a_decay_from_afar_raises_no_flag(covered: tuple[SSM, Design], watched) -> None:
    """The plant is its model and starts three scales away, the monitor's model at rest."""
    model = covered[0]
    y, u, _, _ = loop(covered[1], lambda m, _: m, 3.0)
    limit = Monitor.for_design(*covered).limit
    assert free_decay_energy(model.linear) * 3.0**2 > 30 * limit
    assert not watched(y, u)[1].any()


@pytest.mark.parametrize("share", [-2.0, -6.0, 7.0, 12.0])
def test_a_plant_that_the_loop_loses_is_flagged_before_it_leaves(
    covered: tuple[SSM, Design], watched, share: float
) -> None:
    """It answers `share` times as strongly as the model: the loop swings and grows."""
    y, u, _, _ = loop(covered[1], lambda m, _: share * m, 1e-2)
    is_beyond = np.abs(y) > 3
    left = int(np.argmax(is_beyond))
    assert left > 0
    flags = watched(y, u)[1]
    assert flags[left]


def test_it_costs_less_than_the_controller_again(
    device: Device, monitor: Monitor, tmp_path: Path
) -> None:
    without = products(device, tmp_path / "without")
    with_it = products(device, tmp_path / "with", monitor)
    states = len(monitor.output.a) + len(monitor.input.a)
    assert without < with_it <= 2 * without + 2 * states + 8


def test_without_a_proof_there_is_none(covered: tuple[SSM, Design]) -> None:
    assert Monitor.for_design(covered[0], design()) is None
    controller = convert_controller(covered[0], design())
    bare = Device.from_controller(controller, "double", *UNLIMITED)
    text = render_c_files(bare, origin_text="test")["controller.h"]
    assert '#error "no monitor' in text
