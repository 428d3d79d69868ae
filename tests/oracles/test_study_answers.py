"""Commands that answer at once, and a second run compared with the first."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ssm_study.cli.main import main
from ssm_study.study.reproduce import compare_records

pytestmark = pytest.mark.usefixtures("made_once")


@pytest.mark.parametrize(
    "words", [["show", "STUDY"], ["run", "model.order=-1"]], ids=["show", "a wrong value"]
)
def test_what_answers_at_once_loads_no_part_that_takes_long(
    smoke_run: Path, words: list[str]
) -> None:
    """Torch, Lightning, CVXPY, Matplotlib and SciPy's statistics and filters take half a second
    each, or more."""
    heavy = (
        "{'torch', 'lightning', 'cvxpy', 'matplotlib.pyplot', 'scipy.stats', "
        "'scipy.signal._filter_design'}"
    )
    program = f"import atexit, sys; atexit.register(lambda: print({heavy} & set(sys.modules))); "
    program += "from ssm_study.cli.main import main; main(sys.argv[1:])"
    words = [str(smoke_run.parent) if word == "STUDY" else word for word in words]
    ended = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True)
    assert ended.returncode in (0, 2), ended.stderr
    assert ended.stdout.endswith("set()\n")


def test_a_finished_run_is_told_again_without_pandas_until_its_study_changes(
    smoke_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Word for word as the first time; another run beside it, and the study is read again."""
    study = tmp_path / "smoke"
    shutil.copytree(smoke_run.parent, study)
    program = (
        "import sys; from ssm_study.cli import summary; from ssm_study.cli.main import main; "
        "summary.RUN_FIGURES = (); "  # as in this process
        "print(main(sys.argv[1:]), 'pandas' in sys.modules)"
    )
    words = ["run", "experiment=smoke", f"results_dir={tmp_path}", "progress=false"]

    def told() -> str:
        command = [sys.executable, "-c", program, *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert main(words) == 0
    again = told()
    assert again == f"{capsys.readouterr().out}0 False\n"
    assert "certified" in again
    shutil.copytree(study / smoke_run.name, study / "another")
    assert told().endswith("0 True\n")


def test_a_second_run_is_compared_number_by_number() -> None:
    then = {
        "status": "ok",
        "order": 4,
        "fit_test_percent": 90.0,
        "threads": 1,
        "synthesis_seconds": 1.0,
    }
    now = then | {"synthesis_seconds": 2.0}
    expected = (["3 columns compared: 3 equal to the last bit, 0 differ"], True)
    assert compare_records(then, now) == expected
    now = then | {"fit_test_percent": 90.1, "order": None, "threads": 2}
    lines, agrees = compare_records(then, now)
    assert not agrees
    expected = [
        "3 columns compared: 1 equal to the last bit, 2 differ",
        "  order: 4 then, None now",
        "  fit_test_percent: 90.0 then, 90.1 now",
        "  changed since: threads 1 -> 2",
    ]
    assert lines == expected
    fit_test_percent = 90.0 * (1 + 1e-9)
    now = then | {"fit_test_percent": fit_test_percent}
    assert compare_records(then, now)[1]
