"""Requests and data files of chance: each is done, or refused in one sentence.

    python -P benchmarks/fuzz_requests.py --count 1000 --seed 0 --table
    results/reference/engine/fuzz.csv

A request is a sound one of a few words, of which some are mutated: another key, a value of another
type, brackets, interpolations, control characters. It is planned, not run. A data file is a sound
log (CSV, Parquet, MCAP, MAT) of which bytes are flipped, cut, inserted, or cells replaced; it is
read as `data=recorded` reads it. A find is a traceback, an exception that is no refusal, an answer
of
several lines, or a plan that says `Unexpected error`. Every tenth case is left as it is and must be
accepted. The same seed gives the same cases.
"""

import argparse
import contextlib
import io
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import savemat

from ssm_study.cli.main import DONE, WRONG_REQUEST, main
from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel

SAMPLES = 300
CONTROL_EVERY = 10  # of the cases, one is left as it is
SOUND = (
    ["experiment=smoke"],
    ["experiment=smoke", "synthesis=riccati", "synthesis.rate_controller=0.3"],
    ["experiment=smoke", "model.order=2", "seed=3", "loop.horizon_s=1.0"],
)
VALUES = (
    "", "null", "true", "-1", "0", "1e400", "nan", "inf", "010", "1:30", "yes", "[]", "{}", "[[1]]",
    "{a:1}", "'", '"', "\\", "${seed}", "${oc.env:HOME}", "${oc.${study}:HOME}", "a b", "a,b",
    "range(3)", "glob(*)", "9" * 5000, "1" * 400, "..", "../x", "/", "~", "\x1b[31m", "\u202e",
    "\u03c9", "1,2", "choice(1,2)", "x" * 3000, "0.0", "-0.0", "1e-400", "[1,[2,[3]]]", "None",
)  # fmt: skip
KEYS = (
    "seed", "study", "results_dir", "run", "model", "model.order", "model._target_", "plant",
    "plant.step_s", "training.max_epochs", "training.optimiser", "synthesis", "loop.horizon_s",
    "loop", "data", "data.path", "hydra.sweep.dir", "hydra/launcher", "+new", "~model", "++seed",
    "progress", "strict", "dry_run", "retry_failed", "reduction", "excitation", "loop_seed",
    "refine",
    "", "=", "a.b.c", "model.", ".model", "model@x", "seed.x", "experiment", "training/optimiser",
)  # fmt: skip


def mutated_request(rng: np.random.Generator) -> list[str]:
    """A sound request with one to three words replaced or added."""
    words = list(SOUND[rng.integers(len(SOUND))])
    for _ in range(rng.integers(1, 4)):
        key = KEYS[rng.integers(len(KEYS))]
        word = f"{key}={VALUES[rng.integers(len(VALUES))]}"
        place = int(rng.integers(len(words) + 1))
        if rng.random() < 0.2 and place < len(words):
            characters = list(words[place])
            at = int(rng.integers(len(characters)))
            characters[at] = chr(int(rng.integers(32, 500)))
            word = "".join(characters)
            words.pop(place)
        words.insert(place, word)
    return words


def answer_to_request(words: list[str], folder: Path) -> str:
    """`accepted`, `refused`, or what is wrong with the answer."""
    place = f"results_dir={folder}"
    output = io.StringIO()
    errors = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            status = main(["run", place, *words, "--dry-run"])
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 99
    said = errors.getvalue()
    if "Unexpected error" in said or "Traceback" in said:
        return f"FIND {said[-600:]}"
    if status == DONE:
        return "accepted"
    is_sentence = status == WRONG_REQUEST and len(said.strip().splitlines()) <= 2
    return "refused" if is_sentence else f"FIND status {status}: {said[-600:]}"


