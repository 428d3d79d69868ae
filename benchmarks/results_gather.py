"""Gather 20,000 runs: processor seconds from cold, again, with one run changed, to show them and to
report them.

The runs are records only, and alike but for their seeds: a page of runs that differ more is larger.

python benchmarks/results_gather.py --runs 20000 --table results/reference/engine/gather.csv
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ssm_study.engine.provenance import provenance_columns
from ssm_study.engine.records import read_record, write_record
from ssm_study.table.columns import COLUMNS
from ssm_study.table.gather import gather
from ssm_study.table.rank import rank_runs
from ssm_study.table.show import render_table, status_summary_lines

VALUES = {"string": "word", "Int64": 8, "Float64": 0.123456789, "boolean": True}
# A program of its own, which says its processor time and its peak: what `wait4` says includes what
# forked it.
REPORT = """
import pathlib, re, sys, time
from ssm_study.cli.main import main
main(sys.argv[1:])
status = pathlib.Path("/proc/self/status").read_text()
print(time.process_time(), re.findall(r"VmHWM:\\s+(\\d+)", status)[0])
"""


def make(study: Path, runs: int) -> None:
    """Records as full as real ones: every agreed column, the stages and the provenance."""
    stages = {
        f"stage_{name}_{what}": "0" * 64 if what == "key" else 1.5
        for name in "abcde"
        for what in ("key", "seconds")
    }
    common: dict[str, Any] = {column.name: VALUES[column.kind] for column in COLUMNS} | stages
    common |= provenance_columns(("numpy", "torch"), Path(__file__))
    for number in range(runs):
        folder = study / f"order{number % 12}-width32-seed{number}-{number:010x}"
        folder.mkdir(parents=True)
        status = "ok" if number % 50 else "failed"
        write_record(
            folder, common | {"run": folder.name, "status": status, "seed": number}, durable=False
        )


def timed(step: Callable[[], object]) -> float:
    begun = time.process_time()
    step()
    return round(time.process_time() - begun, 2)


def measured(study: Path, runs: int) -> dict[str, float]:
    """Processor seconds of each step, in order; of the report, a command of its own, the memory,
    too."""
    make(study, runs)
    found = {"first": timed(lambda: gather(study)), "again": timed(lambda: gather(study))}
    one = next(study.glob("order*"))
    write_record(one, (read_record(one) or {}) | {"seed": -1}, durable=False)
    found["one_changed"] = timed(lambda: gather(study))
    found |= {
        "show": timed(
            lambda: (
                render_table(rank_runs(table := gather(study))),
                status_summary_lines(table, runs),
            )
        )
    }
    command = [sys.executable, "-c", REPORT, "report", str(study)]
    seconds, kilobytes = subprocess.run(
        command, capture_output=True, text=True, check=True
    ).stdout.split()[-2:]
    found |= {"report": round(float(seconds), 2), "report_peak_MB": round(int(kilobytes) / 1024)}
    return found | {
        "page_MB": round((study / "report.html").stat().st_size / 1e6, 1),
        "load": os.getloadavg()[0],
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20_000)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        found = measured(Path(scratch) / "study", options.runs)
    rows = [
        "runs,step,value",
        *(f"{options.runs},{step},{seconds}" for step, seconds in found.items()),
    ]
    print("\n".join(rows))
    if options.table:
        options.table.write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
