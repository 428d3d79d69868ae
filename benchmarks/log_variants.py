"""One log written in many ways, and read back: `python benchmarks/log_variants.py [FILES]`.

Drawn by hypothesis: separators x decimal marks x names x clocks x holes x missing values x
encodings x comments x units x line ends x quoted cells x a column that counts rows. Each file is
read with the settings a user types first: `data.input` and `data.output`, and `data.step_s` where
no clock stands in the file. Four ends are counted: read right, refused in a sentence, wrong in
silence (another step or other numbers), a traceback. Of the files that are not ambiguous at least
95 % are to be read, and none may be wrong. With `--to` the counts, by what each file was written
with, stand in a table.
"""

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pandas as pd
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest

ROWS = 400
SINCE_1970_MS = 1_772_700_000_000
FIRST_DAY = 46086.375  # of a spreadsheet: 5 March 2026, nine o'clock
ENDS = ("read", "refused", "wrong", "traceback")
NAMES = {
    "plain": ("u", "y"),
    "words": ("Motor voltage", "Speed"),
    "units": ("voltage [V]", "speed [rad/s]"),
    "brackets": ("Servo 1 (us)", "Drehzahl (1/min)"),
    "accents": ("Öltemp", "Température"),
    "none": ("", ""),
}
CLOCKS = {
    "none": ("", 0.0),
    "t": ("t", 1.0),
    "time (s)": ("Time (s)", 1.0),
    "ms": ("time_ms", 1e3),
    "ms in brackets": ("time(ms)", 1e3),
    "us": ("timestamp_us", 1e6),
    "min": ("t [min]", 1 / 60),
    "hours": ("elapsed time (h)", 1 / 3600),
    "date": ("date", 0.0),
    "date with zone": ("Timestamp", 0.0),
    "european date": ("Datum", 0.0),
    "date with month": ("Zeitpunkt", 0.0),
    "date in digits": ("timestamp", 0.0),
    "date of a spreadsheet": ("Date", 0.0),
    "ms since 1970": ("ts", 1e3),
}


@dataclass(frozen=True, kw_only=True)
class Variant:
    """How one file is written."""

    separator: str
    decimal: str
    names: str
    clock: str
    holes: int
    missing: int
    encoding: str
    comments: int
    units_row: bool
    line_end: str
    step_s: float
    trailing: bool
    quoted: bool
    counter: bool
    seed: int


def is_possible(variant: Variant) -> bool:
    """Whether a program could write such a file and a reader could understand it."""
    dated = "date" in variant.clock
    ascii_only = variant.encoding == "ascii" and variant.names == "accents"
    words_by_spaces = variant.separator == " " and (
        variant.names not in ("plain", "none")
        or dated
        or variant.missing > 0
        or variant.units_row
        or CLOCKS[variant.clock][0] not in ("", "t", "time_ms", "timestamp_us")
    )
    both = variant.separator == variant.decimal and not variant.quoted
    nameless = ("none", "t", "date", "ms since 1970", "date in digits")
    bare_clock = variant.names == "none" and variant.clock not in nameless
    bare_units = variant.units_row and variant.names in ("none", "units", "brackets")
    dated_fast = dated and variant.step_s < 1.0
    bare_counter = variant.counter and (variant.names == "none" or variant.separator == " ")
    names = (words_by_spaces, bare_clock, bare_units, bare_counter)
    return not (ascii_only or both or dated_fast or any(names))


variants = st.builds(
    Variant,
    separator=st.sampled_from([",", ";", "\t", " ", "|"]),
    decimal=st.sampled_from([".", ","]),
    names=st.sampled_from(sorted(NAMES)),
    clock=st.sampled_from(sorted(CLOCKS)),
    holes=st.integers(0, 2),
    missing=st.sampled_from([0, 0, 3]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "cp1252", "utf-16"]),
    comments=st.sampled_from([0, 0, 2]),
    units_row=st.booleans(),
    line_end=st.sampled_from(["\n", "\r\n"]),
    step_s=st.sampled_from([0.001, 0.01, 0.25, 1.0, 60.0]),
    trailing=st.booleans(),
    quoted=st.sampled_from([False, False, True]),
    counter=st.sampled_from([False, False, True]),
    seed=st.integers(0, 10_000),
).filter(is_possible)


@dataclass(frozen=True, kw_only=True)
class Written:
    """A file, the settings a user types for it, and what it holds."""

    path: Path
    settings: dict[str, object]
    u: np.ndarray
    y: np.ndarray


