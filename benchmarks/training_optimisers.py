"""Which optimiser is the default: CPU seconds to 95, 99 and 99.9 % of the best known training fit, over seeds.

python benchmarks/training_optimisers.py [seeds]     # writes results/reference/training/optimisers.csv
"""

import csv
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from models_clock import machine

from ssm_study.signals import DataSet
from ssm_study.training import progress

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "results" / "reference" / "training" / "optimisers.csv"
EPOCHS = {"lbfgs": 40, "levenberg": 12, "adam": 30}  # each ends on its plateau
SHARES = (95.0, 99.0, 99.9)

progress.time.perf_counter = time.process_time  # type: ignore[assignment] # the machine is shared: CPU seconds


def read(group: str, *overrides: str) -> Any:
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        return instantiate(compose(overrides=list(overrides))[group], _convert_="all")


def motor(seed: int) -> DataSet:
    plant, excitation = read("plant", "+plant=dc_motor"), read("excitation", "+excitation=aprbs")
    return read("data", "+data=simulated", "data.validation_samples=1000").build(plant, excitation, seed)


def wiener(seed: int) -> DataSet:
    sys.path.insert(0, str(ROOT / "tests" / "laws"))
    from models_cases import data_set

    return data_set(noise=0.02, samples=1000, records=8, seed=seed)


def curve(name: str, data: DataSet, order: int, seed: int) -> list[tuple[float, float]]:
    # No roughness penalty here: Levenberg-Marquardt cannot see it, and the comparison is of one error.
    settings = ["training.roughness_weight=0", *(f"training.{k}={EPOCHS[name]}" for k in ("max_epochs", "patience"))]
    training = read("training", "+training=default", f"training/optimiser={name}", *settings)
    spec = read("model", "+model=ssm", f"model.order={order}")
    with tempfile.TemporaryDirectory() as folder:
        found = training.identify(spec, data, seed, Path(folder))
    return [(row["seconds"], row["fit_training_percent"]) for row in found.curve]


def reach(points: list[tuple[float, float]], fit: float) -> float:
    return next((seconds for seconds, value in points if value >= fit), float("inf"))


def main(seeds: int) -> None:
    rows = []
    for label, make, order in (("motor", motor, 8), ("synthetic Wiener", wiener, 4)):
        ends: dict[str, list[float]] = {name: [] for name in EPOCHS}
        times: dict[tuple[str, float], list[float]] = {(name, share): [] for name in EPOCHS for share in SHARES}
        for seed in range(seeds):
            data = make(seed)
            curves = {name: curve(name, data, order, seed) for name in EPOCHS}
            best = max(value for points in curves.values() for _, value in points)
            for name, points in curves.items():
                ends[name].append(100 * max(value for _, value in points) / best)
                for share in SHARES:
                    times[name, share].append(reach(points, share * best / 100))
        for name in EPOCHS:
            row = {"data": label, "optimiser": name, "seeds": seeds}
            row |= {f"cpu_s_to_{share:g}": f"{statistics.median(times[name, share]):.2f}" for share in SHARES}
            row |= {"worst_end_percent": f"{min(ends[name]):.2f}"}
            rows.append(row)
            print(row, flush=True)
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    with TARGET.open("w", newline="") as file:
        file.write(f"# {machine()}; medians over seeds; inf: never reached; float64, default settings otherwise\n")
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
