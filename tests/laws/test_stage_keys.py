"""Keys of stages: an edit makes stale exactly the stages whose result it can change.

Each row of the table edits one file and walks a request down the line, without computing. A key
that is too wide costs time; one that is too narrow costs truth: the second half of this file.
"""

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir

from ssm_study.engine import stages as engine_stages
from ssm_study.engine.fingerprint import CodeReader, find_symbol
from ssm_study.engine.stages import Compute, Facts, StageOutput, StageResult, Stages, columns_key
from ssm_study.study.line import STUDY
from ssm_study.study.specification import Specification
from ssm_study.study.stages.evidence import EVIDENCE

ROOT = Path(__file__).resolve().parents[2]
ALL = [
    "dataset",
    "model",
    "bounds",
    "textbook_pi",
    "mismatch",
    "evidence",
    "synthesis",
    "sine_trials",
    "fresh_data",
    "loop",
]
OF_A_PLANT = ("textbook_pi", "sine_trials", "fresh_data")
COLUMNS = " columns"


pytestmark = pytest.mark.usefixtures("each_text_scanned_once")


@dataclass(frozen=True)
class KeysOfStages(Stages):
    """Notes the key of every stage and of its columns; computes nothing."""

    keys: dict[str, str] = field(default_factory=dict)
    folder: Path = Path("nowhere")

    def stage_result(self, name: str, key: str, note: Facts, compute: Compute) -> StageResult:  # noqa: ARG002
        self.keys[name] = key
        path = self.folder / name
        return StageResult(path=path, key=key, seconds=0.0, reused=False, name=name)

    def stage_columns(self, kept: StageOutput[Any], before: Sequence[StageOutput[Any]]) -> Facts:
        self.keys[kept.stage.name + COLUMNS] = columns_key(kept, before)
        return {}


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package, to be edited; each test leaves it as it was."""
    to = tmp_path_factory.mktemp("sources") / "ssm_study"
    unwanted = shutil.ignore_patterns("*.pyc")
    return Path(shutil.copytree(ROOT / "ssm_study", to, ignore=unwanted))


def request_of(*overrides: str) -> Specification:
    configuration = str(ROOT / "conf")
    with initialize_config_dir(configuration, version_base="1.3"):
        number = ["study=s", *overrides]
        config = compose("study", number)
        return Specification.from_config(config)


@pytest.fixture(scope="module")
def simulated() -> Specification:
    return request_of("experiment=smoke")


def keys_of(
    request: Specification, package: Path, folder: Path = Path("nowhere")
) -> dict[str, str]:
    """Key of every stage and of its columns, with the sources in `package`."""
    sources = CodeReader({"ssm_study": package})

    def version(*roots: Callable[..., Any] | type | str) -> str:
        unique_symbols = {find_symbol(root) for root in roots}
        symbols = sorted(unique_symbols)
        return sources.code_digest(*symbols)

    stages = KeysOfStages(folder=folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine_stages, "code_version", version)
        STUDY.run_stages(request, stages)
    return stages.keys


def edit(package: Path, file: str, pattern: str, instead: str) -> str:
    """Replace the first match of `pattern`; the text before."""
    path = package / file
    text = path.read_text()
    edited, count = re.subn(pattern, instead, text, count=1, flags=re.MULTILINE)
    assert count == 1, f"{pattern} is not in {file}"
    path.write_text(edited)
    return text


def stale(
    request: Specification,
    package: Path,
    file: str,
    pattern: str,
    instead: str,
    folder: Path = Path("nowhere"),
) -> list[str]:
    """Stages that an edit makes stale, in the order of the line; then columns alone."""
    before = keys_of(request, package, folder)
    text = edit(package, file, pattern, instead)
    try:
        after = keys_of(request, package, folder)
    finally:
        (package / file).write_text(text)
    return [name for name in after if after[name] != before[name]]


def stages_among(names: list[str]) -> list[str]:
    return [name for name in names if not name.endswith(COLUMNS)]


DOCSTRING = (r'\A"""', '"""Edited. ')
NEW_CODE = (r"^(from typing import .*)$", r"\1\nEDITED = 1\nprint(EDITED)")
EDITED_END = (r"\Z", "\nEDITED = 1\nprint(EDITED)\n")
COMMENT = (r"^import numpy as np$", "# why\nimport numpy as np\n")
OTHER_BASES = (r"^class CascadedTanks\(", "class CascadedTanks(object, ")
NOWHERE = {
    "docstring": ("study/stages/dataset.py", *DOCSTRING),
    "docstring of a theorem": ("certificates/theorems/state_feedback.py", *DOCSTRING),
    "comment": ("plants/dc_motor.py", *COMMENT),
    "figure": ("report/figures/closed_loop_responses.py", *EDITED_END),
    "page": ("report/page/data.py", *EDITED_END),
    "command": ("cli/run.py", *NEW_CODE),
    "table": ("table/gather.py", *NEW_CODE),
    "verification": ("study/claims.py", *EDITED_END),
    "line": ("study/line.py", *NEW_CODE),
    "another plant": ("plants/cascaded_tanks.py", *OTHER_BASES),
    "a reader of logs": ("data/readers/text.py", *EDITED_END),
}


@pytest.mark.parametrize("row", NOWHERE)
def test_what_no_result_depends_on(row: str, scratch: Path, simulated: Specification) -> None:
    stale_stages = stale(simulated, scratch, *NOWHERE[row])
    assert stale_stages == []


INPUT_COVERAGE = (
    r"^def input_coverage\((.*)\) -> float:$",
    r"def input_coverage(\1):\n    del EDITED",
)
STABLE_COUNT = (r"stable_count = len", "stable_count = 1 + len")
PAPER_FEASIBILITY = (r"^def paper_feasibility_columns\(", "@edited\ndef paper_feasibility_columns(")
MEASURES = {
    "dataset": ("data/metrics.py", *INPUT_COVERAGE),
    "loop": ("loop/metrics.py", *STABLE_COUNT),
    "synthesis": ("synthesis/metrics.py", *PAPER_FEASIBILITY),
}


@pytest.mark.parametrize("stage", MEASURES)
def test_a_measure_makes_its_columns_stale(
    stage: str, scratch: Path, simulated: Specification
) -> None:
    expected = [stage + COLUMNS]
    stale_stages = stale(simulated, scratch, *MEASURES[stage])
    assert stale_stages == expected


def decorate(definition: str) -> tuple[str, str]:
    """Pattern of a function's or class's first line, and what puts a decorator over it."""
    return rf"^{definition}", r"@edited\n\g<0>"


NEW_FIELD = (r"^class Mismatch:$", "class Mismatch:\n    edited: float = 0.0\n")
ANY_CLASS = decorate(r"class \w+\(")
SECOND_BASE = (r"^class DCMotor\(", "class DCMotor(object, ")
MISMATCH_MEASURE = decorate(r"def measure_model_error\(")
INITIAL_STATES = decorate(r"class InitialStates\(")
SIMULATED_DATA = decorate("class SimulatedData")
CLOSED_LOOP = decorate(r"def simulate_closed_loop\(")
FINDINGS = decorate(r"def collect_findings\(")
FROM_MODEL = ALL[1:]
FROM_MISMATCH = ALL[4:]
FROM_EVIDENCE = ALL[5:]
FROM_SYNTHESIS = ALL[6:]
# File, pattern, what stands there instead, and the stages that become stale.
ROWS = {
    "mismatch": ("robustness/mismatch.py", *MISMATCH_MEASURE, FROM_MISMATCH),
    "a field of the mismatch": ("robustness/mismatch.py", *NEW_FIELD, FROM_MISMATCH),
    "theorem": ("certificates/theorems/state_feedback.py", *ANY_CLASS, FROM_SYNTHESIS),
    "auto": ("synthesis/auto.py", *decorate(r"class Auto\b"), FROM_SYNTHESIS),
    "training": ("training/fit.py", *INITIAL_STATES, FROM_MODEL),
    "plant": ("plants/dc_motor.py", *SECOND_BASE, ALL),
    "simulated data": ("data/simulated.py", *SIMULATED_DATA, ALL),
    "loop": ("loop/rollout.py", *CLOSED_LOOP, ["textbook_pi", "loop"]),
    "evidence": ("evidence/metrics.py", *FINDINGS, FROM_EVIDENCE),
}


@pytest.mark.parametrize("row", ROWS)
def test_exactly_these_stages(row: str, scratch: Path, simulated: Specification) -> None:
    *change, expected = ROWS[row]
    names = stale(simulated, scratch, *change)
    assert stages_among(names) == expected


def test_a_rule_that_leaves_the_evidence_as_it_was_makes_no_design_stale(
    scratch: Path, simulated: Specification, tmp_path: Path
) -> None:
    """Once judged anew, the content of evidence.json decides: the same words, the same design."""
    evidence_folder = tmp_path / EVIDENCE.name
    file_name = EVIDENCE.files[0]
    file = evidence_folder / file_name
    file.parent.mkdir()
    file.write_text('{"level": "sound"}')
    *change, _ = ROWS["evidence"]
    names = stale(simulated, scratch, *change, folder=tmp_path)
    assert stages_among(names) == ["evidence"]
    before = keys_of(simulated, scratch, tmp_path)
    file.write_text('{"level": "doubt"}')
    after = keys_of(simulated, scratch, tmp_path)
    expected = FROM_SYNTHESIS
    stale_stages = [name for name in ALL if after[name] != before[name]]
    assert stale_stages == expected


@pytest.fixture
def recorded(tmp_path: Path) -> Specification:
    log = tmp_path / "log.csv"
    text = "".join(f"{0.1 * k},{k % 3},{k % 5}\n" for k in range(200))
    log.write_text("time,u,y\n" + text)
    path_setting = f"data.path={log}"
    words = ("data=recorded", path_setting, "data.input=u", "data.output=y", "model=ssm")
    return request_of(*words, "model.order=2")


READERS_AND_SPLITS = [
    ("data/splits.py", r"^def periodic_segments\("),
    ("data/readers/text.py", r"^class \w+\("),
    ("data/recorded.py", r"^class RecordedData\("),
]


@pytest.mark.parametrize(("file", "pattern"), READERS_AND_SPLITS)
def test_reader_and_split_make_all_stale(
    file: str, pattern: str, scratch: Path, recorded: Specification
) -> None:
    edited = stale(recorded, scratch, file, pattern, r"@edited\n\g<0>")
    expected = [name for name in ALL if name not in OF_A_PLANT]
    assert stages_among(edited) == expected


def test_more_fresh_data_sets_train_nothing_again(scratch: Path, simulated: Specification) -> None:
    before = keys_of(simulated, scratch)
    more = request_of("experiment=smoke", "data.fresh_sets=7")
    after = keys_of(more, scratch)
    stale_stages = [name for name in ALL if after[name] != before[name]]
    assert stale_stages == ["fresh_data"]
    request = request_of("experiment=smoke", "data.noise_variance=0.5")
    other_noise = keys_of(request, scratch)
    stale_stages = [name for name in ALL if other_noise[name] != before[name]]
    assert stale_stages == ALL


GAIN_CERTIFICATES = decorate(r"def add_gain_certificates\(")
PLANT_KERNEL = decorate(r"def advance_batch\(")
DESIGN_KERNEL = decorate(r"def solve_linear\(")
REDUCTION = decorate("class Reduction")
CONSTANT = (r"^(HOLDS|[A-Z_]{4,}) = ", r"EDITED = 1\n\1 = EDITED * ")
TOO_NARROW = {
    "a class that the configuration names": ("bounds/reduction.py", *REDUCTION, "bounds"),
    "a function imported inside a function": (
        "synthesis/deployed.py",
        *GAIN_CERTIFICATES,
        "synthesis",
    ),
    "a compiled kernel of the plant": ("plants/dc_motor_kernel.py", *PLANT_KERNEL, "dataset"),
    "a compiled kernel of the design": ("synthesis/game_kernel.py", *DESIGN_KERNEL, "synthesis"),
    "a constant": ("robustness/mismatch.py", *CONSTANT, "mismatch"),
    "a member found by its file": ("models/scaffolds/mlp.py", *ANY_CLASS, "model"),
}


@pytest.mark.parametrize("row", TOO_NARROW)
def test_no_dependency_is_overlooked(row: str, scratch: Path, simulated: Specification) -> None:
    *change, stage = TOO_NARROW[row]
    stale_stages = stale(simulated, scratch, *change)
    assert stage in stale_stages


PLUG_IN = """
from ssm_study.synthesis.problem import Problem
from ssm_study.synthesis.theorems.guaranteed_cost import guaranteed_cost

