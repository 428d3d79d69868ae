"""Runs made with an earlier commit, and whether the code of today still verifies, exports and
continues them.

    python benchmarks/kept_runs.py make COMMIT FOLDER
    python benchmarks/kept_runs.py check FOLDER

`make` clones COMMIT into FOLDER/src and makes one run of every kind with that code, in this Python:
their run folders,
what `verify --json` said, the exported C, `runs.parquet`; a study folder of one's own made by
`ssm-study new`, and in it
the theorem of docs/howto_theorem.md and a copy of the theorem template. `check` asks the code of
this checkout about
all of them. It changes nothing in FOLDER, prints one line a run, and exits with 1 where anything
differs:

* every claim that held, holds, or is not checked because its theorem was withdrawn; every one that
failed, fails;
* the exported C of today replays what the exported C of then gave, to the last digit;
* the table has every column and value of the old table, except for those that were withdrawn;
* the old study folder runs, with its theorems, with the old imports;
* a stored configuration of every kind is accepted and gives the same parts.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from ssm_study.withdrawn import WITHDRAWN_COLUMNS

ROOT = Path(__file__).resolve().parents[1]
OWN = "own_study"
WITHDRAWN = "withdrawn in"
EXACT = ("-std=c99", "-O1", "-ffp-contract=off")


@dataclass(frozen=True)
class Kind:
    """One kind of run: the study that it is made in, its overrides, and the exit status of
    `run`."""

    name: str
    overrides: tuple[str, ...]
    status: int = 0
    exports: bool = True
    own: bool = False


SMALL = ("experiment=smoke",)
LOG = (
    "data=recorded",
    "data.path=log.csv",
    "data.input=volt",
    "data.output=speed",
    "data.time=time",
)
TINY_STRUCTURED = ("model.order=2", "model.neurons=1", "model.draws=2", "model.starts=1")
KINDS = (
    Kind("paper", ("experiment=paper", "training.max_epochs=20")),
    Kind("small", SMALL),
    Kind("infeasible", (*SMALL, "synthesis=lmi", "synthesis.rate_controller=0.99"), exports=False),
    Kind("failed", (*SMALL, "plant.solver_step_s=1e-300"), status=1, exports=False),
    Kind("refined", (*SMALL, "refine=1")),
    Kind("lmi", (*SMALL, "synthesis=lmi", "synthesis.rate_controller=0.02")),
    Kind("riccati", (*SMALL, "synthesis=riccati", "synthesis.rate_controller=0.02")),
    Kind("limited", (*SMALL, "loop.input_lower=-3", "loop.input_upper=3")),
    Kind("structured", (*SMALL, "model=structured", "~model.hidden_width", *TINY_STRUCTURED,
                        "training.max_epochs=20")),
    Kind("internal_model", (*SMALL, "synthesis=auto_integral")),
    Kind("residual", (*SMALL, "scaffold@model.scaffold_in=residual")),
    Kind("baseline", ("experiment=paper", "model=narx", "data.trajectories=3", "data.samples=400"),
         exports=False),
    Kind("peers", (*SMALL, "+comparison@loop.comparison=peers",
                   "loop.comparison.controllers=[uncontrolled,pi,lqg]")),
    Kind("recorded", (*LOG, "model=ssm", "model.order=2", "model.hidden_width=8",
                      "training.max_epochs=15")),
    Kind("recorded_structured", (*LOG, *TINY_STRUCTURED, "training.max_epochs=15")),
    Kind("own_folder", (f"experiment={OWN}", "training.max_epochs=8"), own=True),
    Kind("own_gain", (f"experiment={OWN}", "training.max_epochs=8", "synthesis=own_gain"),
         own=True),
    Kind("own_certificate", (f"experiment={OWN}", "training.max_epochs=8",
                             "synthesis=own_certificate"), own=True),
)  # fmt: skip

TEMPLATE_ANSWERS = '''

@dataclass(frozen=True, kw_only=True)
class OwnCertificate(NameOfTheTheorem):
    """A certificate under its own name: the scalar bounded-real inequality."""

    @staticmethod
    def conditions(of: Any) -> dict[str, Blocks]:
        contraction = (1 - of.rate) * of.p
        closed = of.a + of.alpha * of.b @ of.k
        return {
            "inequality": [[of.p, closed @ of.p], [contraction]],
            "rate above 0": [[of.rate]],
            "rate below 1": [[1 - of.rate]],
        }
'''
CERTIFICATE_SYNTHESIS = '''"""A design whose state feedback is certified by a theorem from here."""

from dataclasses import dataclass
from typing import Any, ClassVar

from ssm_study.synthesis.design import Synthesis
from ssm_study.synthesis.problem import Problem, Solution
from ssm_study.synthesis.theorems.guaranteed_cost import guaranteed_cost

from own_study.own_certificate import OwnCertificate


@dataclass(frozen=True, kw_only=True)
class OwnCertified(Synthesis):
    """Riccati gains under the certificate of this folder."""

    method: ClassVar[str] = "own_certified"
    feedback_theorem: ClassVar[Any] = OwnCertificate

    def solve(self, problem: Problem) -> Solution:
        return guaranteed_cost(problem)
'''


def code_of(root: Path) -> Mapping[str, str]:
    """Environment in which `python -m ssm_study.cli` is the code under `root`, with one thread."""
    return os.environ | {
        "PYTHONPATH": str(root),
        "OMP_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def ask(root: Path, folder: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run one command of ssm-study with the code under `root`, from `folder`."""
    command = [sys.executable, "-m", "ssm_study.cli", *map(str, words)]
    return subprocess.run(
        command, cwd=folder, env=code_of(root), capture_output=True, text=True, check=False
    )


