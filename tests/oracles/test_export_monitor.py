"""Monitor in the exported C: the sum that it keeps, by a route of its own; what it promises for any
plant; plants that it must and must not flag."""

import itertools
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from export_cases import compiled, products
from test_coverage import BALLS, MODEL, design, premise, scaled_model

from ssm_study.certificates.certificate import Design
from ssm_study.certificates.theorems.measured_discs import MeasuredDiscs
from ssm_study.export.c import render_c_files
from ssm_study.export.c_monitor import MonitorConstants, free_decay_energy
from ssm_study.export.device import DeviceController
from ssm_study.export.portable import convert_controller
from ssm_study.models.identified import SSM
from ssm_study.robustness.coverage import running_constraint_sum
from ssm_study.synthesis.measured_discs_run import add_coverage_certificate, disc_weights

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
    certified = add_coverage_certificate(design(), model, BALLS, records)
    return model, certified


@pytest.fixture(scope="module")
def monitor(covered: tuple[SSM, Design]) -> MonitorConstants:
    coverage_monitor = MonitorConstants.for_design(*covered)
    assert coverage_monitor is not None
    return coverage_monitor


@pytest.fixture(scope="module")
def device(covered: tuple[SSM, Design]) -> DeviceController:
    controller = convert_controller(*covered)
    return DeviceController.from_controller(controller, "double", *UNLIMITED)


def write_sources(folder: Path, device: DeviceController, monitor: MonitorConstants) -> None:
    """Write the C files of a monitored controller, and a program that reads samples."""
    files = render_c_files(device, origin_text="test", monitor=monitor)
    for file, text in files.items():
        (folder / file).write_text(text)
    (folder / "main.c").write_text(MAIN)