class OwnTheorem:
    def solve(self, problem: Problem):
        from own.gains import factor
        return factor(guaranteed_cost(problem))
"""


EDITS_OF_A_PLUG_IN = [
    ("own/theorem.py", "return factor", "return 2 * factor"),
    ("own/gains.py", "return x", "return -x"),
    ("ssm_study/synthesis/guaranteed_cost.py", r"^def guaranteed_cost\(", "@edited\n\\g<0>"),
]


@pytest.mark.parametrize(("file", "pattern", "instead"), EDITS_OF_A_PLUG_IN)
def test_a_plug_in_counts_also_what_it_imports_by_an_old_name(
    file: str, pattern: str, instead: str, scratch: Path, tmp_path: Path
) -> None:
    """Its own code, what its functions import, and ours under the names of an earlier version."""
    own = tmp_path / "own"
    own.mkdir()
    (own / "__init__.py").write_text("")
    (own / "theorem.py").write_text(PLUG_IN)
    (own / "gains.py").write_text("def factor(x):\n    return x\n")
    root = ("own.theorem", "OwnTheorem")

    def version() -> str:
        folders = {"ssm_study": scratch, "own": own}
        code = CodeReader(folders)
        return code.code_digest(root)

    before = version()
    is_ours = file.startswith("ssm_study")
    package = scratch.parent if is_ours else tmp_path
    text = edit(package, file, pattern, instead)
    after = version()
    (package / file).write_text(text)
    assert after != before
    assert version() == before