def refuse_other_code(root: Path, folder: Path) -> None:
    """Stop unless `import ssm_study` from `folder` finds the package under `root`."""
    words = [sys.executable, "-c", "import ssm_study; print(ssm_study.__file__)"]
    done = subprocess.run(
        words, cwd=folder, env=code_of(root), capture_output=True, text=True, check=True
    )
    if not Path(done.stdout.strip()).is_relative_to(root):
        raise SystemExit(f"{done.stdout.strip()} is not the code under {root}")


def write_log(path: Path) -> None:
    """Log of a small saturating system with noise, as a user's CSV file."""
    rng = np.random.default_rng(0)
    volts = np.repeat(rng.uniform(-2, 2, 120), 5)
    speed = np.zeros(len(volts))
    for k in range(len(volts) - 1):
        speed[k + 1] = 0.9 * speed[k] + 0.1 * np.tanh(volts[k])
    speed += 0.001 * rng.standard_normal(len(volts))
    columns = np.column_stack([np.arange(len(volts)) * 0.05, volts, speed])
    np.savetxt(path, columns, delimiter=",", header="time,volt,speed", comments="")


def code_block(page: Path, title: str) -> str:
    """The Python code of a documentation page under this title."""
    _, _, after = page.read_text(encoding="utf-8").partition(f'title="{title}"\n')
    block, _, _ = after.partition("    ```")
    lines = [line.removeprefix("    ") for line in block.splitlines()]
    return "\n".join(lines) + "\n"


def write_own_study(folder: Path, source: Path) -> None:
    """A study folder by `ssm-study new`, the theorem of the how-to and the filled template in
    it."""
    done = ask(source, folder, "new", OWN)
    if done.returncode:
        raise SystemExit(done.stderr)
    own = folder / OWN
    howto = code_block(source / "docs/howto_theorem.md", "ssm_study/synthesis/my_theorem.py")
    (own / "own_gain.py").write_text(howto)
    template = source / "ssm_study/synthesis/theorems/_template.py"
    text = template.read_text().replace(
        '"""Every number that `conditions` uses."""', '"""Numbers."""'
    )
    (own / "own_certificate.py").write_text(text + TEMPLATE_ANSWERS)
    (own / "own_certified.py").write_text(CERTIFICATE_SYNTHESIS)
    for name, target in {
        "own_gain": "own_gain.MyTheorem",
        "own_certificate": "own_certified.OwnCertified",
    }.items():
        rates = "rate_controller: 0.02\nrate_observer: 0.05\n"
        (own / "conf/synthesis" / f"{name}.yaml").write_text(f"_target_: {OWN}.{target}\n{rates}")


def trusted(kind: Kind) -> tuple[str, ...]:
    """The option that trusts the study folder, where the run is made of it."""
    return ("--with", OWN) if kind.own else ()


def run_folder(folder: Path, kind: Kind) -> Path:
    """The one run of this kind."""
    (record,) = (folder / "results" / kind.name).glob("*/record.json")
    return record.parent


