"""The package from Python: importing it loads nothing heavy; programs need nothing of ours."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from docs_numbers import assert_outcome_holds, outcome_on_page
from fresh_programs import start_program
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

import ssm_study as st
from ssm_study.cli.from_python import compose_configuration
from ssm_study.refusal import BadRequest


def test_importing_the_package_loads_nothing_heavy() -> None:
    told = (
        "import sys, ssm_study; print(sorted({'torch', 'numpy', 'hydra', 'pandas'} & "
        "set(sys.modules)))"
    )
    stdout = subprocess.run(
        [sys.executable, "-c", told], capture_output=True, text=True, check=True
    ).stdout
    assert stdout == "[]\n"
    with pytest.raises(AttributeError, match="no attribute 'regulate'"):
        _ = st.regulate


def test_what_a_stored_model_needs_loads_no_torch() -> None:
    told = "import sys; from ssm_study.models import structured, structured_spec; "
    told += "from ssm_study.models.baselines import solved; print('torch' in sys.modules)"
    stdout = subprocess.run(
        [sys.executable, "-c", told], capture_output=True, text=True, check=True
    ).stdout
    assert stdout == "False\n"


def test_a_program_needs_no_environment(tmp_path: Path) -> None:
    told = f"import ssm_study as st; st.study('results_dir={tmp_path}', 'seed=-1')"
    clean = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    said = subprocess.run(
        [sys.executable, "-c", told], env=clean, capture_output=True, text=True
    ).stderr
    assert "KeyError" not in said
    assert "BadRequest: seed = -1" in said


def test_a_hydra_program_may_compose_with_us() -> None:
    """Whoever calls this from a program of Hydra's own finds the program's composition as it
    was."""
    parents = Path(__file__).parents
    conf_path = parents[2] / "conf"
    folder = str(conf_path)
    with initialize_config_dir(folder, version_base="1.3"):
        theirs = GlobalHydra.instance().hydra
        study = compose_configuration(["study=library"]).study
        assert study == "library"
        with pytest.raises(BadRequest, match="modle"):
            compose_configuration(["modle.order=2"])
        assert GlobalHydra.instance().hydra is theirs


def test_science_alone_goes_from_arrays_to_c(tmp_path: Path) -> None:
    """The example needs neither Hydra nor the command, the study, the table or the page."""
    parents = Path(__file__).parents
    examples_path = parents[2] / "examples"
    script = examples_path / "arrays_to_controller.py"
    rooms = (
        "'hydra', 'ssm_study.study', 'ssm_study.cli', 'ssm_study.table', 'ssm_study.report.page'"
    )
    program = f"""
import runpy, sys
sys.argv = ["example", {str(tmp_path)!r}]
runpy.run_path({str(script)!r})
print([name for name in sys.modules if name in ({rooms})])
"""
    done = start_program(program, tmp_path / "program").wait(timeout_s=200)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[-1] == "[]"
    assert "certified in exact arithmetic" in done.stdout
    for block in ("Model\n", "Design\n"):
        on_page = outcome_on_page("howto_python.md", block)
        assert_outcome_holds(on_page, done.stdout)
    assert (tmp_path / "controller.h").is_file()
