"""Every number asked of speed and training beside what was seen, in one table, from the tables of the other benchmarks.

python benchmarks/training_targets.py      # reads and writes results/reference/training; run the others first
"""

import csv
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "results" / "reference" / "training"
Row = dict[str, str]


def read(name: str) -> list[Row]:
    path = FOLDER / name
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def row(what: str, seen: float, wanted: float, at_most: bool, source: str) -> Row:
    """One line: `seen` and `wanted` are in the unit that `what` names."""
    sign, met = ("at most", seen <= wanted) if at_most else ("at least", seen >= wanted)
    return {"what": what, "wanted": f"{sign} {wanted:g}", "seen": f"{seen:.3g}", "met": str(met), "source": source}


def recurrence() -> Iterator[Row]:
    name, table = "recurrence.csv", read("recurrence.csv")
    ms = {(int(r["samples"]), int(r["modes"]), int(r["batch"]), r["contender"]): float(r["cpu_ms"]) for r in table}
    cases = sorted({key[:3] for key in ms})
    for case in cases:
        label, ours = f"T = {case[0]}, {case[1]} modes, batch {case[2]}", ms[*case, "automatic"]
        if case[2] == 16:
            yield row(f"ours over the bare FFT, {label}", ours / ms[*case, "bare FFT"], 2.2, True, name)
        least = {(1_000, 8): 6.0, (10_000, 8): 12.0, (10_000, 64): 60.0, (10_000, 256): 200.0}.get(case[:2])
        if least and (*case, "public scan") in ms:
            yield row(f"public LRU scan over ours, {label}", ms[*case, "public scan"] / ours, least, False, name)
        for peer, wanted in (("LSTM", 8.0), ("dynoNet filter", 6.0)):
            if (*case, peer) in ms:
                yield row(f"{peer} over ours, {label}", ms[*case, peer] / ours, wanted, False, name)
    wide, narrow = ms.get((10_000, 256, 16, "automatic")), ms.get((10_000, 8, 16, "automatic"))
    if wide and narrow:
        yield row("256 modes over 8, T = 10000", wide / narrow, 1.6, True, name)


def step() -> Iterator[Row]:
    ms = {r["contender"]: float(r["cpu_ms"]) for r in read("step.csv")}
    label = "whole step, order 16, width 32, batch 16, T = 5000"
    yield row(f"public scan over ours, {label}", ms["public scan"] / ms["ours"], 6.0, False, "step.csv")
    yield row(f"plain eager FFT over ours, {label}", ms["plain eager FFT"] / ms["ours"], 2.0, False, "step.csv")
    yield row("Lightning's overhead per step, ms", ms["Lightning's overhead"], 0.5, True, "step.csv")
    yield row("compile time, s (nothing is compiled)", 0.0, 30.0, True, "step.csv")


def optimisers() -> Iterator[Row]:
    table = {(r["data"], r["optimiser"]): r for r in read("optimisers.csv")}
    motor, adam = table["motor", "lbfgs"], table["motor", "adam"]
    label, name = f"motor, median of {motor['seeds']} seeds", "optimisers.csv"
    ours = float(motor["cpu_s_to_99"])
    yield row(f"CPU seconds to 99 % of the best known fit by the default, {label}", ours, 5.0, True, name)
    yield row(f"Adam's time over it, {label}", float(adam["cpu_s_to_99"]) / ours, 2.0, False, name)
    worst = float(motor["worst_end_percent"])
    yield row("worst end by the default, % of the best known fit, motor", worst, 97.0, False, name)


def together() -> Iterator[Row]:
    for r in read("together.csv"):
        label = f"{r['members']} members, T = {r['samples']}"
        seen = float(r["two_processes_ratio"])
        yield row(f"members together on two cores over one by one, {label}", seen, 3.5, False, "together.csv")


def main() -> None:
    rows = [*recurrence(), *step(), *optimisers(), *together()]
    with (FOLDER / "targets.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print(
        *(f"{r['what']}: {r['seen']} ({r['wanted']}) {'' if r['met'] == 'True' else 'MISSED'}" for r in rows), sep="\n"
    )


if __name__ == "__main__":
    main()
