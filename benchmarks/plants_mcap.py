"""How many samples per second a recording is written and read back with, checksums verified.

    python benchmarks/plants_mcap.py

writes `results/reference/benchmarks/plants_mcap.csv`: 100,000 samples of one topic, by number of
signals in it.
"""

import csv
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from common import REFERENCE

from ssm_study.data.mcap import SignalGroup, read_mcap, write_mcap
from ssm_study.signals import Channel

OUT = REFERENCE / "benchmarks" / "plants_mcap.csv"
SAMPLES = 100_000
ROUNDS = 3


def measured(signals: int, folder: Path) -> list[object]:
    values = np.random.default_rng(0).standard_normal((SAMPLES, signals))
    channels = tuple(Channel(name=f"signal_{k}", unit="1") for k in range(signals))
    group = SignalGroup(
        topic="/signals", time_s=np.arange(SAMPLES) * 0.01, channels=channels, values=values
    )
    path = folder / "a.mcap"
    writing = []
    reading = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        write_mcap(path, (group,), {})
        middle = time.perf_counter()
        (back,), _ = read_mcap(path)
        writing.append(middle - start)
        reading.append(time.perf_counter() - middle)
        assert np.array_equal(back.values, values)
    write_s = median(writing)
    read_s = median(reading)
    return [signals, f"{write_s:.3f}", f"{read_s:.3f}", f"{SAMPLES / write_s:.3g}",
            f"{SAMPLES / read_s:.3g}",
            f"{path.stat().st_size / 1e6:.1f}"]  # fmt: skip


def main() -> None:
    OUT.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, OUT.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            [
                "signals",
                "write_s",
                "read_s",
                "samples_written_per_s",
                "samples_read_per_s",
                "megabytes",
            ]
        )
        writer.writerows(measured(signals, Path(folder)) for signals in (1, 4, 12))
    print(OUT.read_text())


if __name__ == "__main__":
    main()
