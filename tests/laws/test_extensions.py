"""Other people's packages and folders bring plants, theorems, figures and experiments; no file of
ours changes."""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fresh_programs import Ended, start_program
from omegaconf import OmegaConf

from ssm_study import extensions
from ssm_study.certificates.theorem import find_theorem
from ssm_study.cli.main import main
from ssm_study.cli.new_study import write_study_template
from ssm_study.data import readers
from ssm_study.data.readers.reader import Reader
from ssm_study.refusal import BadRequest
from ssm_study.report.run_facts import read_extension_theorems
from ssm_study.study.allow_list import refuse_foreign_targets

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "tclab_study"
SMALL = [
    "data.samples=200",
    "data.validation_samples=200",
    "data.test_samples=200",
    "training.max_epochs=2",
]
OF_THE_LABORATORY = [*SMALL, "data.trajectories=2", "data.fresh_sets=0", "+data.trials=false"]
OF_THE_LABORATORY += ["synthesis=reserved", "model.order=2"]
OF_THE_LABORATORY += ["~loop.comparison", "loop.initial_conditions=2"]
# The command, but for the two figures that a run draws.
UNDRAWN = """
import os, sys
os.chdir(ROOT)
sys.path.insert(0, PLACE)
from ssm_study.cli import summary
from ssm_study.cli.main import main
summary.RUN_FIGURES = ()
sys.exit(main(WORDS))
"""


@pytest.fixture
def trusting(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Whatever a test trusts is forgotten after it."""
    monkeypatch.setenv(extensions.FOLDER, "")
    path = list(sys.path)
    monkeypatch.setattr(sys, "path", path)
    extensions.trusted_packages.cache_clear()
    yield
    monkeypatch.undo()
    extensions.trusted_packages.cache_clear()


@pytest.mark.usefixtures("trusting")
def test_a_theorem_in_a_package_of_ones_own_is_found_by_the_name_of_its_file(
    tmp_path: Path,
) -> None:
    """Nothing has imported its module before; a module of another name is not imported."""
    package = tmp_path / "vertex_laboratory"
    inner = package / "proofs"
    inner.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (inner / "__init__.py").write_text("")
    (package / "broken_figure.py").write_text("raise RuntimeError('imported')\n")
    template = ROOT / "ssm_study" / "certificates" / "theorems" / "_template.py"
    text = template.read_text().replace(", abstract=True", "")
    (inner / "vertex_feedback.py").write_text(text)
    with pytest.raises(BadRequest, match="not a theorem that this installation has"):
        find_theorem("vertex_feedback")
    extensions.trust_package(package)
    theorem = find_theorem("vertex_feedback")
    assert theorem.__module__ == "vertex_laboratory.proofs.vertex_feedback"
    stored = {"state_feedback": {"theorem": "vertex_feedback"}, "observer": {}}
    (tmp_path / "certificate.json").write_text(json.dumps(stored))
    actual = read_extension_theorems(tmp_path)
    assert actual == {"controller": "vertex_feedback"}
    for damaged in ("[1]", '{"state_feedback": null}', '{"state_feedback": 1', ""):
        (tmp_path / "certificate.json").write_text(damaged)
        assert read_extension_theorems(tmp_path) == {}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example where pip puts it; setuptools builds in a copy, for it leaves files beside the
    sources."""
    spec = importlib.util.find_spec("setuptools")
    if spec is None or importlib.util.find_spec("pip") is None:
        pytest.skip("pip and setuptools are needed to install the example")
    place = tmp_path_factory.mktemp("site")
    copy = tmp_path_factory.mktemp("source")
    paths = EXAMPLE.rglob("*")
    for file in (path for path in paths if path.suffix in (".py", ".yaml", ".toml", ".md")):
        parent = (copy / file.relative_to(EXAMPLE)).parent
        parent.mkdir(parents=True, exist_ok=True)
        (copy / file.relative_to(EXAMPLE)).write_bytes(file.read_bytes())
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    subprocess.run([*pip, "--target", place, copy], check=True)
    return place


# Its own process is no worker of this test run, and shares no folder with one.
JUDGE = """
import os, sys
import pytest
for name in [name for name in os.environ if name.startswith("PYTEST_XDIST")]:
    del os.environ[name]
os.environ.update(ENVIRONMENT)
os.chdir(ROOT)
sys.path.insert(0, PLACE)
sys.exit(pytest.main(WORDS))
"""


def judge(place: Path, folder: Path, *words: object, **environment: str) -> Ended:
    """Pytest in a process of its own, asked as the owner of a package in `place` would ask."""
    text = JUDGE.replace("ENVIRONMENT", repr(environment))
    return do_beside(place, folder, text, *words)


def do_beside(place: Path, folder: Path, program: str, *words: object) -> Ended:
    """Do a program with the words, where the packages in `place` can be imported."""
    texts = [str(word) for word in words]
    values = {"ROOT": str(ROOT), "PLACE": str(place), "WORDS": texts}
    for name, value in values.items():
        program = program.replace(name, repr(value))
    return start_program(program, folder).wait(timeout_s=250)


def fingerprint() -> str:
    whole = hashlib.sha256()
    for folder in ("ssm_study", "conf", "hydra_plugins"):
        paths = (ROOT / folder).rglob("*")
        for path in sorted(p for p in paths if p.suffix in (".py", ".yaml", ".txt")):
            whole.update(str(path).encode() + path.read_bytes())
    return whole.hexdigest()


def test_an_installed_package_goes_the_whole_way(
    installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = fingerprint()
    place = f"results_dir={tmp_path}"
    asked = ["run", "experiment=tclab", *OF_THE_LABORATORY, "progress=false", place]
    assert main(asked) == 2
    assert "there is no experiment/tclab" in capsys.readouterr().err
    done = do_beside(installed, tmp_path / "program", UNDRAWN, *asked)
    assert done.returncode == 0, done.stderr
    (path,) = tmp_path.glob("tclab/*/record.json")
    text = path.read_text()
    record = json.loads(text)
    assert record["plant"] == "TemperatureLab"
    assert record["synthesis_method"] == "reserved"
    assert record["controller_certified"]
    assert fingerprint() == before


def test_the_package_conforms(installed: Path, tmp_path: Path) -> None:
    """Its figures are drawn as well; asked as its owner would, without the options of our own
    tests."""
    package = ["--pyargs", "ssm_study.conformance", "-k", "(tclab and not experiment) or reserved"]
    plain = ["-q", "-o", "addopts=", "-p", "no:cacheprovider"]
    done = judge(installed, tmp_path / "program", *package, *plain)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "passed" in done.stdout


@pytest.mark.usefixtures("trusting")
def test_a_folder_of_ones_own_runs_as_it_was_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "own_study"]) == 0
    asked = ["run", "experiment=own_study", *SMALL, "progress=false"]
    plant = {"_target_": "own_study.plant.OwnPlant"}
    named = OmegaConf.create({"plant": plant})
    with monkeypatch.context() as there:
        there.syspath_prepend(tmp_path)  # importable, and yet not trusted
        with pytest.raises(BadRequest, match="may not create this class"):
            refuse_foreign_targets(named)
    actual = main([*asked, "--with", "own_study"])
    assert actual == 0
    trusted = {extensions.FOLDER: os.environ[extensions.FOLDER]}
    done = judge(tmp_path, tmp_path / "program", "-q", tmp_path / "own_study", **trusted)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "passed" in done.stdout
    refuse_foreign_targets(named)


