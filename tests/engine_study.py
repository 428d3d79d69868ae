"""A study of nothing, with jobs that behave as badly as asked: what the engine's tests run in real processes."""

import ctypes
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf

from ssm_study.refusal import require
from ssm_study.results.keys import code_version
from ssm_study.results.runs import Run, execute
from ssm_study.results.store import StageResult, Stages, Store
from ssm_study.sweeps.groups import Sharing

CONF = {
    "study": "study",
    "results_dir": "???",
    "seed": 0,
    "retry_failed": False,
    "dry_run": False,
    "do": "work",
    "rate": 1,
    "work_s": 0.0,
    "together": "no",
}


def check(config: DictConfig) -> None:
    require(config.seed >= 0, "seed", config.seed, "negative", "give 0 or more")


def job(config: DictConfig) -> str:
    folder = Path(config.results_dir) / config.study / str(OmegaConf.select(config, "name"))
    text = {"config.yaml": OmegaConf.to_yaml(config, resolve=True)}
    parameters = {"seed": config.seed, "rate_controller": config.rate}
    return execute(
        folder,
        parameters,
        lambda run: _work(config, run),
        configuration=text,
        retry_failed=config.retry_failed,
    ).status


def _work(config: DictConfig, run: Run) -> dict[str, object]:
    data, model = walk(config, Store(Path(config.results_dir) / ".store"))
    run.stage(data)
    run.stage(model)
    BEHAVIOUR[config.do](run)
    number = float(json.loads((data.path / "data.json").read_text())["number"])
    (run.path / "model.json").write_text(json.dumps({"number": number}))
    return {"fit_test_percent": number + config.rate, "stable_fraction": 1.0, "threads_seen": _threads(config)}


def walk(config: DictConfig, stages: Stages) -> tuple[StageResult, StageResult]:
    version = code_version("refusal")
    data = stages.stage("data", {"seed": config.seed}, [], version, lambda f: _compute(f, config, "data"))
    model = stages.stage("model", {"rate": config.rate}, [data.key], version, lambda f: _compute(f, config, "model"))
    return data, model


def sharing(config: DictConfig, stages: Stages) -> Sharing | None:
    """One kind of model per rate; `together` says what the program that trains them does."""
    model = walk(config, stages)[1]
    return None if config.together == "no" or model.reused else Sharing(kind=str(config.rate), key=model.key)


def train_members(configs: list[DictConfig]) -> None:
    with (Path(configs[0].results_dir) / "programs").open("a") as stream:
        stream.write(" ".join(str(config.seed) for config in configs) + "\n")
    for config in configs[: 1 if configs[0].together == "killed" else None]:
        walk(config, Store(Path(config.results_dir) / ".store"))
    if configs[0].together == "killed":
        os.kill(os.getpid(), 9)
    if configs[0].together == "hangs":
        time.sleep(86399)


def _compute(folder: Path, config: DictConfig, name: str) -> None:
    ledger = Path(config.results_dir) / "ledger"
    with ledger.open("a") as stream:
        stream.write(f"{name} {config.seed} {config.rate if name == 'model' else ''}\n")
    time.sleep(config.work_s)
    (folder / f"{name}.json").write_text(json.dumps({"number": 10.0 * config.seed}))


def _threads(config: DictConfig) -> int | None:
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
    resource.setrlimit(resource.RLIMIT_AS, (1 << 33, 1 << 33))
    bytearray(1 << 34)


def _devour(_: Run) -> None:
    """The system grants more memory than there is, and kills when it is used."""
    taken = []
    while True:
        taken.append(b"x" * (1 << 24))


def _infeasible(run: Run) -> None:
    run.note(status="infeasible", infeasible_reason="the rate is below the limit")


BEHAVIOUR = {
    "work": lambda _: None,
    "threads": lambda _: None,
    "raise": _raise,
    "exit": lambda _: sys.exit(3),
    "os_exit": lambda _: os._exit(4),
    "kill": lambda _: os.kill(os.getpid(), 9),
    "terminate": lambda _: os.kill(os.getpid(), 15),
    "realtime": lambda _: os.kill(os.getpid(), 35),
    "interrupt": lambda _: os.kill(os.getpid(), 2),
    "segfault": _segfault,
    "memory": _exhaust,
    "devour": _devour,
    "hang": _hang,
    "wait": _wait,
    "infeasible": _infeasible,
}

HYDRA = """
hydra:
  job: {name: job, chdir: false}
  output_subdir: null
  run: {dir: "${results_dir}/${study}/${run_name:}"}
  sweep: {dir: "${results_dir}/${study}", subdir: "${run_name:}"}
  job_logging: {root: {handlers: [file]}}
  hydra_logging: {root: {handlers: []}}
"""


def main() -> None:
    folder = Path(os.environ["ENGINE_CONF"])
    if not (folder / "study.yaml").exists():
        defaults = "defaults:\n  - override hydra/launcher: processes\n  - _self_\n"
        text = defaults + OmegaConf.to_yaml(OmegaConf.create({**CONF, "name": "${run_name:}"})) + HYDRA
        temporary = folder / f"study.{os.getpid()}"
        temporary.write_text(text)
        temporary.replace(folder / "study.yaml")
    hydra.main(version_base="1.3", config_path=str(folder), config_name="study")(job)()


if __name__ == "__main__":
    main()
