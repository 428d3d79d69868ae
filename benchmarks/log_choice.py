"""The model that a log chooses beside the best baseline, on logs of known kind and on real ones.

    python benchmarks/log_choice.py kinds --seeds 0
    python benchmarks/log_choice.py aside --seeds 0
    python benchmarks/log_choice.py real --only heat_exchanger servo_position --seeds 0

Every log is read and fitted as the plain command does (`data=recorded`, all else at its default).
`aside` are the kinds of `log_kinds_aside.py`. One row a log and seed goes into
`log_choice_kinds.csv`, `log_choice_aside.csv` or `log_choice_real.csv` of
`results/reference/training`: the fit to the test part of the model, of what predicts where that is
another model, and of the best of ARX, output error and polynomial NARX
(`models.best_baseline.fit_best_baseline`), the points by which what predicts is ahead, the largest
rate of a certified state feedback, the processor seconds, and what was chosen. With `--plain` also
those of `model=structured` with its own defaults, which chooses nothing. Rows that are there are
not made again. One to three minutes a log on a busy core.

    python benchmarks/log_choice.py kinds --seeds 0 1 2 3 4 --jobs 16 --table kinds.csv

runs so many logs at a time, each in a process of one thread, the longest first. A row is written
when its log is done, so that a run that is killed keeps what it has. `--real-logs FOLDER` (or
`SSM_STUDY_REAL_LOGS`) says where the real logs lie, `--candidates FOLDER` receives what was tried.
"""

import argparse
import multiprocessing
import os
import re
import subprocess
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from common import REFERENCE, ROOT, keep, rows_of, study_of, write
from log_kinds import KINDS, LogKind
from log_kinds_aside import KINDS as KINDS_ASIDE

from ssm_study.bounds.slopes import certified_balls
from ssm_study.models.best_baseline import fit_best_baseline
from ssm_study.models.members import member_columns
from ssm_study.models.warm_start import simulate_validation_and_test
from ssm_study.signals import DataSet
from ssm_study.synthesis.model_selection import largest_certifiable_rate
from ssm_study.training.metrics import Identification

TARGET = REFERENCE / "training"
REAL_LOGS = ROOT.parent / "shared" / "data" / "logs_real"
FOLDER_VARIABLE = "SSM_STUDY_REAL_LOGS"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# The slowest logs, which begin first where several run at a time.
SLOWEST = (
    "heat_exchanger",
    "propeller_bench",
    "position_dead_zone",
    "bilinear",
    "hysteresis",
    "tanker",
)
# Columns of each real log, and the settings that reading it needs (docs/data.md).
REAL: dict[str, tuple[str, ...]] = {
    "heat_exchanger": (
        "data.path={folder}/heat_exchanger.dat",
        "data.input=1",
        "data.output=2",
        "data.time=0",
    ),
    "tanker": (
        "data.path=[{folder}/tanker_zigzag_10.dat]",
        "data.test_path=[{folder}/tanker_zigzag_minus20.dat]",
        "data.input=9",
        "data.output=8",
        "data.step_s=0.135",
        "data.decimate=10",
    ),
    "tanker_three_trained": (  # two of the four files are not among logs_real (docs/models.md)
        "data.path=[{folder}/tanker_zigzag_10.dat,{folder}/tanker_zigzag_minus10.dat,"
        "{folder}/tanker_zigzag_20.dat]",
        "data.test_path=[{folder}/tanker_zigzag_minus20.dat]",
        "data.input=9",
        "data.output=8",
        "data.step_s=0.135",
        "data.decimate=10",
    ),
    "propeller_bench": (
        "data.path={folder}/propeller_bench.csv",
        "data.input=Servo 3 (µs)",
        "data.output=Motor Optical Speed (RPM)",
    ),
    "servo_position": (
        "data.path={folder}/servo_position.csv",
        "data.input=inputSignal(8bits)",
        "data.output=enconder(steps)",
    ),
    "house": ("data.path={folder}/house_heat_pump.csv", "data.input=[Ph,Ta]", "data.output=Ti"),
    "house_measured_outdoors": (  # the temperature outdoors is measured, and nothing commands it
        "data.path={folder}/house_heat_pump.csv",
        "data.input=Ph",
        "data.disturbance=Ta",
        "data.output=Ti",
    ),
}


@dataclass(frozen=True, kw_only=True)
class Log:
    """A log to be fitted: its name, the seed of its generator or training, and how it is read."""

    name: str
    seed: int
    settings: tuple[str, ...]
    training_seed: int


def logs_of_kinds(
    folder: Path, names: Sequence[str], seeds: Sequence[int], kinds: Sequence[LogKind] = KINDS
) -> Iterator[Log]:
    """The synthetic logs, written to a folder."""
    for kind in kinds:
        for seed in seeds if kind.name in names or not names else ():
            table = kind.log(seed)
            path = folder / f"{kind.name}_{seed}.csv"
            table.to_csv(path, index=False)
            inputs = ",".join(name for name in table if name.startswith("u"))
            settings = (f"data.path={path}", f"data.input=[{inputs}]", "data.output=y")
            yield Log(name=kind.name, seed=seed, settings=settings, training_seed=0)


