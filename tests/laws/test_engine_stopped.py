"""A training that is stopped from outside is no failure: the run is lost, and resumed by its
command."""

import signal
import time
from pathlib import Path

import pytest
from fresh_programs import start_program

from ssm_study.engine.records import RECORD, read_record

ENDLESS = [
    "experiment=smoke",
    "+data.trials=false",
    "training.max_epochs=100000",
    "training.patience=100000",
    "+training.checkpoint_every_s=0.01",
    "progress=false",
]


def wait_for_file(folder: Path, name: str, seconds: float = 120.0) -> Path:
    deadline = time.monotonic() + seconds
    while not (found := list(folder.rglob(name))):
        assert time.monotonic() < deadline, f"no {name} within {seconds} s"
        time.sleep(0.1)
    return found[0]


COMMAND = """
import sys
from ssm_study.cli.main import main
sys.exit(main(WORDS))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_within_a_training_leaves_a_run_that_is_resumed(
    tmp_path: Path, number: signal.Signals
) -> None:
    """Lightning makes an exception of SIGTERM and status 1 of Ctrl-C: both were failures for
    good."""
    words = ["run", *ENDLESS, f"results_dir={tmp_path}"]
    text = COMMAND.replace("WORDS", repr(words))
    training = start_program(text, tmp_path / "program")
    wait_for_file(tmp_path / ".store", "last.ckpt")
    training.send_signal(number)
    ended = training.wait(timeout_s=60)
    assert ended.returncode == -number, ended.stderr
    folder = wait_for_file(tmp_path / "smoke", RECORD).parent
    record = read_record(folder)
    assert record is not None
    assert record["status"] == "lost"
    assert "error_type" not in record
    wait_for_file(tmp_path / ".store", "last.ckpt", seconds=0.0)


PROGRAM = """
import os, signal, threading, time
import numpy as np
import ssm_study as st
from pathlib import Path
def stop():
    while not list(Path(RESULTS).rglob("last.ckpt")):
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGTERM)
threading.Thread(target=stop, daemon=True).start()
u = np.random.default_rng(0).normal(size=500)
y = np.convolve(u, [0.0, 0.5, 0.3, 0.1])[:500]
words = ["model=ssm", "training.max_epochs=100000", "training.patience=100000"]
st.fit(u, y, 0.1, *words, "+training.checkpoint_every_s=0.01", results_dir=RESULTS)
print("went on")
"""


def test_a_program_that_fits_ends_by_the_signal_it_got(tmp_path: Path) -> None:
    """It ended with status 0, and a batch system took it for done."""
    program = PROGRAM.replace("RESULTS", repr(str(tmp_path)))
    ended = start_program(program, tmp_path / "program").wait(timeout_s=180)
    expected = (-signal.SIGTERM, "")
    assert (ended.returncode, ended.stdout) == expected, ended.stderr


KEEPING = """
import os, signal, threading, time
import numpy as np
import ssm_study as st
from pathlib import Path
def stop():
    while not list(Path(RESULTS).rglob("last.ckpt")):
        time.sleep(0.05)
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=stop, daemon=True).start()
signal.signal(signal.SIGINT, signal.default_int_handler)
u = np.random.default_rng(0).normal(size=500)
y = np.convolve(u, [0.0, 0.5, 0.3, 0.1])[:500]
words = ["model=ssm", "training.max_epochs=100000", "training.patience=100000"]
words += ["+training.checkpoint_every_s=0.01", "+training.starts=3"]
try:
    model = st.fit(u, y, 0.1, *words, results_dir=RESULTS, keep_on_interrupt=KEEP)
    print(model.result_columns["training_ended"], model.score(u, y) > 0)
except KeyboardInterrupt:
    print("interrupted")
print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


@pytest.mark.parametrize("keep", [True, False])
def test_ctrl_c_returns_the_model_so_far_only_where_it_is_asked_for(
    tmp_path: Path, keep: bool
) -> None:
    """In a notebook the next cell goes on, and Ctrl-C works there as before: Lightning left it
    ignored."""
    keeping = KEEPING.replace("RESULTS", repr(str(tmp_path)))
    program = keeping.replace("KEEP", repr(keep))
    ended = start_program(program, tmp_path / "program").wait(timeout_s=180)
    assert ended.returncode == 0, ended.stderr
    first, second = ended.stdout.splitlines()
    assert second == "True"
    if keep:
        assert first.startswith("stopped by Ctrl-C after ")
        assert first.endswith(" epochs True")
    else:
        assert first == "interrupted"
