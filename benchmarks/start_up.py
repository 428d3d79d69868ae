"""What a command costs before it does anything: processor seconds of help, refusals, `show`, a
finished run, a plan.

python benchmarks/start_up.py [--runs N]      # results/reference/engine/start_up.csv

Processor time of the whole command with its children, the least of two (a plan once).
"""

import argparse
import os
import subprocess
import sys
import tempfile

from common import REFERENCE, write

FIXED = ("synthesis=closed_form", "synthesis.rate_observer=0.5")
WANTED_S = {"a plan": 10.0}


def cpu_s(words: list[str]) -> float:
    """Processor seconds of one command, user and system."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ssm_study.cli", *words], stdout=-3, stderr=-3
    )
    usage = os.wait4(process.pid, 0)[2]
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=640)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as scratch:
        one = [
            "run",
            "experiment=smoke",
            f"results_dir={scratch}",
            *FIXED,
            "synthesis.rate_controller=0.3",
        ]
        cpu_s(one)
        swept = [
            f"seed=range({max(runs // 32, 1)})",
            "synthesis.rate_controller=range(0.02,0.34,0.01)",
        ]
        commands = {
            "help": ["--help"],
            "help of run": ["run", "--help"],
            "a misspelt key": ["run", "modle.order=4"],
            "a wrong value": ["run", "model.order=-1"],
            "show": ["show", f"{scratch}/smoke"],
            "a finished run": one,
            "a plan": [
                "run",
                "-m",
                "experiment=smoke",
                f"results_dir={scratch}",
                *FIXED,
                *swept,
                "--dry-run",
            ],
        }
        seen = {
            name: min(cpu_s(words) for _ in range(1 if name == "a plan" else 2))
            for name, words in commands.items()
        }
    rows = [
        {"command": n, "cpu_s": f"{s:.2f}", "wanted_s": WANTED_S.get(n, 1.5)}
        for n, s in seen.items()
    ]
    write(REFERENCE / "engine" / "start_up.csv", rows)
    print(
        *(f"{row['command']}: {row['cpu_s']} s (wanted {row['wanted_s']})" for row in rows),
        sep="\n",
    )


if __name__ == "__main__":
    main()
