"""The replay on an emulated Cortex-M4, without and with its floating-point unit: equal to the last
digit.

The committed log says what it gave where the emulator and the compiler are (Debian:
qemu-system-arm, gcc-arm-none-eabi, libnewlib-arm-none-eabi); `python
tests/oracles/test_export_cortex_m.py` writes it again.
"""

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


def emulated(kind: str, real: str, unit: str, folder: Path) -> str:
    """One line of the log."""
    made = device(folder, kind=kind, real=real, integral=kind == "mlp")
    written(made, folder / "c")
    bare = ["-nostartfiles", "--specs=rdimon.specs", "-T", ROOT / "tests/cortex_m/memory.ld"]
    sources = [ROOT / "tests/cortex_m/start.c", "controller_replay.c"]
    chip = [
        "-mcpu=cortex-m4",
        "-mthumb",
        *UNITS[unit],
        "-std=c99",
        *EXACT,
        "-Wall",
        "-Wextra",
        "-Werror",
    ]
    subprocess.run(
        [COMPILER, *chip, *bare, *sources, "-o", "replay.elf"], cwd=folder / "c", check=True
    )
    board = [
        EMULATOR,
        "-M",
        "mps2-an386",
        "-nographic",
        "-semihosting-config",
        "enable=on,target=native",
    ]
    replay_path = folder / "c" / "replay.elf"
    done = subprocess.run(
        [*board, "-kernel", replay_path], capture_output=True, text=True, timeout=120
    )
    return f"{kind}, {real}, {unit}: exit {done.returncode}, {done.stdout.strip()}"


CASES = [(kind, real, unit) for kind in KINDS for real in ("double", "float") for unit in UNITS]


def test_the_log_shows_no_difference() -> None:
    log = LOG.read_text()
    lines = log.splitlines()[1:]
    assert len(lines) == len(CASES)
    for line, (kind, real, unit) in zip(lines, CASES, strict=True):
        assert line == f"{kind}, {real}, {unit}: exit 0, 0 of 200 inputs differ, the largest by 0"


@pytest.mark.parametrize(("kind", "real", "unit"), [CASES[4], CASES[11]])
def test_the_emulated_chip(tmp_path: Path, kind: str, real: str, unit: str) -> None:
    for program in (COMPILER, EMULATOR):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} on this machine; its log is {LOG.relative_to(ROOT)}")
    library = subprocess.run(
        [COMPILER, "-print-file-name=rdimon.specs"], capture_output=True, text=True, check=True
    )
    # A name that the compiler did not find comes back as it is.
    if not Path(library.stdout.strip()).is_absolute():
        pytest.skip(
            f"{COMPILER} has no C library (libnewlib-arm-none-eabi); its log is "
            f"{LOG.relative_to(ROOT)}"
        )
    assert emulated(kind, real, unit, tmp_path) in LOG.read_text().splitlines()


if __name__ == "__main__":
    versions = [
        subprocess.run([p, "--version"], capture_output=True, text=True).stdout
        for p in (COMPILER, EMULATOR)
    ]
    with tempfile.TemporaryDirectory() as place:
        lines = [emulated(*case, Path(place) / "-".join(case).replace(" ", "_")) for case in CASES]
    LOG.parent.mkdir(parents=True, exist_ok=True)
    LOG.write_text("\n".join(["; ".join(v.splitlines()[0] for v in versions), *lines]) + "\n")
