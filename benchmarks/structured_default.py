"""One layer or neurons inside, by held-out folds of the training records, each class by its yaml as
it stands.

    python benchmarks/structured_default.py [--only ced dc_motor ...] [--to FILE]

writes results/reference/training/structured_default.csv: one row per plant or record and class with
the mean, worst and best fit over four folds (whole records where there are four, else pieces of
each) and processor seconds a fold. Validation and test records are not looked at. What it decided
stands in docs/models.md.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from common import REFERENCE, study_of
from structured_plants import written

from ssm_study.refusal import BadRequest
from ssm_study.training.folds import make_folds
from ssm_study.training.metrics import records_fit_percent
from ssm_study.training.saving import train_with_lightning  # noqa: F401 - its imports are no training

TARGET = REFERENCE / "training" / "structured_default.csv"
PLANTS = ("dc_motor", "stribeck_drive", "cascaded_tanks")
RECORDS = ("ced", "tanks_record", "silverbox", "emps")
CLASSES = ("ssm", "structured")


def row(where: str, model: str) -> dict[str, object]:
    chosen = (
        f"plant={where}"
        if where in PLANTS
        else f"data={where.replace('tanks_record', 'cascaded_tanks')}"
    )
    part = study_of(chosen, f"model={model}")
    data = (
        part.data.build(part.plant, part.excitation, 0) if where in PLANTS else part.data.build(0)
    )
    fits = []
    began = time.process_time()
    for fold in make_folds(replace(data, validation=())):
        with TemporaryDirectory() as folder:
            try:
                found = part.training.identify(part.model, fold, 0, Path(folder))
                fits.append(records_fit_percent(found.model, fold.test, fold))
            except BadRequest:  # the training left the finite
                fits.append(-np.inf)
    told = {"fit_percent": np.mean(fits), "worst_fold": min(fits), "best_fold": max(fits)}
    told["seconds_per_fold"] = (time.process_time() - began) / len(fits)
    return {"on": where, "model": model} | {name: f"{value:.4g}" for name, value in told.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", choices=(*PLANTS, *RECORDS), default=(*PLANTS, *RECORDS)
    )
    parser.add_argument("--to", type=Path, default=TARGET)
    options = parser.parse_args()
    rows = []
    for where in options.only:
        for model in CLASSES:
            rows.append(row(where, model))
            written(rows, options.to)


if __name__ == "__main__":
    main()
