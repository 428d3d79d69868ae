"""The replay on an emulated Cortex-M4, without and with its floating-point unit: equal to the last
digit.

The committed log says what it gave where the emulator and the compiler are (Debian:
qemu-system-arm, gcc-arm-none-eabi, libnewlib-arm-none-eabi); `python
tests/oracles/test_export_cortex_m.py` writes it again.
"""

import itertools
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from export_cases import EXACT, device, written
from report_runs import KINDS

ROOT = Path(__file__).resolve().parents[2]
LOG = ROOT / "results" / "reference" / "export" / "cortex_m4.txt"
UNITS = {
    "no unit": ["-mfloat-abi=soft"],
    "unit for float": ["-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"],
}
COMPILER = "arm-none-eabi-gcc"
EMULATOR = "qemu-system-arm"


START = ROOT / "tests" / "cortex_m" / "start.c"
MEMORY = ROOT / "tests" / "cortex_m" / "memory.ld"
BARE = ["-nostartfiles", "--specs=rdimon.specs", "-T", MEMORY]
STRICT = ["-Wall", "-Wextra", "-Werror"]
CHIP = ["-mcpu=cortex-m4", "-mthumb", "-std=c99", *EXACT, *STRICT]
SEMIHOSTING = ["-semihosting-config", "enable=on,target=native"]
BOARD = [EMULATOR, "-M", "mps2-an386", "-nographic", *SEMIHOSTING]


def emulated(kind: str, real: str, unit: str, folder: Path) -> str:
    """One line of the log."""
    with_integrator = kind == "mlp"
    controller = device(folder, kind=kind, real=real, integral=with_integrator)
    sources = folder / "c"
    written(controller, sources)
    command = [COMPILER, *CHIP, *UNITS[unit], *BARE]
    command += [START, "controller_replay.c", "-o", "replay.elf"]
    subprocess.run(command, cwd=sources, check=True)
    run = [*BOARD, "-kernel", sources / "replay.elf"]
    replay = subprocess.run(run, capture_output=True, text=True, timeout=120)
    return f"{kind}, {real}, {unit}: exit {replay.returncode}, {replay.stdout.strip()}"


CASES = list(itertools.product(KINDS, ("double", "float"), UNITS))


def test_the_log_shows_no_difference() -> None:
    log = LOG.read_text()
    lines = log.splitlines()[1:]
    assert len(lines) == len(CASES)
    for line, (kind, real, unit) in zip(lines, CASES, strict=True):
        case = f"{kind}, {real}, {unit}"
        assert line == f"{case}: exit 0, 0 of 200 inputs differ, the largest by 0"


@pytest.mark.parametrize(("kind", "real", "unit"), [CASES[4], CASES[11]])
def test_the_emulated_chip(tmp_path: Path, kind: str, real: str, unit: str) -> None:
    for program in (COMPILER, EMULATOR):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} on this machine; its log is {LOG.relative_to(ROOT)}")
    question = [COMPILER, "-print-file-name=rdimon.specs"]
    library = subprocess.run(question, capture_output=True, text=True, check=True)
    path = Path(library.stdout.strip())
    # A name that the compiler did not find comes back as it is.
    if not path.is_absolute():
        pytest.skip(
            f"{COMPILER} has no C library (libnewlib-arm-none-eabi); its log is "
            f"{LOG.relative_to(ROOT)}"
        )
    line = emulated(kind, real, unit, tmp_path)
    log = LOG.read_text()
    assert line in log.splitlines()


def version_of(program: str) -> str:
    """The first line of what a program says of itself."""
    answer = subprocess.run([program, "--version"], capture_output=True, text=True)
    return answer.stdout.splitlines()[0]


if __name__ == "__main__":
    versions = [version_of(program) for program in (COMPILER, EMULATOR)]
    lines = ["; ".join(versions)]
    with tempfile.TemporaryDirectory() as place:
        for case in CASES:
            name = "-".join(case).replace(" ", "_")
            line = emulated(*case, Path(place) / name)
            lines.append(line)
    LOG.parent.mkdir(parents=True, exist_ok=True)
    text = "\n".join(lines)
    LOG.write_text(text + "\n")
