"""Pytest plugin that records which tests execute which lines: what `mutation.py --table` reads.

    pip install coverage
    export MUTATION_TABLE=/tmp/table HYPOTHESIS_PROFILE=few PYTHONPATH=benchmarks
    pytest -p mutation_table -p no:randomly -o addopts= --timeout=300 -m "not long"
    coverage combine --keep --rcfile=benchmarks/mutation_table.ini
    cp -r ssm_study $MUTATION_TABLE/

`$MUTATION_TABLE` is the folder of the table, outside the repository. A second call goes on with the
tests that are not recorded yet; `$MUTATION_TABLE_S` ends a call after so many seconds. What a
test's fixtures execute has the context `setup:TEST`; processes that a test starts count as its own.
"""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import coverage
import pytest

TIMES = Path(os.environ["MUTATION_TABLE"]) / "times.jsonl"
STARTED_S = time.monotonic()
LIMIT_S = float(os.environ.get("MUTATION_TABLE_S", "inf"))
SETTINGS = Path(__file__).with_suffix(".ini")
RUNNING: list[coverage.Coverage] = []


def pytest_collection_finish() -> None:
    """Begin to record: what importing the modules executes is not asked for."""
    running = coverage.Coverage(config_file=str(SETTINGS))
    running.start()
    RUNNING.append(running)


def pytest_unconfigure() -> None:
    """Write what is not written yet."""
    for running in RUNNING:
        running.stop()
        running.save()


def begin_context(name: str) -> None:
    """Attribute what is executed from now on, in forks and started processes too, to `name`."""
    (running,) = RUNNING
    running.switch_context(name)
    running.config.context = name
    os.environ["COVERAGE_PROCESS_CONFIG"] = running.config.serialize()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave out the tests that are recorded."""
    lines = TIMES.read_text().splitlines() if TIMES.exists() else []
    recorded = {json.loads(line)["test"] for line in lines}
    items[:] = [item for item in items if item.nodeid not in recorded]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Record the time of each test; stop when the limit is reached."""
    if time.monotonic() - STARTED_S > LIMIT_S:
        item.session.shouldstop = "time is over"
    start_s = time.monotonic()
    begin_context(f"setup:{item.nodeid}")
    outcome = yield
    spent_s = round(time.monotonic() - start_s, 3)
    shares = "smoke_study" in getattr(item, "fixturenames", ())
    with TIMES.open("a") as file:
        record = {"test": item.nodeid, "s": spent_s, "shares_run": shares}
        file.write(json.dumps(record) + "\n")
    return outcome


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Attribute the lines of the test itself to it."""
    begin_context(item.nodeid)
    return (yield)
