"""Gather 10,000 runs: seconds from cold, and again with nothing new.

python benchmarks/results_gather.py --runs 10000
"""

import argparse
import tempfile
import time
from pathlib import Path

from ssm_study.results.columns import COLUMNS
from ssm_study.results.gather import gather
from ssm_study.results.provenance import provenance
from ssm_study.results.records import write_record
from ssm_study.results.show import plain_table, ranked

VALUES = {"string": "word", "Int64": 8, "Float64": 0.123456789, "boolean": True}


def make(study: Path, runs: int) -> None:
    """Records as full as real ones: every agreed column, the stages and the provenance."""
    stages = {
        f"stage_{name}_{what}": "0" * 64 if what == "key" else 1.5 for name in "abcde" for what in ("key", "seconds")
    }
    common = {column.name: VALUES[column.kind] for column in COLUMNS} | stages | provenance()
    for number in range(runs):
        folder = study / f"order{number % 12}-width32-seed{number}-{number:010x}"
        folder.mkdir(parents=True)
        status = "ok" if number % 50 else "failed"
        write_record(folder, common | {"run": folder.name, "status": status, "seed": number, "rmse_test": number / 7})


def timed(study: Path) -> float:
    begun = time.perf_counter()
    table = gather(study)
    print(f"  {len(table)} rows, {len(table.columns)} columns", end=" ")
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        study = Path(scratch) / "study"
        make(study, options.runs)
        print(f"first: {timed(study):.1f} s")
        print(f"again: {timed(study):.1f} s")
        begun = time.perf_counter()
        text = plain_table(ranked(gather(study), "rmse_test"), "rmse_test")
        print(f"show:  {time.perf_counter() - begun:.1f} s for {len(text.splitlines())} lines")


if __name__ == "__main__":
    main()