@pytest.mark.usefixtures("trusting")
@pytest.mark.parametrize(
    ("name", "made", "said"),
    [
        ("nowhere", False, "is no study folder; make one: ssm-study new"),
        ("two-words", True, "is no study folder"),
        ("json", True, "the name json is taken by"),
    ],
)
def test_no_other_folder_is_trusted(tmp_path: Path, name: str, made: bool, said: str) -> None:
    if made:
        (tmp_path / name).mkdir()
        init_path = tmp_path / name / "__init__.py"
        init_path.touch()
    with pytest.raises(BadRequest, match=said):
        extensions.trust_package(tmp_path / name)
    arguments = ["verify", "run", "--with"]
    with pytest.raises(BadRequest, match="names no folder"):
        extensions.pop_extension_option(arguments)


def test_new_refuses(tmp_path: Path) -> None:
    for name, said in (("Two Words", "cannot name a package"), ("json", "an installed package")):
        with pytest.raises(BadRequest, match=said):
            write_study_template(tmp_path / name)
    write_study_template(tmp_path / "mine")
    with pytest.raises(BadRequest, match="exists"):
        write_study_template(tmp_path / "mine")


@pytest.mark.usefixtures("trusting")
def test_what_is_found_by_its_kind_is_found_in_a_trusted_package(tmp_path: Path) -> None:
    """A reader, by its suffix; from a package that is not trusted it is unknown."""
    (tmp_path / "logs_of_mine").mkdir()
    init_path = tmp_path / "logs_of_mine" / "__init__.py"
    init_path.write_text(
        "from ssm_study.data.readers.reader import Reader\n"
        "class Mine(Reader, names=('.mine',)):\n"
        "    def read_columns(self, path, names): raise NotImplementedError\n"
    )
    assert ".mine" not in Reader.members(readers)
    extensions.trust_package(tmp_path / "logs_of_mine")
    try:
        reader = Reader.members(readers)
        assert reader[".mine"].__module__ == "logs_of_mine"
    finally:
        Reader.known.pop(".mine", None)