def real_logs(folder: Path, names: Sequence[str], seeds: Sequence[int]) -> Iterator[Log]:
    """The real logs of a folder, trained from several seeds; a log whose files are not all there is
    named and left out."""
    for name, templates in REAL.items():
        if names and name not in names:
            continue
        settings = tuple(template.format(folder=folder) for template in templates)
        text = " ".join(settings)
        paths = re.findall(rf"{re.escape(str(folder))}/[^,\]\s]+", text)
        missing = [path for path in paths if not Path(path).is_file()]
        if missing:
            print(f"{name} is left out: {missing[0]} is missing", flush=True)
            continue
        for seed in seeds:
            yield Log(name=name, seed=seed, settings=settings, training_seed=seed)


def fit_log(log: Log, *settings: str) -> tuple[DataSet, Identification, float]:
    """Read a log and identify its model; return both and the processor seconds."""
    quoted = [quote(setting) for setting in log.settings]
    parts = study_of("data=recorded", *settings, *quoted)
    data = parts.data.build(log.training_seed)
    began = time.process_time()
    with TemporaryDirectory() as folder:
        found = parts.training.identify(parts.model, data, log.training_seed, Path(folder))
    return data, found, time.process_time() - began


def compare(log: Log, plain: bool = False, candidates: Path | None = None) -> dict[str, object]:
    """Fit a log by default and by the best baseline; return the row of the table.

    A folder for `candidates` receives the table of what was tried.
    """
    data, found, seconds = fit_log(log)
    if candidates is not None:
        write(candidates / f"{log.name}_{log.seed}.csv", found.choice)
    seconds_plain = round(fit_log(log, "model=structured")[2], 1) if plain else ""
    data_of_baseline = data.with_disturbances_as_inputs()
    baseline = fit_best_baseline(data_of_baseline)
    _, test = simulate_validation_and_test(
        found.model, data
    )  # from the log's past where that predicts better
    fit = test.fit_percent
    fit_baseline = baseline.test_fit_percent(data_of_baseline) if baseline else float("nan")
    predicted = member_columns(found.members, data).get("fit_test_members_percent", fit)
    return {
        "log": log.name,
        "seed": log.seed,
        "fit_test_percent": round(fit, 2),
        "fit_predicted_percent": round(predicted, 2),
        "fit_baseline_percent": round(fit_baseline, 2),
        "ahead_points": round(predicted - fit_baseline, 2),
        "fit_validation_percent": round(found.fit_validation_percent, 2),
        "controller_rate_limit": round(largest_rate(found.model), 4),
        "processor_seconds": round(seconds, 1),
        "processor_seconds_plain": seconds_plain,
        "baseline": baseline.words if baseline else "",
        "chosen": found.chosen,
        "refitted": found.refitted,
        "commit": commit(),
    }


def commit() -> str:
    """Commit of the code that is measured; empty in a folder without history."""
    words = ("git", "rev-parse", "--short", "HEAD")
    return subprocess.run(words, cwd=ROOT, capture_output=True, text=True).stdout.strip()


def quote(setting: str) -> str:
    """A setting as Hydra reads it: a value with other than plain characters in quotes."""
    name, _, value = setting.partition("=")
    is_plain = all(character.isalnum() or character in "/._-,[]" for character in value)
    return setting if is_plain else f"{name}='{value}'"


def largest_rate(model: object) -> float:
    """The largest rate of a certified state feedback; not a number where there is none."""
    balls = certified_balls(model)
    return float(largest_certifiable_rate(model.system, balls.input))  # type: ignore[attr-defined]


def compare_all(
    logs: Sequence[Log], jobs: int, plain: bool, candidates: Path | None
) -> Iterator[dict[str, object]]:
    """Rows of several logs as they come, so many logs at a time; a log that fails is printed."""
    if jobs == 1:
        yield from (compare(log, plain, candidates) for log in logs)
        return
    os.environ.update(ONE_THREAD)  # read by the processes that are started now
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        running = {pool.submit(compare, log, plain, candidates): log for log in logs}
        for done in as_completed(running):
            failure = done.exception()
            if failure is None:
                yield done.result()
            else:
                print(f"{running[done].name} {running[done].seed} failed: {failure!r}", flush=True)


def place_in_queue(log: Log) -> int:
    """Place of a log in the queue of several processes: the slowest ones come first."""
    return SLOWEST.index(log.name) if log.name in SLOWEST else len(SLOWEST)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", choices=("kinds", "aside", "real"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], metavar="N")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--jobs", type=int, default=1, metavar="N")
    parser.add_argument("--table", "--to", type=Path, metavar="FILE")
    parser.add_argument("--candidates", type=Path, metavar="FOLDER")
    folder_of_logs = Path(os.environ.get(FOLDER_VARIABLE, REAL_LOGS))
    parser.add_argument("--real-logs", type=Path, default=folder_of_logs, metavar="FOLDER")
    options = parser.parse_args()
    target = options.table or TARGET / f"log_choice_{options.logs}.csv"
    done = {(row["log"], row["seed"]) for row in rows_of(target)}
    with TemporaryDirectory() as folder:
        if options.logs != "real":
            kinds = KINDS if options.logs == "kinds" else KINDS_ASIDE
            logs = logs_of_kinds(Path(folder), options.only, options.seeds, kinds)
        else:
            logs = real_logs(options.real_logs.resolve(), options.only, options.seeds)
        waiting = [log for log in logs if (log.name, str(log.seed)) not in done]
        if options.jobs > 1:
            waiting.sort(key=place_in_queue)
        for row in compare_all(waiting, options.jobs, options.plain, options.candidates):
            print(row, flush=True)
            keep(target, [row], ("log", "seed"), lambda each: (each["log"], int(each["seed"])))


if __name__ == "__main__":
    main()
