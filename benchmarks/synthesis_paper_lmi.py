"""The paper's inequality on the thousand random models: `python benchmarks/synthesis_paper_lmi.py`
(hours; resumes).

The same models and requests as the other methods of `synthesis_certified.py`, orders 1 to 32;
Theorem 1 with all its unknowns (P, Y, X, sigma) through CVXPY and Clarabel, one solve each, nothing
repaired. A solve that takes longer than `LIMIT_S` counts as not found. Every solve is a row of
`results/reference/certificates/paper_lmi.csv`; a second call goes on where the first one stopped,
and `--minutes M` stops it. At its end it writes the counts into `certified.csv` and, by order,
`paper_lmi_by_order.csv`.
"""

import argparse
import csv
import itertools
import time
import warnings
from collections import Counter
from collections.abc import Iterator

import numpy as np
from common import rows_of, write
from synthesis_certified import FOLDER, GAPS, instances, kept, told
from synthesis_instances import Instance

from ssm_study.certificates.semidefinite import SOLVERS
from ssm_study.synthesis.lmi import certificate_from_paper_lmi

TARGET = FOLDER / "paper_lmi.csv"
COLUMNS = ("gap", "index", "order", "kind", "status", "certified", "seconds")
COUNT = 1000
BLOCK = 50
# Small orders first: two thirds of the time go to the last band. Within a band a block of models
# goes through every gap, so that an unfinished band is still a fair sample of its orders.
BANDS = ((1, 8), (9, 16), (17, 20), (21, 26), (27, 32))
LIMIT_S = 120.0

Row = dict[str, str]
Cases = dict[float, list[Instance]]


def open_cases(cases: Cases, done: set[tuple[str, str]]) -> Iterator[tuple[float, int, Instance]]:
    for (low, high), first in itertools.product(BANDS, range(0, COUNT, BLOCK)):
        for gap, index in itertools.product(GAPS, range(first, first + BLOCK)):
            if low <= cases[gap][index].linear.order <= high and (str(gap), str(index)) not in done:
                yield gap, index, cases[gap][index]


def row(gap: float, index: int, case: Instance) -> Row:
    started = time.process_time()
    opinion = certificate_from_paper_lmi(case.linear, case.ball, case.rate)
    values = (gap, index, case.linear.order, case.kind, opinion.solver_status, opinion.certified)
    return dict(
        zip(COLUMNS, [*map(str, values), f"{time.process_time() - started:.4f}"], strict=True)
    )


def solve(cases: Cases, minutes: float) -> None:
    started = time.monotonic()
    rows = rows_of(TARGET)
    with TARGET.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if not rows:
            writer.writeheader()
        for gap, index, case in open_cases(cases, {(row["gap"], row["index"]) for row in rows}):
            if time.monotonic() - started > 60 * minutes:
                return
            writer.writerow(row(gap, index, case))
            file.flush()


def count(gap: float, rows: list[Row]) -> dict[str, object]:
    models = [(int(row["order"]), row["kind"]) for row in rows]
    held = [row["certified"] == "True" for row in rows]
    seconds = [float(row["seconds"]) for row in rows]
    return told(("random", "paper_lmi", gap), models, held, seconds)


def by_order(cases: Cases, rows: list[Row]) -> list[dict[str, object]]:
    """Of each band and gap: models, how many were solved, how many certified, what the solver
    called the rest."""
    table = []
    for (low, high), gap in itertools.product(BANDS, sorted(GAPS, reverse=True)):
        models = sum(low <= case.linear.order <= high for case in cases[gap])
        here = [row for row in rows if row["gap"] == str(gap) and low <= int(row["order"]) <= high]
        status = Counter(
            row["status"].removeprefix("clarabel: ") for row in here if row["certified"] != "True"
        )
        table.append(
            {
                "orders": f"{low}-{high}",
                "gap": gap,
                "models": models,
                "solved": len(here),
                "certified": sum(row["certified"] == "True" for row in here),
                "otherwise": "; ".join(f"{count} {word}" for word, count in status.most_common()),
            }
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=np.inf)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    SOLVERS["CLARABEL"]["time_limit"] = LIMIT_S
    cases = {gap: instances("random", gap, COUNT, (1, 32)) for gap in GAPS}
    solve(cases, arguments.minutes)
    rows = rows_of(TARGET)
    for gap in GAPS:
        of_gap = [row for row in rows if row["gap"] == str(gap)]
        if of_gap:
            kept(count(gap, of_gap))
            print(gap, len(of_gap), sum(row["certified"] == "True" for row in of_gap), flush=True)
    write(FOLDER / "paper_lmi_by_order.csv", by_order(cases, rows))


if __name__ == "__main__":
    main()
