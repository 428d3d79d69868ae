"""Places where nothing can be kept or that lack what a machine usually has: the run goes on."""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import numba.core.caching as caching
def refuse(self):
    raise OSError("read-only")
for name in dir(caching):
    if hasattr(getattr(caching, name), "ensure_cache_path"):
        getattr(caching, name).ensure_cache_path = refuse
import numpy as np
from ssm_study.models.structured_kernel import activation_and_slope
from ssm_study.plants import dc_motor_kernel
print(activation_and_slope(0, 0.0))
"""


def test_without_a_place_for_compiled_code_there_is_a_warning_and_a_result() -> None:
    """No writable home and a read-only installation, as in containers, ended every run."""
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    expected = (0, "(0.0, 1.0)\n")
    assert (ended.returncode, ended.stdout) == expected, ended.stderr
    actual = ended.stderr.count("NUMBA_CACHE_DIR")
    assert actual == 1


DRAWN = """
import matplotlib
from ssm_study.style import paper
assert matplotlib.rcParams["text.usetex"]
from matplotlib.figure import Figure
with paper():
    figure = Figure()
    figure.subplots().set_title("a")
    figure.savefig("figure.png")
assert matplotlib.rcParams["text.usetex"], "the user's own settings are back"
"""


def test_a_users_own_style_of_figures_does_not_end_a_run(tmp_path: Path) -> None:
    """With `text.usetex`, and no TeX, a run that was ok ended with status 2."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: true\nbackend: agg\n")
    environment = os.environ | {"MATPLOTLIBRC": str(tmp_path), "PATH": ""}
    ended = subprocess.run(
        [sys.executable, "-c", DRAWN], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "figure.png").is_file()


def test_where_files_cannot_be_locked_the_import_says_on_what_it_runs() -> None:
    """Windows has no fcntl: the error named that module alone."""
    program = "import sys; sys.modules['fcntl'] = None; import ssm_study.durable"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 1
    lines = ended.stderr.splitlines()
    assert lines[-1] == ("ImportError: ssm-study runs on Linux and macOS, on Windows in WSL")
