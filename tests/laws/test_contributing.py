"""CONTRIBUTING's promises: each guide's example, exactly the files it shows, is found and judged by
every law.

The files go into a copy of the project. A guide whose example another page shows names that page.
"""

import re
import shutil
from pathlib import Path
from textwrap import dedent

import pytest
from fresh_programs import start_program

ROOT = Path(__file__).resolve().parents[2]
GUIDE = re.compile(r"^### (?:an?) ([a-z]+)\n(.*?)(?=^##)", re.M | re.S)
FILE = re.compile(r'^( *)```\w+ (?:file|title)="([^"]+)"\n(.*?)^\1```', re.M | re.S)
PAGE = re.compile(r"\]\((docs/[a-z_]+\.md)\)")

# What a guide promises: how many files, and which laws judge them under which name. A theorem, a
# figure and a column have tests of their own (test_docs_commands, test_synthesis_theorems,
# test_table_columns).
PROMISED = {"plant": 2, "excitation": 2, "reader": 1, "model": 2, "scaffolding": 2, "peer": 1}
PROMISED |= {"figure": 1, "theorem": 2, "column": 0}
LAWS = {
    "ramps": "tests/laws/test_data_excitation.py",
    "fir": "tests/laws/test_models_yaml.py",
    "dead_zone": "tests/laws/test_models_yaml.py tests/laws/test_models_scaffold_torch.py",
    "my_plant": "ssm_study/conformance/test_plants.py",
}
# No law finds these by a file: a reader by its suffix, a peer by its name.
FOUND = "test_a_reader_and_a_peer_are_found_by_their_names"
HERE = f"""
import numpy as np
import pytest
from loop_cases import BALLS, motor, motor_model, motor_record
from ssm_study.data.readers.reader import read_table
from ssm_study.loop.comparison import ControllerComparison
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.loop.peers.peer import IdentificationResult
from ssm_study.refusal import BadRequest


def {FOUND}(tmp_path):
    path, wanted = tmp_path / "log.npz", {{"u": ""}}
    np.savez(path, u=np.arange(5.0))
    assert (read_table(path, wanted).columns["u"] == np.arange(5.0)).all()
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(BadRequest, match=r"np\\.savez"):
        read_table(path, wanted)
    known = IdentificationResult(model=motor_model(), balls=BALLS, validation=(motor_record(),))
    loop = LoopExperiment(initial_conditions=2, horizon_s=0.5)
    (row,) = ControllerComparison(controllers=("proportional",)).rows(motor(), known, loop, 0)
    assert row["controller"] == "proportional" and row["initial_conditions"] == 2, row
"""


def guides() -> dict[str, dict[str, str]]:
    """The files of each guide's example: path to content."""
    found: dict[str, dict[str, str]] = {}
    for name, text in GUIDE.findall((ROOT / "CONTRIBUTING.md").read_text()):
        pages = PAGE.findall(text)
        shown = text + "".join((ROOT / page).read_text() for page in pages)
        file = FILE.findall(shown)
        found[name] = {path: dedent(content) for _, path, content in file}
    return found


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory, smoke_study: Path) -> Path:
    """The project with the examples in it; no file that was there before is touched.

    After a run, which has compiled what is copied with it.
    """
    del smoke_study
    folder = tmp_path_factory.mktemp("copy")
    for name in ("ssm_study", "hydra_plugins", "conf", "tests"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.pyc.*", "*.tmp.*")
        )  # half written
    shutil.copy(ROOT / "pyproject.toml", folder)
    for files in guides().values():
        for path, content in files.items():
            assert not (folder / path).exists(), f"{path} would be overwritten"
            (folder / path).write_text(content)
    return folder


# Pytest in a process of its own, where the copy is imported in place of the project.
JUDGE = """
import os, sys
import pytest
for name in [name for name in os.environ if name.startswith("PYTEST_XDIST")]:
    del os.environ[name]
os.environ["HYPOTHESIS_PROFILE"] = "few"
os.chdir(COPY)
sys.path[:0] = [COPY, COPY + "/tests"]
sys.exit(pytest.main(WORDS))
"""


@pytest.fixture(scope="module")
def judged(copy: Path) -> list[str]:
    """The checks that passed in the copy: one line each."""
    test_here_path = copy / "tests" / "laws" / "test_here.py"
    test_here_path.write_text(HERE)
    paths = sorted({path for laws in LAWS.values() for path in laws.split()})
    # Without the check of shapes: it is put on every function of the package when that is imported.
    words = ["-o", "addopts=--timeout=300 --strict-markers", "-n", "0", "-p", "no:randomly"]
    words += ["-q", "-rp", "-k", " or ".join([*LAWS, FOUND])]
    words += [*paths, "tests/laws/test_here.py"]
    program = JUDGE.replace("COPY", repr(str(copy))).replace("WORDS", repr(words))
    done = start_program(program, copy / "program").wait(timeout_s=250)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    lines = done.stdout.splitlines()
    return [line for line in lines if line.startswith("PASSED")]


def test_every_guide_shows_the_files_it_promises() -> None:
    assert {name: len(files) for name, files in guides().items()} == PROMISED


def test_every_law_finds_and_judges_the_examples(judged: list[str]) -> None:
    for name, laws in LAWS.items():
        for path in laws.split():
            assert [line for line in judged if path in line and name in line], (
                f"no law of {path} judged {name}"
            )


def test_a_reader_and_a_peer_are_found_by_their_names(judged: list[str]) -> None:
    assert [line for line in judged if FOUND in line]
