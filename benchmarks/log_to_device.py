"""The story of docs/log_to_device.md, done as the page says, and its picture: python
benchmarks/log_to_device.py."""

import re
import subprocess
import sys
import tempfile
from contextlib import chdir
from pathlib import Path

import pandas as pd

from ssm_study import style
from ssm_study.cli.main import main

PAGE = Path(__file__).parents[1] / "docs" / "log_to_device.md"
PICTURE = PAGE.parent / "pictures" / "first_trial.png"
COMMANDS = re.compile(r"^(?:python|ssm-study|gcc) .+$", re.M)


def told(folder: Path) -> dict[str, str]:
    """Do the page in `folder`: write its files, give its commands in order; what each program said,
    by its name."""
    text = PAGE.read_text()
    for name, content in re.findall(r'^```python title="(\w+\.py)"\n(.*?)^```', text, re.M | re.S):
        (folder / name).write_text(content)
    said = {}
    with chdir(folder):
        for command in COMMANDS.findall(text):
            if command.startswith("gcc") and "trial.py" not in said and "-shared" not in command:
                said["replay"] = output(command)
                said["trial.py"] = output(f"{sys.executable} trial.py")
            elif command.startswith("ssm-study"):
                run = next(
                    (path.parent.name for path in Path("results").glob("device/*/record.json")),
                    "RUN",
                )
                words = command.replace("RUN", run).split()[1:]
                if main([*words, *(["progress=false"] if words[0] == "run" else [])]):
                    raise SystemExit(f"{command} did not succeed")
            else:
                output(command.replace("python ", f"{sys.executable} "))
    return said


def output(command: str) -> str:
    return subprocess.run(command, shell=True, check=True, capture_output=True, text=True).stdout


def draw(trial: pd.DataFrame, path: Path, step_s: float = 0.01) -> None:
    """Speed with its set points above, voltage with its limits below."""
    time_s = step_s * trial.index.to_numpy()
    fig = style.new_figure(style.PAGE_IN, 3.2)
    above, below = fig.subplots(2, 1, sharex=True)
    above.plot(time_s, trial["speed"], color=style.BLUE, lw=1)
    above.step(time_s, trial["set_point"], color=style.VERMILLION, lw=1, ls="--", where="post")
    above.set(ylabel="Speed (rad/s)")
    below.step(time_s, trial["volts"], color=style.BLUE, lw=1, where="post")
    for limit in (-3, 3):
        below.axhline(limit, color=style.VERMILLION, lw=1, ls="--")
    below.set(ylabel="Voltage (V)", xlabel="Time (s)", xlim=(0, time_s[-1]))
    fig.savefig(path, dpi=150)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(told(Path(folder))["replay"])
        with style.paper_style():
            draw(pd.read_csv(Path(folder) / "first_trial.csv"), PICTURE)
    print(PICTURE)
