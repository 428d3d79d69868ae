"""Devices made of made-up runs, and their C code compiled: shared by the tests of the export."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from report_runs import random_run

from ssm_study.export.c import render_c_files
from ssm_study.export.c_monitor import MonitorConstants
from ssm_study.export.device import DeviceController
from ssm_study.export.targets import load_controller

STRICT = ["-pedantic", "-Wall", "-Wextra", "-Werror"]
OF_NUMBERS = ["-Wconversion", "-Wdouble-promotion"]
OF_NAMES = ["-Wshadow", "-Wundef", "-Wcomment"]
WARNINGS = [*STRICT, *OF_NUMBERS, *OF_NAMES]
EXACT = ["-O2", "-ffp-contract=off"]
COUNTING = """
#include <math.h>
#include <stdio.h>
static long products;
struct Real { double v; Real(double v = 0) : v(v) {} };
#define DO(result, op) static result operator op(Real a, Real b) { return a.v op b.v; }
DO(Real, +) DO(Real, -) DO(Real, /) DO(bool, <) DO(bool, >) DO(bool, <=) DO(bool, >=)
static Real operator*(Real a, Real b) { ++products; return a.v * b.v; }
static Real operator-(Real a) { return -a.v; }
static void operator+=(Real &a, Real b) { a.v += b.v; }
static void operator-=(Real &a, Real b) { a.v -= b.v; }
static Real fmin(Real a, Real b) { return fmin(a.v, b.v); }
static Real fmax(Real a, Real b) { return fmax(a.v, b.v); }
"""
# Scaled: within it most set points of a replay can be held, beyond it goes every hard braking.
LIMIT = 1.5


def device(
    folder: Path,
    *,
    kind: str,
    channels: int = 1,
    real: str = "double",
    integral: bool | list[str] = False,
) -> DeviceController:
    """With limits that the replay runs into."""
    size = {"channels": channels, "seed": channels}
    run = random_run(folder / "run", kind=kind, integral=integral, **size)
    controller = load_controller(run)
    ends = []
    for sign in (-1, 1):
        scaled_limit = np.full(channels, sign * LIMIT)
        limit = controller.scale.physical_input(scaled_limit)
        ends.append(limit)
    return DeviceController.from_controller(controller, real, *ends)


def written(
    device: DeviceController, folder: Path, about: str = "test", name: str = "controller"
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    files = render_c_files(device, name, origin_text=about)
    for file, text in files.items():
        (folder / file).write_text(text)
    return folder


def compiled(
    folder: Path,
    *words: str,
    sources: tuple[str, ...] = ("controller_replay.c",),
    compiler: str = "gcc",
) -> str:
    """Build and run; what the program says. A compiler that is not there skips the test."""
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    command = [compiler, *WARNINGS, *EXACT, *words]
    command += [*sources, "-o", "replay"]
    subprocess.run(command, cwd=folder, check=True)
    program = [folder / "replay"]
    replay = subprocess.run(program, capture_output=True, text=True)
    assert replay.returncode == 0, replay.stdout + replay.stderr
    return replay.stdout


def products(
    device: DeviceController, folder: Path, monitor: MonitorConstants | None = None
) -> int:
    """How often the C code multiplies two floats in one sample: compiled as C++, with a type that
    counts."""
    files = render_c_files(device, origin_text="counted", monitor=monitor)
    header = files["controller.h"].replace("#include <math.h>", "")
    counting_header = re.sub(r"\bdouble\b", "Real", header)
    words = ["-w", "-O0"]
    if monitor is not None:
        words.append("-DMONITOR")
    outputs = device.controller.scale.outputs
    inputs = device.controller.scale.inputs
    sizes = (outputs, outputs, inputs)
    called = "track(&state, y, r, u)" if device.set_point_maps else "step(&state, y, u)"
    body = "controller_state state; Real y[{}], r[{}], u[{}]; controller_reset(&state);".format(
        *sizes
    )
    main = f'int main() {{ {body} controller_{called}; printf("%ld", products); }}'
    folder.mkdir()
    path = folder / "counted.cpp"
    path.write_text(COUNTING + counting_header + main)
    printed = compiled(folder, *words, sources=("counted.cpp",), compiler="g++")
    return int(printed)
