"""Every file, module and test that the pages name is there: what moves in the code moves in its
documentation."""

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ssm_study"
PAGES = [*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
SETTINGS = [*ROOT.glob("conf/**/*.yaml"), ROOT / "mkdocs.yml", ROOT / "Makefile"]
FOLDERS = (
    "ssm_study|hydra_plugins|benchmarks|conf|docs|examples|experiments|tests|results/reference"
)
ROOM_NAMES = [path.name for path in PACKAGE.iterdir() if path.is_dir()]
ROOMS = "|".join(sorted(ROOM_NAMES))
FILE = re.compile(rf"(?<![\w./-])((?:{FOLDERS}|{ROOMS})/[\w./*-]*\w)")
MODULE = re.compile(r"(?<![\w./-])ssm_study((?:\.\w+)+)")
TEST = re.compile(r"(test_\w+\.py)?(?:::(test_\w+))")
# A page may tell its reader to write a file: those it shows with a title, and their classes. One
# page may name what another shows.
TO_WRITE = re.compile(r'(?:title|file)="([^"]+)"|# (conf/\S+\.yaml):')


def named_files(text: str) -> set[str]:
    to_write: set[str] = set()
    for page in PAGES:
        for pair in TO_WRITE.findall(page.read_text()):
            to_write.update(pair)
    names = FILE.findall(text)
    return {name for name in names if name not in to_write}


def named_modules(text: str) -> set[str]:
    to_write = TO_WRITE.findall(text)
    files = [file for file, _ in to_write if file]
    own = tuple(file.removesuffix(".py").replace("/", ".") for file in files)
    paths = MODULE.findall(text)
    return {path for path in paths if not f"ssm_study{path}".startswith(own or "\0")}


def exists(file: str) -> bool:
    bases = (ROOT, PACKAGE, ROOT / "conf")
    matches = [list(base.glob(file)) for base in bases]
    return any(matches)


def defined(dotted: str) -> bool:
    """`.room.module.Name`: the longest part of it that is a module defines or imports what
    follows."""
    parts = dotted.strip(".").split(".")
    for length in range(len(parts), -1, -1):
        base = PACKAGE.joinpath(*parts[:length])
        file = base.with_suffix(".py")
        module = file if length and file.exists() else base / "__init__.py"
        if module.exists():
            if length == len(parts):
                return True
            name = rf"\b{parts[length]}\b"
            return re.search(name, module.read_text()) is not None
    return False


EVERYWHERE = [*PAGES, *SETTINGS]


@pytest.mark.parametrize("page", EVERYWHERE, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_page_names_is_there(page: Path) -> None:
    text = page.read_text()
    names = sorted(named_files(text))
    missing = [name for name in names if not exists(name)]
    assert missing == []
    names = sorted(named_modules(text))
    undefined = [f"ssm_study{name}" for name in names if not defined(name)]
    assert undefined == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_the_tests_that_a_page_cites_are_there(page: Path) -> None:
    paths = ROOT.glob("tests/**/test_*.py")
    suite = {path.name: path.read_text() for path in paths}
    text = page.read_text()
    for file, test in TEST.findall(text):
        sources = [suite.get(file, "")] if file else suite.values()
        assert any(f"def {test}(" in source for source in sources), f"{file}::{test}"


def test_a_file_that_is_not_there_is_found() -> None:
    assert not exists("ssm_study/synthesis/nowhere.py")
    assert not defined(".synthesis.frontier.NoSuchName")
    assert not defined(".synthesis.nowhere")
    actual = named_files("see `engine/nowhere.py`")
    assert actual == {"engine/nowhere.py"}


def test_seeded_faults_are_planted_in_modules_that_are_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also the tests that are to catch them."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    mutation = import_module("mutation")
    for group in mutation.GROUPS.values():
        for module in group.modules:
            assert (ROOT / "ssm_study" / module).exists(), module
        for named in re.findall(r"tests/\S+", group.tests):
            file, _, test = named.partition("::")
            text = (ROOT / file).read_text()
            assert f"def {test}" in text, named


def test_every_benchmark_stands_in_their_index() -> None:
    readme_path = ROOT / "benchmarks" / "README.md"
    index = readme_path.read_text()
    paths = (ROOT / "benchmarks").glob("*.[ps][yh]")
    scripts = {path.name for path in paths}
    unnamed = {name for name in scripts if f"`{name}`" not in index}
    assert unnamed == set()
