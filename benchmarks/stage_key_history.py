"""How often the commits of a stretch of history changed the key of each stage: whole modules
against names.

    python benchmarks/stage_key_history.py COMMIT COUNT

Over COUNT commits up to COMMIT, it compares the version of the code of every stage (what computes
it,
with the parts of the default study; what measures it) before and after each commit. Two ways: with
the
stages as they were written, where `from ssm_study.study import recordings` took that module whole;
and
with the same stages importing only the names that they use, as `study/stages/` does today.
"""

import io
import re
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from ssm_study.engine import fingerprint
from ssm_study.engine.fingerprint import CodeReader, find_symbol

ROOT = Path(__file__).resolve().parents[1]
STAGES = {
    "dataset": (
        "compute_dataset",
        "plants.dc_motor.DCMotor",
        "data.simulated.SimulatedData",
        "data.excitations.excitation.APRBS",
    ),
    "model": ("compute_model", "models.spec.SSMSpec", "training.training.Training"),
    "bounds": ("compute_free_runs", "bounds.reduction.Reduction"),
    "mismatch": ("compute_mismatch",),
    "evidence": ("compute_evidence",),
    "synthesis": ("compute_synthesis", "synthesis.auto.Auto"),
    "loop": ("compute_loop", "plants.dc_motor.DCMotor", "loop.regulation.Loop"),
}
SCAN = fingerprint._scan_module
SCANNED: dict[tuple[bytes, str, bool], fingerprint.Module] = {}


def scan_once(path: Path, module: str) -> fingerprint.Module:
    """Syntax of a file, read once for each content."""
    key = path.read_bytes(), module, path.name == "__init__.py"
    if key not in SCANNED:
        SCANNED[key] = SCAN(path, module)
    return SCANNED[key]


def commits(last: str, count: int) -> list[str]:
    words = ["git", "rev-list", "--first-parent", f"--max-count={count + 1}", last]
    return subprocess.check_output(words, cwd=ROOT, text=True).split()[::-1]


def checkout(commit: str, folder: Path) -> Path:
    """The package as it was at a commit."""
    words = ["git", "archive", commit, "ssm_study"]
    archive = subprocess.check_output(words, cwd=ROOT)
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    return folder / "ssm_study"


def narrow_imports(package: Path) -> None:
    """Let the stages import from `recordings` the names that they use, instead of all of it."""
    path = package / "study/stages.py"
    text = path.read_text()
    names = sorted(set(re.findall(r"\brecordings\.(\w+)", text)))
    text = re.sub(r"\brecordings\.(?=\w)", "", text)
    imports = f"from ssm_study.study.recordings import {', '.join(names)}"
    path.write_text(text.replace("from ssm_study.study import recordings", imports))


def versions(package: Path) -> dict[str, str]:
    """Version of the code of every stage that this commit has."""
    sources = CodeReader({"ssm_study": package})
    found = {}
    for stage, (compute, *targets) in STAGES.items():
        roots = [("ssm_study.study.stages", compute)]
        roots += [find_symbol(f"ssm_study.{target}") for target in targets]
        present = [root for root in roots if is_defined(sources, *root)]
        if roots[0] in present:
            found[stage] = sources.code_digest(*present)
    return found


def is_defined(sources: CodeReader, module: str, name: str) -> bool:
    read = sources._read_module(module)
    return read is not None and (name in read.bound_names or name in read.imported)


def both_ways(commit: str) -> tuple[dict[str, str], dict[str, str]]:
    with tempfile.TemporaryDirectory() as scratch:
        package = checkout(commit, Path(scratch))
        if not (package / "study/stages.py").is_file():
            return {}, {}
        wide = versions(package)
        narrow_imports(package)
        return wide, versions(package)


def changes(history: list[dict[str, str]]) -> Iterator[str]:
    """Stages whose own code a commit changed, commit by commit."""
    for before, after in pairwise(history):
        yield from (stage for stage in after if after[stage] != before.get(stage))


def main() -> None:
    last = sys.argv[1]
    count = int(sys.argv[2])
    fingerprint._scan_module = scan_once
    history = [both_ways(commit) for commit in commits(last, count)]
    history = [pair for pair in history if pair[0]]
    print(f"{len(history) - 1} commits up to {last}")
    wide = Counter(changes([pair[0] for pair in history]))
    narrow = Counter(changes([pair[1] for pair in history]))
    print(f"{'stage':<12}{'whole module':>14}{'names':>8}")
    for stage in STAGES:
        print(f"{stage:<12}{wide[stage]:>14}{narrow[stage]:>8}")
    print(f"{'all':<12}{wide.total():>14}{narrow.total():>8}")


if __name__ == "__main__":
    main()
