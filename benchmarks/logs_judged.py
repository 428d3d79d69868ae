"""What the checks of the records say of logs that cannot bear a judgement, and of logs that can.

    python benchmarks/logs_judged.py --to results/reference/evidence        (ten minutes on one
    core)

writes logs.csv: one row per run of the study as it is by default. The made logs are those of
tests/laws/test_evidence_controls.py, which runs them with fewer epochs and candidates.
"""

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from ssm_study.cli.main import main as ssm_study
from ssm_study.engine.records import read_record

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path += [str(TESTS), str(TESTS / "laws")]
from test_evidence_controls import LOGS, OWN, U, answer  # noqa: E402

MEASURED = ("cascaded_tanks", "emps", "ced", "silverbox")
PLANTS = ("dc_motor", "stribeck_drive", "cascaded_tanks", "quadruple_tank")
RESIDUAL = {"quadruple_tank": ["scaffold@model.scaffold_in=residual"]}
SHOWN = [
    "evidence",
    "fit_validation_percent",
    "fit_test_percent",
    "predicted_stable",
    "evidence_reasons",
]


def written(folder: Path, name: str, u: np.ndarray, y: np.ndarray) -> list[str]:
    """The log as a file, and what names it."""
    path = folder / f"{name.replace(' ', '_')}.csv"
    np.savetxt(path, np.column_stack([u, y]), delimiter=",", header="u,y", comments="", fmt="%.9g")
    return [
        "data=recorded",
        f"data.path={path}",
        "data.input=u",
        "data.output=y",
        "data.step_s=0.1",
    ]


def requests(folder: Path) -> dict[str, list[str]]:
    """What is asked of the command, by the name of the log."""
    asked = {
        name: written(folder, name, u, y) + OWN.get(name, []) for name, (u, y, *_) in LOGS.items()
    }
    good = written(folder, "good", U, answer(U))
    asked |= {
        "test equal to training": [*good, f"data.test_path={folder / 'good.csv'}"],
        "good": good,
    }
    asked |= {f"{name}, measured": [f"data={name}"] for name in MEASURED}
    for plant in PLANTS:
        words = [f"plant={plant}", *RESIDUAL.get(plant, [])]
        for order, seed in ((4, 0), (4, 1), (8, 0), (8, 1)):
            asked[f"{plant}, order {order}, seed {seed}"] = [
                *words,
                f"model.order={order}",
                f"seed={seed}",
            ]
    return asked


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", type=Path, required=True)
    to = parser.parse_args().to
    to.mkdir(parents=True, exist_ok=True)
    rows = []
    with TemporaryDirectory() as scratch:
        for k, (name, words) in enumerate(requests(Path(scratch)).items()):
            ssm_study(["run", *words, f"study=log{k}", "progress=false", f"results_dir={scratch}"])
            (run,) = (Path(scratch) / f"log{k}").glob("*/record.json")
            rows.append(
                {"log": name} | {column: read_record(run.parent).get(column) for column in SHOWN}
            )
            pd.DataFrame(rows).to_csv(
                to / "logs.csv", index=False, lineterminator="\n", float_format="%.4g"
            )


if __name__ == "__main__":
    main()
