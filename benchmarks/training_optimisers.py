"""Which optimiser is the default: CPU seconds to 95, 99 and 99.9 % of the best known training fit,
ten seeds each.

python benchmarks/training_optimisers.py [seeds [minutes]]    # runs what is missing, then writes
the table
Every run is appended to results/reference/training/optimiser_curves.csv, so that it goes on where
it stopped; the table
optimisers.csv beside it is computed from all runs there. EMPS needs its MAT files (docs/data.md).
"""

import csv
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import REFERENCE, ROOT, rows_of, write
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from models_clock import machine
from scipy.signal import lfilter

from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.training import saving

FOLDER = REFERENCE / "training"
CURVES = FOLDER / "optimiser_curves.csv"
TABLE = FOLDER / "optimisers.csv"
EPOCHS = {"lbfgs": 60, "levenberg": 20, "adam": 30}  # each ends on its plateau
SHARES = (95.0, 99.0, 99.9)

saving.time.perf_counter = time.process_time  # type: ignore[assignment] # the machine is shared: CPU seconds


def read(group: str, *overrides: str) -> Any:
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        return instantiate(compose(overrides=list(overrides))[group], _convert_="all")


def motor(seed: int) -> DataSet:
    plant = read("plant", "+plant=dc_motor")
    excitation = read("excitation", "+excitation=aprbs")
    return read("data", "+data=simulated", "data.validation_samples=1000").build(
        plant, excitation, seed
    )


def emps(seed: int) -> DataSet:
    """Motor voltage to velocity; the records are what they are, the seed moves the starting point
    alone."""
    return read("data", "+data=emps").build(seed)


def wiener_hammerstein(seed: int) -> DataSet:
    """Filter, saturation with a dead zone, filter, noise of 2 %: eight records of 1000 samples,
    levels held for 10."""
    rng = np.random.default_rng(seed)

    def record(name: str) -> Trajectory:
        u = np.repeat(rng.uniform(-2, 2, 100), 10)[:, None]
        v = lfilter([0.0, 0.2], [1.0, -0.8], u, axis=0)
        bent = np.tanh(np.sign(v) * np.maximum(np.abs(v) - 0.2, 0.0)) + 0.1 * v
        y = lfilter([0.0, 0.1, 0.05], [1.0, -1.5, 0.65], bent, axis=0)
        return Trajectory(
            u=u, y=y + 0.02 * y.std() * rng.normal(size=y.shape), step_s=0.01, name=name
        )

    records = [record(f"record_{i}") for i in range(10)]
    zero = np.zeros(1)
    scale = np.array([records[0].y.std()])
    return DataSet(
        training=tuple(records[:8]), validation=(records[8],), test=(records[9],),
        inputs=(Channel(name="input", unit="1"),), outputs=(Channel(name="output", unit="1"),),
        scale=Scale(
            input_equilibrium=zero, output_equilibrium=zero, input_scale=np.array([1.2]),
            output_scale=scale
        ),
    )  # fmt: skip


CASES: dict[str, tuple[Callable[[int], DataSet], tuple[str, ...]]] = {
    "motor": (motor, ("model.order=8",)),
    "synthetic Wiener-Hammerstein": (
        wiener_hammerstein,
        ("model.order=6", "scaffold@model.scaffold_out=monotone"),
    ),
    "EMPS": (emps, ("model.order=4",)),
}


def curve(
    optimiser: str, data: DataSet, model: tuple[str, ...], seed: int
) -> list[dict[str, float]]:
    # No roughness penalty here: Levenberg-Marquardt cannot see it, and the comparison is of one
    # error.
    epochs = [f"training.{name}={EPOCHS[optimiser]}" for name in ("max_epochs", "patience")]
    training = read(
        "training",
        "+training=default",
        f"training/optimiser={optimiser}",
        "training.roughness_weight=0.0",
        *epochs,
    )
    with tempfile.TemporaryDirectory() as folder:
        return training.identify(
            read("model", "+model=ssm", *model), data, seed, Path(folder)
        ).curve


def known() -> dict[tuple[str, str, int], list[tuple[float, float]]]:
    """`(seconds, fit)` of every run so far, by data, optimiser and seed."""
    runs: dict[tuple[str, str, int], list[tuple[float, float]]] = defaultdict(list)
    for row in rows_of(CURVES):
        seen = float(row["cpu_s"]), float(row["fit_percent"])
        runs[row["data"], row["optimiser"], int(row["seed"])].append(seen)
    return runs


def run_missing(seeds: int, minutes: float) -> None:
    deadline = time.monotonic() + 60 * minutes
    done = known()
    missing = [
        (c, o, s) for s in range(seeds) for c in CASES for o in EPOCHS if (c, o, s) not in done
    ]
    for case, optimiser, seed in missing:
        if time.monotonic() > deadline:
            return
        make, model = CASES[case]
        try:
            data = make(seed)
        except BadRequest as reason:
            print(f"{case} left out: {reason}")
            continue
        points = [
            (row["seconds"], row["fit_training_percent"])
            for row in curve(optimiser, data, model, seed)
        ]
        fresh = not CURVES.exists()
        with CURVES.open("a", newline="") as file:
            writer = csv.writer(file)
            if fresh:
                writer.writerow(["data", "optimiser", "seed", "cpu_s", "fit_percent"])
            writer.writerows(
                [case, optimiser, seed, f"{cpu_s:.3f}", f"{fit:.4f}"] for cpu_s, fit in points
            )
        print(
            case,
            optimiser,
            seed,
            f"{points[-1][0]:.1f} s, best {max(fit for _, fit in points):.2f} %",
            flush=True,
        )


def reach(points: list[tuple[float, float]], fit: float) -> float:
    return next((seconds for seconds, value in points if value >= fit), float("inf"))


def table() -> list[dict[str, object]]:
    """Medians over the seeds that all optimisers ran; the best known fit is that of the same data
    and seed."""
    runs = known()
    rows = []
    for case in CASES:
        seeds = [s for s in range(1000) if all((case, o, s) in runs for o in EPOCHS)]
        best = {s: max(fit for o in EPOCHS for _, fit in runs[case, o, s]) for s in seeds}
        for optimiser in EPOCHS if seeds else ():
            row: dict[str, object] = {"data": case, "optimiser": optimiser, "seeds": len(seeds)}
            for share in SHARES:
                times = [reach(runs[case, optimiser, s], share * best[s] / 100) for s in seeds]
                row |= {f"cpu_s_to_{share:g}": f"{statistics.median(times):.2f}"}
                row |= {f"reached_{share:g}": sum(t < float("inf") for t in times)}
            ends = [100 * max(fit for _, fit in runs[case, optimiser, s]) / best[s] for s in seeds]
            rows.append(row | {"worst_end_percent": f"{min(ends):.2f}"})
    return rows


def main(seeds: int, minutes: float) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    run_missing(seeds, minutes)
    rows = table()
    write(TABLE, rows)
    about = (
        f"# {machine()}; medians over seeds; inf: never reached; float64, default settings "
        "otherwise\n"
    )
    TABLE.write_text(about + TABLE.read_text())
    print(TABLE.read_text())


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 10,
        float(sys.argv[2]) if len(sys.argv) > 2 else 60.0,
    )