def write(variant: Variant, folder: Path) -> Written:
    """Write the log as the variant says."""
    rng = np.random.default_rng(variant.seed)
    u = np.round(np.repeat(rng.uniform(-5, 5, ROWS // 8), 8), 3)
    y = np.round(np.convolve(u, 0.2 * 0.8 ** np.arange(40))[:ROWS] + 0.37, 4)
    index = np.arange(ROWS)
    has_clock = variant.clock != "none"
    if has_clock:
        for hole in range(variant.holes):
            index[(hole + 1) * 120 :] += 50
    rows = [[number(v, variant.decimal) for v in pair] for pair in zip(u, y, strict=True)]
    gaps = rng.choice(np.arange(50, 350), variant.missing, replace=False)
    for gap in gaps:
        rows[gap][1] = "" if variant.seed % 2 else "NaN"
    names = list(NAMES[variant.names])
    units = ["V", "rpm"]
    if has_clock:
        times = clock_cells(variant, index)
        rows = [[time, *row] for time, row in zip(times, rows, strict=True)]
        names = [CLOCKS[variant.clock][0], *names]
        units = ["s", *units]
    if variant.counter:
        rows = [[str(k), *row] for k, row in enumerate(rows)]
        names = ["", *names]
        units = ["", *units]
    if variant.quoted:
        rows = [[f'"{cell}"' for cell in row] for row in rows]
        names = [f'"{name}"' for name in names]
        units = [f'"{unit}"' for unit in units]
    lines = ["# logged by a program, 2026"] * variant.comments
    if variant.names != "none":
        lines.append(variant.separator.join(names))
    if variant.units_row:
        plain = variant.clock in ("none", "t")
        lines += [variant.separator.join(units)] if plain else []
    lines += [variant.separator.join(row) for row in rows]
    lines += [""] * (3 * variant.trailing)
    path = folder / "log.txt"
    content = variant.line_end.join(lines) + variant.line_end
    path.write_bytes(content.encode(variant.encoding))
    bare = variant.names == "none"
    asked: dict[str, object] = {
        "input": int(has_clock) if bare else NAMES[variant.names][0],
        "output": int(has_clock) + 1 if bare else NAMES[variant.names][1],
    }
    if not has_clock:
        asked["step_s"] = variant.step_s
    known = np.isfinite(np.where(np.isin(np.arange(ROWS), gaps), np.nan, y))
    return Written(path=path, settings=asked, u=u[known], y=y[known])


def number(value: float, decimal: str) -> str:
    """A number as programs write it."""
    return f"{value:.6g}".replace(".", decimal)


def clock_cells(variant: Variant, index: np.ndarray) -> list[str]:
    """The times as the variant writes them."""
    seconds = variant.step_s * index
    if variant.clock == "ms since 1970":
        return [f"{SINCE_1970_MS + 1000 * second:.0f}" for second in seconds]
    if variant.clock == "date of a spreadsheet":
        days = [FIRST_DAY + second / 86400 for second in seconds]
        return [f"{day:.10f}".replace(".", variant.decimal) for day in days]
    if "date" not in variant.clock:
        factor = CLOCKS[variant.clock][1]
        return [f"{factor * second:.9g}".replace(".", variant.decimal) for second in seconds]
    stamps = np.datetime64("2026-02-27T23:10:00") + seconds.astype("timedelta64[s]")
    texts = [str(stamp).replace("T", " ") for stamp in stamps]
    if variant.clock == "date in digits":
        return [re.sub(r"\D", "", text) for text in texts]
    if variant.clock == "date with month":
        return [pd.Timestamp(text).strftime("%d-%b-%Y %H:%M:%S") for text in texts]
    if variant.clock == "european date":
        return [f"{t[8:10]}.{t[5:7]}.{t[:4]} {t[11:]}" for t in texts]
    return [f"{text}+01:00" for text in texts] if "zone" in variant.clock else texts


def outcome(variant: Variant, folder: Path) -> tuple[str, str]:
    """`read`, `refused`, `wrong` or `traceback`, and what was said."""
    written = write(variant, folder)
    try:
        source = RecordedData(path=str(written.path), **written.settings)  # type: ignore[arg-type]
        pieces, _ = source.read_pieces(written.path)
    except BadRequest as error:
        return "refused", str(error)
    except Exception as error:  # what is counted
        return "traceback", repr(error)
    u = np.concatenate([piece.u[:, 0] for piece in pieces])
    y = np.concatenate([piece.y[:, 0] for piece in pieces])
    step_s = pieces[0].step_s
    if abs(step_s - variant.step_s) > 1e-3 * variant.step_s:
        return "wrong", f"step {step_s:g}"
    # Stretches of one or two rows between missing values are left out.
    near = len(y) >= len(written.y) - 2 * (variant.missing + variant.holes)
    same = near and set(np.round(y, 6)) <= set(np.round(written.y, 6))
    same = same and (len(u) != len(written.u) or np.allclose(u, written.u, atol=1e-6))
    return ("read", "") if same else ("wrong", f"{len(y)} of {len(written.y)} rows")


def counts_by_feature(outcomes: Sequence[tuple[Variant, str]]) -> pd.DataFrame:
    """How many files were read, refused, wrong or ended in a traceback: all, and by how they were
    written."""
    rows: list[dict[str, object]] = [{"feature": "all", "value": "", **counts(outcomes)}]
    features = [field.name for field in fields(Variant) if field.name != "seed"]
    for feature in features:
        values = sorted({str(getattr(variant, feature)) for variant, _ in outcomes})
        for value in values:
            alike = [pair for pair in outcomes if str(getattr(pair[0], feature)) == value]
            rows.append({"feature": feature, "value": repr(value)[1:-1], **counts(alike)})
    return pd.DataFrame(rows)


def counts(outcomes: Sequence[tuple[Variant, str]]) -> dict[str, int]:
    """How many files there are, and how they ended."""
    ends = Counter(end for _, end in outcomes)
    return {"files": len(outcomes), **{end: ends[end] for end in ENDS}}


def main() -> None:
    """Draw the files, print the counts and what was not read."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", nargs="?", type=int, default=500, help="how many files")
    parser.add_argument("--to", type=Path, help="table of the counts (CSV)")
    options = parser.parse_args()
    outcomes: list[tuple[Variant, str]] = []
    remarks: list[str] = []

    with tempfile.TemporaryDirectory() as folder:

        @settings(
            max_examples=options.count,
            derandomize=True,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(variants)
        def draw(variant: Variant) -> None:
            end, said = outcome(variant, Path(folder))
            outcomes.append((variant, end))
            if end != "read":
                remarks.append(f"{end}: {said[:160]} | {variant}")

        draw()
    for remark in remarks[:40]:
        print(remark)
    print(f"{len(outcomes)} files: {counts(outcomes)}")
    if options.to is not None:
        counts_by_feature(outcomes).to_csv(options.to, index=False)


if __name__ == "__main__":
    main()
