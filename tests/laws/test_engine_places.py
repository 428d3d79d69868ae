"""Places where nothing can be kept or that lack what a machine usually has: the run goes on."""

import subprocess
import sys

PROGRAM = """
import numba.core.caching as caching
def refuse(self):
    raise OSError("read-only")
for name in dir(caching):
    if hasattr(getattr(caching, name), "ensure_cache_path"):
        getattr(caching, name).ensure_cache_path = refuse
import numpy as np
from ssm_study.models.structured_kernel import bend
from ssm_study.plants import dc_motor_kernel
print(bend(0, 0.0))
"""


def test_without_a_place_for_compiled_code_there_is_a_warning_and_a_result() -> None:
    """No writable home and a read-only installation, as in containers, ended every run."""
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "(0.0, 1.0)\n"), ended.stderr
    assert ended.stderr.count("NUMBA_CACHE_DIR") == 1
