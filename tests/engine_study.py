"""A study of nothing, with jobs that behave as badly as asked: what the engine's tests run in real
processes."""

import ctypes
import importlib
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Set
from pathlib import Path
from typing import Any

from ssm_study.engine.program import main
from ssm_study.engine.runs import Run
from ssm_study.engine.settings import Settings
from ssm_study.engine.stages import Stage, Stages
from ssm_study.engine.task import Task
from ssm_study.refusal import require

SETTINGS = {"run": "${run_name:}", "seed": 0, "do": "work", "rate": 1}


def read(folder: Path) -> float:
    text = (folder / "number.json").read_text()
    content = json.loads(text)
    number = content["number"]
    return float(number)


def compute(folder: Path, *_: float, **asked: Any) -> None:
    ledger = folder.parents[2] / "ledger"
    with ledger.open("a") as stream:
        stream.write(f"{folder.parent.name} {asked}\n")
    work_s = os.environ.get("WORK_S", "0")
    seconds = float(work_s)
    time.sleep(seconds)
    number = 10.0 * asked["seed"]
    content = {"number": number}
    text = json.dumps(content)
    (folder / "number.json").write_text(text)


DATA = Stage(name="data", compute=compute, read=read)
MODEL = Stage(
    name="model", compute=compute, read=read, measure=lambda number, _: {"number": number}
)


class Badly(Task[Settings]):
    def build_request(self, config: Settings) -> Settings:
        condition = config.seed >= 0
        require(condition, "seed", config.seed, "negative", "give 0 or more")
        return config

    def run_stages(self, request: Settings, stages: Stages) -> None:
        settings = {"seed": request.seed}
        data = stages.run_stage(DATA, settings)
        settings = {"rate": request.rate, "seed": request.seed}
        stages.run_stage(MODEL, settings, None, data)

    def parameters(self, request: Settings) -> dict[str, Any]:
        return {"seed": request.seed, "rate_controller": request.rate}

    def final_columns(self, request: Settings, run: Run) -> dict[str, Any]:
        BEHAVIOUR[request.do](run)
        number = run.facts["number"]
        model_path = run.path / "model.json"
        content = {"number": number}
        text = json.dumps(content)
        model_path.write_text(text)
        fit_test_percent = number + request.rate
        return {
            "fit_test_percent": fit_test_percent,
            "stable_fraction": 1.0,
            "threads_seen": _threads(request),
        }

    def preload_modules(self, stages_to_compute: Set[str]) -> None:  # noqa: ARG002
        warm_modules = os.environ.get("WARM", "")
        modules = filter(None, warm_modules.split())
        for module in modules:
            importlib.import_module(module)


def _threads(config: Settings) -> int | None:
    if config.do != "threads":
        return None
    import torch

    return torch.get_num_threads()


def _raise(_: Run) -> None:
    raise RuntimeError("the bad job")


def _hang(_: Run) -> None:
    subprocess.Popen(["sleep", "86399"])  # a child that must not outlive the job
    time.sleep(86399)


def _wait(run: Run) -> None:
    """Not done before someone says go; leaves a child behind."""
    subprocess.Popen(["sleep", "86399"])
    while not (run.path.parents[1] / "go").exists():
        time.sleep(0.02)


def _segfault(_: Run) -> None:
    ctypes.string_at(0)


def _exhaust(_: Run) -> None:
    """The system refuses more memory: Python raises MemoryError."""
    limits = (1 << 33, 1 << 33)
    resource.setrlimit(resource.RLIMIT_AS, limits)
    bytearray(1 << 34)


def _devour(_: Run) -> None:
    """The system grants more memory than there is, and kills when it is used."""
    taken = []
    while True:
        chunk = b"x" * (1 << 24)
        taken.append(chunk)


def _infeasible(run: Run) -> None:
    run.add_columns(status="infeasible", infeasible_reason="the rate is below the limit")


HARMLESS = {"work": lambda _: None, "threads": lambda _: None}
EXITS = {"exit": lambda _: sys.exit(3), "os_exit": lambda _: os._exit(4)}
SIGNALS = {
    "kill": lambda _: os.kill(os.getpid(), 9),
    "terminate": lambda _: os.kill(os.getpid(), 15),
    "realtime": lambda _: os.kill(os.getpid(), 35),
    "interrupt": lambda _: os.kill(os.getpid(), 2),
}
BAD_JOBS = {
    "raise": _raise,
    "segfault": _segfault,
    "memory": _exhaust,
    "devour": _devour,
    "hang": _hang,
    "wait": _wait,
    "infeasible": _infeasible,
}
BEHAVIOUR = {**HARMLESS, **EXITS, **SIGNALS, **BAD_JOBS}

if __name__ == "__main__":
    main(Badly(), SETTINGS)