def make(commit: str, folder: Path) -> None:
    """Every run with the code of `commit`, what it says of them, and what it exports."""
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "src"
    if not source.exists():
        subprocess.run(["git", "clone", "-q", ROOT, source], check=True)
    subprocess.run(["git", "checkout", "-q", commit], cwd=source, check=True)
    refuse_other_code(source, folder)
    write_log(folder / "log.csv")
    if not (folder / OWN).exists():
        write_own_study(folder, source)
    for kind in KINDS:
        if not (folder / "verify" / f"{kind.name}.json").exists():
            make_kind(kind, folder, source)


def make_kind(kind: Kind, folder: Path, source: Path) -> None:
    """One run, its verification, its table and its exported C."""
    words = (*trusted(kind), f"study={kind.name}", "progress=false", *kind.overrides)
    done = ask(source, folder, "run", *words)
    if done.returncode != kind.status:
        raise SystemExit(f"{kind.name}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    run = run_folder(folder, kind)
    done = ask(source, folder, "gather", run.parent)
    if kind.exports:
        done = ask(
            source, folder, "export", *trusted(kind), run, "--to", folder / "export" / kind.name
        )
        if done.returncode:
            raise SystemExit(f"{kind.name}: {done.stderr}")
    stored = folder / "verify" / f"{kind.name}.json"
    stored.parent.mkdir(exist_ok=True)
    stored.write_text(json.dumps(verdict(source, folder, kind), indent=1))
    print(f"{kind.name}: {summary(json.loads(stored.read_text()))}", flush=True)


def verdict(root: Path, folder: Path, kind: Kind) -> dict[str, object]:
    """Exit status and answer of `verify --json`; of a refusal its sentence."""
    done = ask(root, folder, "verify", *trusted(kind), run_folder(folder, kind), "--json")
    answer = json.loads(done.stdout) if done.stdout.startswith("{") else {}
    return {"status": done.returncode, "said": done.stderr.strip(), "answer": answer}


def summary(verdict: dict[str, object]) -> str:
    """How many claims hold, in a few words."""
    answer = verdict["answer"]
    assert isinstance(answer, dict)
    claims = answer.get("claims", ())
    holding = sum(claim["holds"] for claim in claims)
    unchecked = len(answer.get("not_checked", ()))
    text = f"{holding} of {len(claims)} claims hold, {unchecked} not checked"
    return text if claims else str(verdict["said"])[:120]


def claim_differences(then: dict[str, object], now: dict[str, object]) -> Iterator[str]:
    """Every claim whose verdict is another one, and claims of today that fail."""
    if then["status"] != now["status"]:
        yield f"verify exits with {now['status']}, not {then['status']}: {now['said']}"
    old = then["answer"]
    new = now["answer"]
    assert isinstance(old, dict)
    assert isinstance(new, dict)
    verdicts = {claim["claim"]: claim for claim in new.get("claims", ())}
    unchecked = new.get("not_checked", {})
    for claim in old.get("claims", ()):
        name = claim["claim"]
        if name in verdicts:
            if verdicts[name]["holds"] != claim["holds"]:
                yield f"{name}: holds was {claim['holds']}; now {verdicts[name]['found']}"
        elif name not in WITHDRAWN_COLUMNS and WITHDRAWN not in unchecked.get(name, ""):
            yield f"{name}: was checked, is now {unchecked.get(name, 'not mentioned')}"
    known = {claim["claim"] for claim in old.get("claims", ())}
    for name, claim in verdicts.items():
        if name not in known and not claim["holds"]:
            yield f"{name}: new, and fails: {claim['found']}"


def replay(folder: Path, program: str, header: Path) -> str:
    """Compile a replay beside a controller's header, and say what differs from what it expects."""
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        for file in header.glob("controller*.[ch]"):
            shutil.copy(file, place)
        shutil.copy(folder / program, place)
        words = ["gcc", *EXACT, program, "-o", "replay", "-lm"]
        done = subprocess.run(words, cwd=place, capture_output=True, text=True, check=False)
        if done.returncode:
            return done.stderr[:200]
        return subprocess.run(
            ["./replay"], cwd=place, capture_output=True, text=True, check=False
        ).stdout.strip()


def export_differences(kind: Kind, folder: Path) -> Iterator[str]:
    """Where the C of today does not give what the C of then gave."""
    if not kind.exports:
        return
    old = folder / "export" / kind.name
    with tempfile.TemporaryDirectory() as scratch:
        new = Path(scratch) / "c"
        done = ask(ROOT, folder, "export", *trusted(kind), run_folder(folder, kind), "--to", new)
        if done.returncode:
            yield f"export: {done.stderr.strip()[:300]}"
            return
        program = "controller_replay.c"
        for told, words in {"own": (new, new), "of then": (old, new), "old C": (old, old)}.items():
            answer = replay(words[0], program, words[1])
            if not answer.startswith("0 of"):
                yield f"replay {told}: {answer}"


def table_differences(kind: Kind, folder: Path) -> Iterator[str]:
    """Columns and values of the old table that a table gathered today lacks."""
    old_table = pd.read_parquet(folder / "results" / kind.name / "runs.parquet")
    with tempfile.TemporaryDirectory() as scratch:
        study = Path(scratch) / kind.name
        shutil.copytree(folder / "results" / kind.name, study)
        (study / "runs.parquet").unlink()
        done = ask(ROOT, folder, "gather", study)
        if done.returncode:
            yield f"gather: {done.stderr.strip()[:300]}"
            return
        new_table = pd.read_parquet(study / "runs.parquet")
    for name in old_table:
        if name in WITHDRAWN_COLUMNS:
            continue
        if name not in new_table:
            yield f"table: the column {name} is gone"
        elif not old_table[name].equals(new_table[name]):
            yield f"table: {name} was {list(old_table[name])}, is {list(new_table[name])}"


def planned_differences(kind: Kind, folder: Path) -> Iterator[str]:
    """Whether the command of then is still read (a dry run: nothing is computed)."""
    with tempfile.TemporaryDirectory() as scratch:
        words = (f"study={kind.name}", f"results_dir={scratch}", "dry_run=true", *kind.overrides)
        done = ask(ROOT, folder, "run", *trusted(kind), *words)
    if done.returncode:
        yield f"run: {done.stderr.strip()[:300]}"


def own_folder_differences(kind: Kind, folder: Path) -> Iterator[str]:
    """Whether the old study folder runs with the code of today."""
    with tempfile.TemporaryDirectory() as scratch:
        words = (f"study={kind.name}", f"results_dir={scratch}", "progress=false", *kind.overrides)
        done = ask(ROOT, folder, "run", *trusted(kind), *words)
        if done.returncode != kind.status:
            yield f"run: {done.stderr.strip()[-300:]}"
            return
        (record,) = Path(scratch).glob("*/*/record.json")
        status = json.loads(record.read_text())["status"]
    then = json.loads((run_folder(folder, kind) / "record.json").read_text())["status"]
    if status != then:
        yield f"run: status {status}, was {then}"


def differences(kind: Kind, folder: Path) -> list[str]:
    """Everything that is not as it was; `own_folder_differences` runs the line anew."""
    then = json.loads((folder / "verify" / f"{kind.name}.json").read_text())
    again = own_folder_differences if kind.own else planned_differences
    return [
        *claim_differences(then, verdict(ROOT, folder, kind)),
        *export_differences(kind, folder),
        *table_differences(kind, folder),
        *again(kind, folder),
    ]


def check(folder: Path, only: list[str], jobs: int) -> int:
    """Print one line a kind, and what differs; 1 where anything does."""
    refuse_other_code(ROOT, folder)
    kinds = [kind for kind in KINDS if not only or kind.name in only]
    wrong = 0
    with ThreadPoolExecutor(jobs) as pool:
        for kind, found in zip(
            kinds, pool.map(lambda kind: differences(kind, folder), kinds), strict=True
        ):
            wrong += bool(found)
            print(
                f"{kind.name}: {'as it was' if not found else f'{len(found)} differ'}", flush=True
            )
            for line in found:
                print(f"    {line}", flush=True)
    print(f"{len(kinds) - wrong} of {len(kinds)} kinds of runs are as they were")
    return int(wrong > 0)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("commit")
    making.add_argument("folder", type=Path)
    checking = commands.add_parser("check")
    checking.add_argument("folder", type=Path)
    checking.add_argument("--only", nargs="*", default=[], help="kinds by name")
    checking.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    folder = options.folder.resolve()
    if options.command == "make":
        make(options.commit, folder)
        return 0
    return check(folder, options.only, options.jobs)


if __name__ == "__main__":
    sys.exit(main())