def sound_log(folder: Path, suffix: str, rng: np.random.Generator) -> Path:
    """A log of a first-order plant."""
    u = np.sign(rng.normal(size=SAMPLES)).repeat(5)[:SAMPLES]
    y = np.convolve(u, 0.2 * 0.8 ** np.arange(40))[:SAMPLES]
    table = {"time": 0.1 * np.arange(SAMPLES), "u": u, "y": y}
    path = folder / f"log{suffix}"
    if suffix == ".csv":
        pd.DataFrame(table).to_csv(path, index=False)
    elif suffix == ".parquet":
        pd.DataFrame(table).to_parquet(path)
    elif suffix == ".mat":
        savemat(path, table)
    else:
        channels = tuple(Channel(name=name, unit="V") for name in ("u", "y"))
        values = np.stack([u, y], axis=1)
        group = SignalGroup(topic="/log", time_s=table["time"], channels=channels, values=values)
        write_mcap(path, (group,), {})
    return path


CELLS = ("", "nan", "inf", "text", "1,5", "1e999", '"', ";", "\x00", "-", "0x10", "1 2", "\ufeff")


def mutate_file(path: Path, rng: np.random.Generator) -> None:
    """Flip, cut, insert or delete bytes; in a CSV also replace cells."""
    content = bytearray(path.read_bytes())
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(max(len(content), 1)))
        kind = rng.integers(5)
        if kind == 0 and content:
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del content[at:]
        elif kind == 2:
            content[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 3:
            del content[at : at + int(rng.integers(1, 200))]
        elif path.suffix == ".csv":
            content[at:at] = CELLS[rng.integers(len(CELLS))].encode()
    path.write_bytes(bytes(content))


def answer_to_file(path: Path) -> str:
    """`accepted`, `refused`, or what is wrong with the answer."""
    try:
        data = RecordedData(path=str(path), input="u", output="y", step_s=0.1).build(0)
    except BadRequest as refusal:
        return "refused" if "\n" not in str(refusal) else f"FIND lines: {refusal}"
    except Exception:  # whatever a reader raises
        return f"FIND {traceback.format_exc()[-600:]}"
    records = (*data.training, *data.validation, *data.test)
    is_finite = all(np.isfinite(r.u).all() and np.isfinite(r.y).all() for r in records)
    return "accepted" if is_finite else "FIND not finite"


def file_case(number: int, rng: np.random.Generator, folder: Path) -> tuple[str, str]:
    suffix = (".csv", ".parquet", ".mcap", ".mat")[number % 4]
    path = sound_log(folder, suffix, rng)
    is_control = number % CONTROL_EVERY < 1
    if not is_control:
        mutate_file(path, rng)
    answer = answer_to_file(path)
    if is_control and answer != "accepted":
        answer = f"FIND control {answer}"
    return f"{suffix} {'control' if is_control else ''}", answer


def request_case(number: int, rng: np.random.Generator, folder: Path) -> tuple[str, str]:
    is_control = number % CONTROL_EVERY < 1
    words = list(SOUND[number % len(SOUND)]) if is_control else mutated_request(rng)
    answer = answer_to_request(words, folder)
    if is_control and answer != "accepted":
        answer = f"FIND control {answer}"
    return " ".join(words)[:300], answer


Case = Callable[[int, np.random.Generator, Path], tuple[str, str]]
KINDS: dict[str, Case] = {"files": file_case, "requests": request_case}


def run_fuzzer() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=KINDS)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    rows = ["kind,seed,first,cases,accepted,refused,finds,seconds"]
    finds = 0
    for kind, case in KINDS.items():
        if options.only not in (None, kind):
            continue
        begun = time.monotonic()
        answers: Counter[str] = Counter()
        for number in range(options.first, options.first + options.count):
            if time.monotonic() - begun > 60 * options.minutes:
                break
            rng = np.random.default_rng([options.seed, number])
            with tempfile.TemporaryDirectory() as scratch:
                about, answer = case(number, rng, Path(scratch))
            answers[answer.split()[0]] += 1
            if answer.startswith("FIND"):
                print(f"{kind} {number}: {about!r}\n  {answer}", flush=True)
        finds += answers["FIND"]
        numbers = [answers[name] for name in ("accepted", "refused", "FIND")]
        counts = ",".join(map(str, [options.first, answers.total(), *numbers]))
        rows.append(f"{kind},{options.seed},{counts},{time.monotonic() - begun:.0f}")
        print(rows[-1], flush=True)
    if options.table:
        options.table.write_text("\n".join(rows) + "\n")
    return 1 if finds else 0


if __name__ == "__main__":
    raise SystemExit(run_fuzzer())
