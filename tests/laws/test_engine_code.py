"""Keys follow from code: an edit makes exactly those stages stale whose result it can change."""

import re
import shutil
import sys
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import pytest

from ssm_study.engine import fingerprint as code
from ssm_study.engine.fingerprint import CodeReader, code_version, find_symbol, library_version
from ssm_study.study.stages.bounds import BOUNDS
from ssm_study.study.stages.catalogue import STAGES
from ssm_study.study.stages.dataset import DATASET
from ssm_study.study.stages.loop import LOOP
from ssm_study.study.stages.model import MODEL
from ssm_study.study.stages.synthesis import SYNTHESIS

ROOT = Path(__file__).resolve().parents[2]
SIMULATED_MOTOR = ("ssm_study.plants.dc_motor.DCMotor", "ssm_study.data.simulated.SimulatedData")
TRAINED_MODEL = ("ssm_study.models.spec.SSMSpec", "ssm_study.training.training.Training")
LOOP_OF_MOTOR = ("ssm_study.plants.dc_motor.DCMotor", "ssm_study.loop.regulation.LoopExperiment")
TARGETS = {
    DATASET.name: SIMULATED_MOTOR,
    MODEL.name: TRAINED_MODEL,
    BOUNDS.name: ("ssm_study.bounds.reduction.Reduction",),
    SYNTHESIS.name: ("ssm_study.synthesis.minimum_energy.ClosedFormSynthesis",),
    LOOP.name: LOOP_OF_MOTOR,
}


pytestmark = pytest.mark.usefixtures("each_text_scanned_once")


def versions(folder: Path) -> dict[str, str]:
    """Version by stage of what computes it, and of what measures it, over the sources in
    `folder`."""
    sources = CodeReader({"ssm_study": folder})
    digests = {}
    for stage in STAGES:
        names = TARGETS.get(stage.name, ())
        targets = [find_symbol(target) for target in names]
        symbol = find_symbol(stage.compute)
        digests[stage.name] = sources.code_digest(symbol, *targets)
        symbol = find_symbol(stage.measure)
        digests[f"{stage.name} measured"] = sources.code_digest(symbol)
    return digests


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    compiled_files = shutil.ignore_patterns("*.pyc")
    copied = tmp_path / "ssm_study"
    return Path(shutil.copytree(ROOT / "ssm_study", copied, ignore=compiled_files))


def stale(folder: Path, file: str, pattern: str, instead: str) -> set[str]:
    """The stages that an edit makes stale: the first match of `pattern` in `file` becomes
    `instead`."""
    path = folder / file
    before = versions(folder)
    text = path.read_text()
    edited, count = re.subn(pattern, instead, text, count=1, flags=re.MULTILINE)
    assert count == 1, f"{pattern} is not in {file}"
    path.write_text(edited)
    after = versions(folder)
    path.write_text(text)
    versions_after = after.items()
    return {name for name, version in versions_after if version != before[name]}


def test_a_comment_a_docstring_and_layout_change_nothing(scratch: Path) -> None:
    docstring = (r'^"""[^"]*"""', '"""Another one."""')
    edited = stale(scratch, "study/stages/dataset.py", *docstring)
    assert edited == set()
    comment = (r"^import numpy as np$", "# why\nimport numpy as np\n\n")
    edited = stale(scratch, "plants/dc_motor.py", *comment)
    assert edited == set()
    sentence = (r'"""Simulate a model in', '"""Simulation of a model in')
    edited = stale(scratch, "training/fit.py", *sentence)
    assert edited == set()


def test_a_metric_is_measured_again_and_nothing_else(scratch: Path) -> None:
    edit = (r"stable_count = len", "stable_count = 1 + len")
    assert stale(scratch, "loop/metrics.py", *edit) == {"loop measured"}
    edited = stale(
        scratch,
        "data/metrics.py",
        r"^def input_coverage\((.*)\) -> float:$",
        r"def input_coverage(\1):",
    )
    assert edited == {"dataset measured"}


def test_a_plant_is_stale_where_it_is_named(scratch: Path) -> None:
    edit = (r"^class DCMotor\(", "class DCMotor(object, ")
    expected = {"dataset", "loop"}
    edited = stale(scratch, "plants/dc_motor.py", *edit)
    assert edited == expected
    never_named = stale(
        scratch,
        "plants/cascaded_tanks.py",
        r"^class CascadedTanks\(",
        "class CascadedTanks(object, ",
    )
    assert never_named == set()


def test_training_does_not_make_data_stale_nor_the_other_way_round(scratch: Path) -> None:
    edit = (r"^STILL_EPOCHS = 2$", "STILL_EPOCHS = 3")
    edited = stale(scratch, "training/saving.py", *edit)
    assert "model" in edited
    edited = stale(scratch, "training/saving.py", *edit)
    assert edited == {"model"}
    edit = (r"^def simulate_closed_loop\(", "@staticmethod\ndef simulate_closed_loop(")
    edited = stale(scratch, "loop/rollout.py", *edit)
    assert "dataset" not in edited


