"""Settings every test shares: hypothesis profiles, one torch thread, and where the benchmark
records lie."""

import io
import os
import shutil
from pathlib import Path

os.environ.setdefault(
    "OMP_NUM_THREADS", "1"
)  # two workers with default threads are 20 times slower than one

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache, wraps
from inspect import isclass, isfunction
from pkgutil import resolve_name
from types import CodeType
from typing import Any

import jaxtyping
import pytest
from computed_once import MADE_AGAIN, READERS, once, once_for_content
from hydra.core.global_hydra import GlobalHydra
from hypothesis import HealthCheck, settings
from report_browser import chromium

settings.register_profile(
    "ci", max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
settings.register_profile(
    "few", max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
settings.register_profile("soak", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

REPOSITORY = Path(__file__).resolve().parents[1]
# Whole runs, verified again and again: a shape checked at each of a million steps is four fifths of
# their time, and the tests of each room check the same functions.
WHOLE_RUNS = {
    "test_api",
    "test_api_imports",
    "test_cli_guard",
    "test_cli_terminal",
    "test_contributing",
    "test_data_own_plant",
    "test_data_sets",
    "test_docs_commands",
    "test_docs_notebooks",
    "test_evidence_controls",
    "test_evidence_false_reasons",
    "test_evidence_integration",
    "test_export_device",
    "test_export_targets",
    "test_extensions",
    "test_log_to_device",
    "test_loop_within_limits",
    "test_loop_within_limits_of_two_outputs",
    "test_overlay",
    "test_results_verify",
    "test_study_answers",
    "test_study_integrating",
    "test_study_line",
    "test_study_refine",
    "test_study_requests",
    "test_table_columns",
    "test_verify_damage",
    "test_verify_form",
    "test_verify_lies",
    "test_verify_omissions",
    "test_wrong_kinds",
}
# Two fifths of the processor time: what documents show, how figures and the page look, choices by
# training, studies of hard plants. `make test` leaves them out but for README's commands.
LONG = {
    "test_coverage_sampler",
    "test_disturbance_line",
    "test_docs_commands",
    "test_docs_notebooks",
    "test_docs_site",
    "test_engine_slurm",
    "test_evidence_controls",
    "test_log_to_device",
    "test_report_certificate_figures",
    "test_report_figures",
    "test_report_page",
    "test_study_integrating",
    "test_study_refine",
    "test_titration",
    "test_training_choice",
    "test_training_short_starts",
}
# Of the whole runs, whose tests look at the figures that a run draws.
DRAWING = {"test_api", "test_docs_notebooks", "test_overlay"}


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark the tests that `make test` leaves out."""
    if item.path.stem in LONG and "[README.md" not in item.name:
        item.add_marker(pytest.mark.long)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """The modules stay until the end: no collection of garbage looks at them, while they are loaded
    or afterwards."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The long ones first, else in pytest-randomly's order: no worker begins a long one when the
    others are done."""
    items.sort(key=lambda item: item.path.stem not in WHOLE_RUNS)


# Of each function, in each test: shapes that are wrong are wrong from the first calls on, and the
# check of a call takes longer than most calls.
CHECKED_CALLS = 10


class Now:
    """The test that runs, as a number that each function compares with that of its last call."""

    test = 0


def checked_at_first(typechecker: Callable[..., Any]) -> Callable[[Any], Any]:
    """`jaxtyping.jaxtyped`, which the import hook puts on all that it loads: made and used at first
    calls alone."""

    def decorated(part: Any) -> Any:
        if isfunction(part):
            checked = cache(lambda: jaxtyped(part, typechecker=typechecker))
            local = "<locals>" in part.__qualname__
            return first_made(part, checked) if local else first(part, checked)
        if isclass(part):
            if is_dataclass(part) and not getattr(part, "__no_type_check__", False):
                plain = part.__init__
                part.__init__ = first(
                    plain, cache(lambda: jaxtyped(plain, typechecker=typechecker))
                )
            return part
        return jaxtyped(part, typechecker=typechecker)

    return decorated


def first(
    plain: Callable[..., Any], checked: Callable[[], Callable[..., Any]]
) -> Callable[..., Any]:
    """The function, checked at its first calls in each test."""
    test = -1
    calls = 0

    @wraps(plain)
    def either(*given: Any, **named: Any) -> Any:
        nonlocal test, calls
        if test != Now.test:
            test = Now.test
            calls = 0
        if calls >= CHECKED_CALLS or jaxtyping.config.jaxtyping_disable:
            return plain(*given, **named)
        calls += 1
        return checked()(*given, **named)

    return either


# Code of a function that is defined inside another one: the test in which it was last called, and
# the function of this code that is checked in that test.
LOCAL_FUNCTIONS: dict[CodeType, tuple[int, object]] = {}


def first_made(
    plain: Callable[..., Any], checked: Callable[[], Callable[..., Any]]
) -> Callable[..., Any]:
    """A local function, checked if it is the first of its code that the test calls.

    Each call of the outer function makes another, and what checks it takes longer to make than
    most tests take.
    """
    code = plain.__code__
    either_checked = first(plain, checked)

    @wraps(plain)
    def either(*given: Any, **named: Any) -> Any:
        test, owner = LOCAL_FUNCTIONS.get(code, (-1, None))
        if test != Now.test:
            owner = plain
            LOCAL_FUNCTIONS[code] = (Now.test, owner)
        return (either_checked if owner is plain else plain)(*given, **named)

    return either


jaxtyped = jaxtyping.jaxtyped
jaxtyping.jaxtyped = checked_at_first


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol() -> None:
    Now.test += 1


@contextmanager
def shapes_unchecked(unchecked: bool = True) -> Iterator[None]:
    """Without jaxtyping's check of every call; afterwards as before."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", unchecked)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", before)


def vectors_alone(savefig: Callable[..., None]) -> Callable[..., None]:
    """Half of a report's time: every figure is drawn as PDF, and as PNG in the tests of the
    figures."""

    def save(figure: Any, path: str | Path, **how: Any) -> None:
        if isinstance(path, io.BytesIO):  # written by the caller: an empty picture
            if how.get("format") != "png":
                savefig(figure, path, **how)
        elif Path(path).suffix == ".png":
            Path(path).touch()
        else:
            savefig(figure, path, **how)

    return save


@pytest.fixture(autouse=True)
def _no_composition_left() -> Iterator[None]:
    """A request composed in this process holds Hydra's one place for it: the next test begins
    without."""
    yield
    GlobalHydra.instance().clear()


@pytest.fixture(autouse=True, scope="module")
def _shapes(request: pytest.FixtureRequest) -> Iterator[None]:
    module = request.module.__name__.rpartition(".")[2]
    with shapes_unchecked(module in WHOLE_RUNS), pytest.MonkeyPatch.context() as patch:
        if (
            module in WHOLE_RUNS - DRAWING
        ):  # a third of a short run, and rendering is half of a report
            patch.setattr("ssm_study.cli.summary.RUN_FIGURES", ())
            patch.setattr(
                "matplotlib.figure.Figure.savefig",
                vectors_alone(resolve_name("matplotlib.figure:Figure.savefig")),
            )
        yield
        jaxtyping_disable = jaxtyping.config.jaxtyping_disable
        assert jaxtyping_disable == (module in WHOLE_RUNS), "a fixture left it otherwise"


@pytest.fixture(scope="module")
def made_once() -> Iterator[None]:
    """Compute a result once for equal arguments, and read a recording once for equal content.

    Most files of copies of one run, each with one file changed, are alike.
    """
    with pytest.MonkeyPatch.context() as patch:
        for place in MADE_AGAIN:
            patch.setattr(place, once(place))
        for reader in READERS:
            patch.setattr(reader, once_for_content(reader))
        yield


@pytest.fixture(scope="module")
def each_text_scanned_once() -> Iterator[None]:
    """Scan a source file once for equal content: tests read it before and after each edit."""
    from ssm_study.engine import fingerprint

    scan = fingerprint._scan_source
    scanned: dict[tuple[bytes, str, bool], fingerprint.Module] = {}

    def scan_once(path: Path, module: str) -> fingerprint.Module:
        content = path.read_bytes()
        is_package = path.name == "__init__.py"
        key = content, module, is_package
        if key not in scanned:
            scanned[key] = scan(path, module)
        return scanned[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fingerprint, "_scan_source", scan_once)
        yield


@pytest.fixture(scope="module")
def without_baselines() -> Iterator[None]:
    """Runs of a log fit no simple models to compare theirs with: a quarter of a short run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ssm_study.models.baseline_comparison.baseline_columns", lambda _: None)
        yield


@pytest.fixture(scope="session")
def benchmark_data() -> Path:
    data_path = REPOSITORY.parent / "shared" / "data"
    folder = Path(os.environ.get("SSM_STUDY_DATA", data_path))
    if not folder.is_dir():
        pytest.skip(f"benchmark records not found at {folder}; set SSM_STUDY_DATA")
    return folder


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all workers of this test run; what is made there once is made under a lock."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def _compiled_by_one_worker(shared_folder: Path) -> Iterator[None]:
    """In a fresh clone every worker needs the same machine code: one compiles a function, the
    others read what numba has stored.

    Each function has its own lock, and it is held while those that it calls are compiled.
    """
    from filelock import FileLock
    from numba.core.dispatcher import Dispatcher

    locks: dict[str, FileLock] = {}
    compile_or_load = Dispatcher.compile

    def compile_alone(dispatcher: Any, signature: Any) -> Any:
        function = dispatcher.py_func
        if not function.__module__.startswith("ssm_study"):  # numba's own, called by one of ours
            return compile_or_load(dispatcher, signature)
        name = f"{function.__module__}.{function.__qualname__}"
        if name not in locks:
            locks[name] = FileLock(shared_folder / f"{name}.lock")
        with locks[name]:
            return compile_or_load(dispatcher, signature)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dispatcher, "compile", compile_alone)
        yield


@pytest.fixture(scope="session")
def smoke_study(shared_folder: Path) -> Path:
    """`results/smoke` with one finished run of `experiment=smoke`, shared by all workers: read
    only."""
    from filelock import FileLock

    from ssm_study.cli.main import main

    results = shared_folder / "results"
    with FileLock(shared_folder / "smoke.lock"):
        runs_path = results / "smoke" / "runs.parquet"
        if not runs_path.exists():
            with shapes_unchecked():
                assert (
                    main(["run", "experiment=smoke", f"results_dir={results}", "progress=false"])
                    == 0
                )
    return results / "smoke"


@pytest.fixture(scope="session")
def smoke_store(smoke_study: Path) -> Path:
    """The stages of `smoke_study`: results whose `.store` is a link to it compute none of them
    again."""
    return smoke_study.parent / ".store"


@pytest.fixture(scope="session")
def smoke_run(smoke_study: Path) -> Path:
    """The run folder of `smoke_study`: read only."""
    (record,) = smoke_study.glob("*/record.json")
    return record.parent


@pytest.fixture
def copied_run(smoke_run: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be altered."""
    return shutil.copytree(smoke_run, tmp_path / smoke_run.name)


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One headless browser for every page that needs no profile of its own."""
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver
