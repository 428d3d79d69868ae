"""Every number asked of speed and training beside what was seen, in one table, from the tables of
the other benchmarks.

python benchmarks/training_targets.py      # reads and writes results/reference/training; run the
others first
floor: the same ratio, had ours cost no more than the bare FFT: forward and inverse transform with
their gradients.
"""

from collections.abc import Iterator

from common import REFERENCE, rows_of, write

FOLDER = REFERENCE / "training"
BATCH = 16
SCAN = {(1_000, 8): 6.0, (10_000, 8): 12.0, (10_000, 64): 60.0, (10_000, 256): 200.0}
"""Samples and modes to how many times faster than the public scan."""
Row = dict[str, str]


def read(name: str) -> list[Row]:
    return rows_of(FOLDER / name)


def row(
    what: str, seen: float, wanted: float, at_most: bool, source: str, floor: float | None = None
) -> Row:
    """One line: `seen`, `wanted` and `floor`, what a run of nothing but the floor would show, in
    `what`'s unit."""
    sign, met = ("at most", seen <= wanted) if at_most else ("at least", seen >= wanted)
    numbers = {
        "wanted": f"{sign} {wanted:g}",
        "seen": f"{seen:.3g}",
        "floor": "" if floor is None else f"{floor:.3g}",
    }
    return {"what": what, **numbers, "met": str(met), "source": source}


def recurrence() -> Iterator[Row]:
    name = "recurrence.csv"
    table = read("recurrence.csv")
    ms = {
        (int(r["samples"]), int(r["modes"]), int(r["batch"]), r["contender"]): float(r["cpu_ms"])
        for r in table
    }
    cases = sorted({key[:3] for key in ms if key[2] == BATCH})
    for case in cases:
        label = f"T = {case[0]}, {case[1]} modes, batch {case[2]}"
        ours = ms[*case, "automatic"]
        bare = ms[*case, "bare FFT"]
        yield row(f"ours over the bare FFT, {label}", ours / bare, 2.2, True, name)
        for peer, wanted in (
            ("public scan", SCAN.get(case[:2])),
            ("LSTM", 8.0),
            ("dynoNet filter", 6.0),
        ):
            if wanted and (*case, peer) in ms:
                theirs = ms[*case, peer]
                yield row(
                    f"{peer} over ours, {label}", theirs / ours, wanted, False, name, theirs / bare
                )
    wide = (10_000, 256, 16)
    narrow = (10_000, 8, 16)
    for which in ("automatic", "convolution"):
        if (*wide, which) in ms and (*narrow, which) in ms:
            many = ms[*wide, which]
            few = ms[*narrow, which]
            bare = ms[*wide, "bare FFT"]
            yield row(
                f"256 modes over 8, T = 10000, {which} for both",
                many / few,
                1.6,
                True,
                name,
                bare / few,
            )


def step() -> Iterator[Row]:
    ms = {r["contender"]: float(r["cpu_ms"]) for r in read("step.csv")}
    label = "whole step, order 16, width 32, batch 16, T = 5000"
    yield row(
        f"public scan over ours, {label}", ms["public scan"] / ms["ours"], 6.0, False, "step.csv"
    )
    yield row(
        f"plain eager FFT over ours, {label}",
        ms["plain eager FFT"] / ms["ours"],
        2.0,
        False,
        "step.csv",
    )
    for name in (name for name in ms if name.startswith("Lightning's overhead")):
        yield row(f"{name}, ms per step", ms[name], 0.5, True, "step.csv")
    yield row("compile time, s (nothing is compiled)", 0.0, 30.0, True, "step.csv")


def optimisers() -> Iterator[Row]:
    table = {(r["data"], r["optimiser"]): r for r in read("optimisers.csv")}
    motor = table["motor", "lbfgs"]
    adam = table["motor", "adam"]
    label = f"motor, median of {motor['seeds']} seeds"
    name = "optimisers.csv"
    ours = float(motor["cpu_s_to_99"])
    yield row(
        f"CPU seconds to 99 % of the best known fit by the default, {label}", ours, 5.0, True, name
    )
    yield row(f"Adam's time over it, {label}", float(adam["cpu_s_to_99"]) / ours, 2.0, False, name)
    worst = float(motor["worst_end_percent"])
    yield row("worst end by the default, % of the best known fit, motor", worst, 97.0, False, name)


def main() -> None:
    rows = [*recurrence(), *step(), *optimisers()]
    write(FOLDER / "targets.csv", rows)
    print(
        *(
            f"{r['what']}: {r['seen']} ({r['wanted']}) {'' if r['met'] == 'True' else 'MISSED'}"
            for r in rows
        ),
        sep="\n",
    )


if __name__ == "__main__":
    main()