COMPILER = ["gcc", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-DMONITOR"]


Watch = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def watched(
    device: DeviceController, monitor: MonitorConstants, tmp_path_factory: pytest.TempPathFactory
) -> Watch:
    """Sum and flag of the C code at each sample, for outputs and applied inputs."""
    folder = tmp_path_factory.mktemp("monitor")
    write_sources(folder, device, monitor)
    compiled(folder, "-std=c99", "-DMONITOR")  # the replay is what it is without

    command = [*COMPILER, "main.c", "-o", "main"]
    subprocess.run(command, cwd=folder, check=True)

    def watch(y: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = zip(y.tolist(), u.tolist(), strict=True)
        samples = [f"{output!r} {applied!r}" for output, applied in pairs]
        text = " ".join(samples)
        program = [folder / "main"]
        piped = {"input": text, "capture_output": True, "text": True}
        process = subprocess.run(program, check=True, **piped)
        words = process.stdout.split()
        numbers = np.array(words, dtype=float)
        table = numbers.reshape(-1, 2)
        sums, flags = table.T
        return sums, flags.astype(bool)

    return watch


def part_of(certified: Design) -> MeasuredDiscs:
    part = certified.extra_certificates[MeasuredDiscs.part]
    assert isinstance(part, MeasuredDiscs)
    return part


Plant = Callable[[float, int], float]


def loop(certified: Design, plant: Plant, start: float) -> tuple[np.ndarray, ...]:
    """The loop on `y = plant(m, k)` with m from the model's state, the estimate from rest: y, u, m,
    and the states of model and estimate."""
    gains = certified.gains
    identity = np.eye(2)
    equilibrium = np.linalg.solve(identity - MODEL.a, MODEL.b)
    x = equilibrium[:, 0]
    output = float((MODEL.c @ x)[0])
    x *= start / output
    xh = np.zeros(2)
    rows = []
    for k in range(SAMPLES):
        u = float((gains["k"] @ xh)[0])
        m = float((MODEL.c @ x)[0])
        y = plant(m, k)
        row = (y, u, m, *x, *xh)
        rows.append(row)
        injected = MODEL.c @ xh - y
        model_input = MODEL.b[:, 0] * u
        x = MODEL.a @ x + model_input
        predicted = MODEL.a @ xh + model_input
        xh = predicted + gains["l"] @ injected
    table = np.array(rows)
    y, u, m, *states = table.T
    return y, u, m, np.stack(states, axis=1)


def sum_constraint(part: MeasuredDiscs, *signals: np.ndarray) -> np.ndarray:
    """The running sum of a certificate's premise over input, model output and error."""
    weights = disc_weights(part)
    return running_constraint_sum(weights, part.centre, part.kappa, *signals)


def sum_above_zero(added: np.ndarray) -> np.ndarray:
    """The running sum that never falls below zero."""
    sums = np.zeros(SAMPLES)
    last = 0.0
    for k, more in enumerate(added):
        last = max(last + more, 0.0)
        sums[k] = last
    return sums


def test_the_sum_is_the_running_sum_of_the_premise_that_never_falls_below_zero(
    covered: tuple[SSM, Design], monitor: MonitorConstants, watched: Watch
) -> None:
    part = part_of(covered[1])
    rng = np.random.default_rng(0)
    count = SAMPLES // 20
    levels = rng.uniform(-1, 1, count)
    y = np.repeat(levels, 20)
    y[0] = 0.5
    u = rng.uniform(-1, 1, SAMPLES)
    inputs = u[:, None]
    m = MODEL.simulate(inputs)[0]
    e = y[:, None] - m
    whole = sum_constraint(part, inputs, m, e)
    increments = np.diff(whole, prepend=0.0)
    expected = sum_above_zero(increments - monitor.allowance)
    sums, flags = watched(y, u)
    np.testing.assert_allclose(sums, expected, rtol=1e-9, atol=1e-12)
    limit = monitor.alarm_limit(y[:1])
    assert expected.max() > limit > monitor.limit > 0
    assert flags[-1]
    largest_so_far = np.maximum.accumulate(expected)
    has_passed = largest_so_far > limit
    np.testing.assert_array_equal(flags, has_passed)


@pytest.mark.parametrize("seed", range(3))
def test_the_sum_bounds_the_energy_of_any_plant(covered: tuple[SSM, Design], seed: int) -> None:
    """The plant is a stream of random numbers; the stored P is the witness: `xi' P xi` is at most
    that at the start and the sum, at every sample."""
    part = part_of(covered[1])
    rng = np.random.default_rng(seed)
    steps = rng.standard_normal(SAMPLES)
    noise = steps.cumsum() / 10

    def plant(m: float, k: int) -> float:
        return rng.uniform(-1, 2) * m + noise[k]

    y, u, m, states = loop(covered[1], plant, 0.0)
    e = (y - m)[:, None]
    sums = sum_constraint(part, u[:, None], m[:, None], e)
    model_states = states[:, :2]
    estimation_error = states[:, 2:] - model_states
    of_output = filter_states(part.weight_output, m)
    of_input = filter_states(part.weight_input, u)
    xi = np.hstack([model_states, estimation_error, of_output, of_input])
    energies = np.einsum("ti,ij,tj->t", xi, part.p, xi)
    allowed = energies[0] + sums[:-1]
    allowed += 1e-9
    assert (energies[1:] <= allowed).all()
    assert energies.max() > 1e-3


def filter_states(weight: np.ndarray, signal: np.ndarray) -> np.ndarray:
    order = len(weight) - 1
    transition = weight[:order, :order]
    gain = weight[:order, -1]
    samples = len(signal)
    states = np.zeros((samples, order))
    for k in range(samples - 1):
        kept_state = transition @ states[k]
        states[k + 1] = kept_state + gain * signal[k]
    return states


STARTS = (-0.5, 0.2, 0.5)
SHARES = (0.7, 1.4, 3.0)


def make_noisy_plant(share: float, noise: np.ndarray) -> Plant:
    """A plant that answers with a share of the model's output, and noise."""

    def plant(m: float, k: int) -> float:
        return share * m + noise[k]

    return plant


def test_a_plant_of_the_records_raises_no_flag(covered: tuple[SSM, Design], watched: Watch) -> None:
    rng = np.random.default_rng(1)
    for start, share in itertools.product(STARTS, SHARES):
        noise = 0.01 * rng.standard_normal(SAMPLES)
        plant = make_noisy_plant(share, noise)
        y, u, _, _ = loop(covered[1], plant, start / share)
        last_outputs = np.abs(y[-100:])
        assert last_outputs.max() < 0.05
        _, flags = watched(y, u)
        assert not flags.any()


def test_a_decay_from_afar_raises_no_flag(covered: tuple[SSM, Design], watched: Watch) -> None:
    """The plant is its model and starts three scales away, the monitor's model at rest."""
    model, certified = covered
    y, u, _, _ = loop(certified, lambda m, _: m, 3.0)
    limit = MonitorConstants.for_design(*covered).limit
    energy = free_decay_energy(model.linear) * 3.0**2
    assert energy > 30 * limit
    _, flags = watched(y, u)
    assert not flags.any()


LOST_SHARES = [-2.0, -6.0, 7.0, 12.0]


@pytest.mark.parametrize("share", LOST_SHARES)
def test_a_plant_that_the_loop_loses_is_flagged_before_it_leaves(
    covered: tuple[SSM, Design], watched: Watch, share: float
) -> None:
    """It answers `share` times as strongly as the model: the loop swings and grows."""
    certified = covered[1]
    y, u, _, _ = loop(certified, lambda m, _: share * m, 1e-2)
    is_beyond = np.abs(y) > 3
    left = int(np.argmax(is_beyond))
    assert left > 0
    flags = watched(y, u)[1]
    assert flags[left]


def test_it_costs_less_than_the_controller_again(
    device: DeviceController, monitor: MonitorConstants, tmp_path: Path
) -> None:
    without = products(device, tmp_path / "without")
    with_it = products(device, tmp_path / "with", monitor)
    states = len(monitor.output.a) + len(monitor.input.a)
    most = 2 * without + 2 * states + 8
    assert without < with_it <= most


def test_without_a_proof_there_is_none(covered: tuple[SSM, Design]) -> None:
    model = covered[0]
    uncovered = design()
    assert MonitorConstants.for_design(model, uncovered) is None
    controller = convert_controller(model, uncovered)
    bare = DeviceController.from_controller(controller, "double", *UNLIMITED)
    files = render_c_files(bare, origin_text="test")
    header = files["controller.h"]
    assert '#error "no monitor' in header