def test_what_a_cache_knows_of_a_file_ends_with_its_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And is not read twice while that stays the same."""
    file = tmp_path / "one.py"
    scans = list[Path]()
    scan = code._scan_source
    monkeypatch.setattr(code, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(
        code, "_scan_source", lambda path, module: scans.append(path) or scan(path, module)
    )

    def read() -> set[str]:
        module = code._scan_module(file, "one")
        parts = module.parts
        return set(parts)

    file.write_text("first = 1\n")
    assert read() == read() == {"first"}
    assert len(scans) == 1
    file.write_text("second = 2\n")
    assert read() == {"second"}


def test_an_import_inside_a_function_counts(scratch: Path) -> None:
    """`compute_synthesis` imports the slopes inside itself."""
    edited = stale(
        scratch,
        "bounds/slopes.py",
        r"^def certified_balls\(",
        "@staticmethod\ndef certified_balls(",
    )
    assert "synthesis" in edited
    unrelated = {"dataset", "model", "dataset measured", "model measured"}
    assert not edited & unrelated


TOY = {
    "a.py": "from toy.b import used\n\ndef root(x):\n    return used(x)\n",
    "b.py": "import numpy as np\n\nSCALE = 2\nif SCALE:\n    SHIFT = 1\n\ndef used(x):\n    from "
    "toy.c import inner\n"
    "    return inner(x) * SCALE + SHIFT\n\ndef unused(x):\n    return np.zeros(x)\n",
    "room/__init__.py": "",
    "room/member.py": "from ..e import near\nfrom .beside import said\n\nfound = 1, near, said\n",
    "room/beside.py": "said = 1\n",
    "e.py": "near = 1\nfar = 1\n",
    "c.py": "from toy import room\n\ndef inner(x: 'Hint') -> 'Hint':\n"
    "    try:\n        return deep(room, x)\n    finally:\n        pass\n\n"
    "def deep(room, x):\n    return x\n",
    "__init__.py": "from toy.d import everything\n",
    "d.py": "everything = 1\n",
}
COUNTING_EDITS = [
    ("b.py", "SCALE = 2", "SCALE = 3"),
    ("b.py", "SHIFT = 1", "SHIFT = 2"),
    ("c.py", "    return x", "    return -x"),
    ("c.py", "'Hint'", "'Other'"),
    ("room/member.py", "= 1", "= 2"),
    ("room/beside.py", "= 1", "= 2"),
    ("e.py", "near = 1", "near = 2"),
    ("b.py", "def unused", "def used(x):\n    return 0\n\ndef unused"),
    ("b.py", "SCALE = 2", "SCALE = 2\nSCALE += 1"),
    ("b.py", "SCALE = 2", "SCALE = 2\nprint('at import')"),
]
OTHER_EDITS = [
    ("e.py", "far = 1", "far = 2"),
    ("b.py", "np.zeros", "np.ones"),
    ("d.py", "= 1", "= 2"),
    ("b.py", "def unused", "def another"),
    ("a.py", "def root(x):\n", 'def root(x):\n    """Said."""\n'),
]
EDITS = dict.fromkeys(COUNTING_EDITS, True) | dict.fromkeys(OTHER_EDITS, False)


@pytest.mark.parametrize(("edit", "counts"), EDITS.items(), ids=lambda x: str(x)[:40])
def test_every_symbol_that_is_reached_counts_and_no_other(
    tmp_path: Path, edit: tuple[str, str, str], counts: bool
) -> None:
    (tmp_path / "room").mkdir()
    for name, text in TOY.items():
        (tmp_path / name).write_text(text)
    folders = {"toy": tmp_path}
    root = ("toy.a", "root")
    before = CodeReader(folders).code_digest(root)
    file, old, new = edit
    assert old in TOY[file]
    edited = TOY[file].replace(old, new, 1)
    (tmp_path / file).write_text(edited)
    folders = {"toy": tmp_path}
    digest = CodeReader(folders).code_digest(root)
    assert (digest != before) is counts


def test_a_library_counts_by_its_version_where_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "room").mkdir()
    for name, text in TOY.items():
        (tmp_path / name).write_text(text)

    def seen(root: str) -> str:
        folders = {"toy": tmp_path}
        symbol = ("toy.b", root)
        return CodeReader(folders).code_digest(symbol)

    before = seen("used"), seen("unused")
    monkeypatch.setattr("ssm_study.engine.fingerprint.library_version", lambda name: f"{name} 99")
    assert seen("used") == before[0]
    assert seen("unused") != before[1]


def test_a_library_under_another_name_is_found_by_its_files() -> None:
    installed = version("python-flint")
    found = library_version("flint")
    assert found == f"python-flint {installed}"


KINDS_OF_INSTALLATION = [True, False]


@pytest.mark.parametrize("is_installed", KINDS_OF_INSTALLATION)
def test_a_library_in_a_folder_of_its_own_counts_by_its_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_installed: bool
) -> None:
    """`pip install --target FOLDER` puts the `.dist-info` beside the package; the sources of a
    clone have none beside them."""
    monkeypatch.syspath_prepend(tmp_path)
    name = f"toy_library_{is_installed}".lower()
    package = tmp_path / name
    package.mkdir()
    (package / "__init__.py").write_text("constant = 1\n")
    if is_installed:
        (tmp_path / f"{name}-1.0.dist-info").mkdir()
    is_followed = CodeReader()._is_source_read(name)
    assert is_followed is not is_installed


def test_a_compiled_module_has_no_source_to_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part of a followed package that is compiled, as a file or by its package's own start."""
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "toy_compiled"
    package.mkdir()
    (package / "__init__.py").write_text("constant = 1\n")
    part = ModuleType("toy_compiled.part")
    monkeypatch.setitem(sys.modules, "toy_compiled.part", part)
    source = CodeReader()._source_path("toy_compiled.part")
    assert source is None
    part.__file__ = str(package / "part.cpython-312-x86_64-linux-gnu.so")
    source = CodeReader()._source_path("toy_compiled.part")
    assert source is None


def test_a_name_that_is_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="no_such_name"):
        code_version("ssm_study.signals.no_such_name")
