"""What a run came to, on one screen: the claim, the numbers that bear it, and where the figures
lie."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ssm_study.evidence.finding import CANNOT_JUDGE, DOUBT
from ssm_study.report.words import SETTLED, decides, judged

WIDTH = 80
MISSING = "–"
LIMITS = ("limit_lower", "limit_upper", "limited_rate", "unlimited_from", "unlimited_to")
LIMITED = "{} to {}: rate {} from everywhere, the full rate from outputs {} to {}"
EACH_ITS_OWN = "a range of each output (see the exported header)"
# A simulated plant's loop knows given limits alone; the exported code, for want of others, the
# range of the records.
LIMITS_OF = {False: "Within input limits", True: "Exported, within limits"}
SCORE_UNITS = {
    "emps": " mm",
    "cascaded_tanks": " V",
    "ced": " ticks/s",
}  # as the benchmarks publish them


def print_outcome(record: Mapping[str, Any], figures: Sequence[Path], console: Console) -> None:
    """The end-of-run table, at most 80 columns wide, and where the figures lie."""
    console.print(outcome_table(record), width=min(WIDTH, console.width))
    for reason in _reasons(record):
        console.print(Text(reason), soft_wrap=False, width=WIDTH)
    kinds: dict[
        str, list[str]
    ] = {}  # a line per figure, from where the user stands: `figures/rates.png, .pdf`
    for path in figures:
        kinds.setdefault(str(path.with_suffix("")).removeprefix(f"{Path.cwd()}/"), []).append(
            path.suffix
        )
    for stem, suffixes in kinds.items():
        console.print(
            Text(f"  {stem}{', '.join(suffixes)}"), soft_wrap=True, highlight=False
        )  # a path is never broken


def outcome_table(record: Mapping[str, Any]) -> Table:
    """The numbers of `record.json` in the order of the argument: model, certificate, plant."""
    verdict = judged(pd.DataFrame([dict(record)])).iloc[0]
    table = Table(show_header=False, box=None, pad_edge=False, width=WIDTH)
    table.add_column(width=27, no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row("Run", Text(f"{record.get('study', MISSING)}/{record.get('run', MISSING)}"))
    on = "" if _on_plant(record) or verdict != SETTLED else ", on the identified model"
    style = "bold yellow" if record.get("evidence") == CANNOT_JUDGE else verdict.style
    table.add_row("Outcome", Text(f"{verdict.word}: {verdict.sentence}{on}", style=style))
    for column, label, value in _rows(record):
        if record.get(column) is not None:
            table.add_row(label, Text(value))
    return table


def _on_plant(record: Mapping[str, Any]) -> bool:
    return record.get("loop_on") != "identified model"


def _rows(record: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Column that must be known for the line to make sense, label, value."""

    def number(name: str, form: str = ".3g", unit: str = "") -> str:
        value = record.get(name)
        return (
            MISSING
            if value is None
            else f"{value:{form}}{unit}"
            if isinstance(value, (int, float))
            else str(value)
        )

    yield "fit_test_percent", "Fit on the test record", number("fit_test_percent", ".1f", " %")
    for name in sorted(key for key in record if key.startswith("score_test_")):
        unit = SCORE_UNITS.get(str(record.get("benchmark")), "")
        yield (
            name,
            f"Benchmark score, record {name.removeprefix('score_test_')}",
            number(name, ".4g", unit),
        )
    slopes = (
        f"[{number('input_slope_lower')}, {number('input_slope_upper')}] ({number('bound_method')})"
    )
    yield "input_slope_lower", "Slopes of S_u", slopes
    for side in ("controller", "observer"):
        chosen = "chosen by auto" if side in str(record.get("rates_chosen")) else "requested"
        shown = f"{number(f'rate_{side}')} {chosen}, at most {number(f'{side}_rate_limit')}: {_certified(record, side)}"
        yield f"rate_{side}", f"{side.capitalize()} rate", shown
    rates = f"controller {number('controller_certified_rate')}, observer {number('observer_certified_rate')}"
    alone = max(1 - (record.get("spectral_radius") or 1.0) ** 2, 0.0)
    told = (
        "" if record.get("neurons") else f"; model alone {alone:.3g}"
    )  # with neurons A says it not
    yield "controller_certified_rate", "Rate proved of the gains", f"{rates}{told}"
    yield from _proved(number, record)
    yield "evidence", "Evidence", str(record.get("evidence"))
    yield _prediction(record)
    where = {None: "simulated plant", "plant": "simulated plant"}.get(
        record.get("loop_on"), record.get("loop_on")
    )
    settled = (
        f"{number('stable_count', '.0f')} of {number('initial_conditions', '.0f')} on the {where}"
    )
    yield "stable_count", "InitialStates settled", settled
    time_s, alone_s = record.get("settling_time_mean_s"), record.get("settling_time_open_loop_s")
    ratio = f" (ratio {time_s / alone_s:.2f})" if time_s is not None and alone_s else ""
    shown = (
        f"{number('settling_time_mean_s', '.3f', ' s')}, uncontrolled {alone_s or 0:.3f} s{ratio}"
    )
    yield "settling_time_open_loop_s", "Mean settling time", shown


def _proved(
    number: Callable[[str], str], record: Mapping[str, Any]
) -> Iterator[tuple[str, str, str]]:
    """What is proved beside the rates: with limited inputs, of a wrong model, of noise."""
    label, neurons = LIMITS_OF[_on_plant(record)], record.get("neurons")
    if neurons and record.get("controller_certified"):
        yield "neurons", label, "nothing is proved: the theorems on limits know no neurons"
    tolerated = "rest is proved up to {}" if neurons else "{} is proved"
    limited = LIMITED.format(*map(number, LIMITS)).replace(f"rate {MISSING}", "no rate")
    yield LIMITS[0], label, limited.replace(f"outputs {MISSING} to {MISSING}", EACH_ITS_OWN)
    tolerance = tolerated.format(number("certified_tolerance"))
    yield "certified_tolerance", "Mismatch tolerated", tolerance
    yield from _covered(record)
    measured = "" if (share := number("noise_gain_measured")) == MISSING else f", measured {share}"
    more = (record.get("noise_gain_measured") or 0.0) > (
        record.get("noise_gain_model") or float("inf")
    )
    measured += ": more than noise moves it" if more else ""
    yield (
        "noise_gain_model",
        "Sensor noise",
        f"reaches the model's output {number('noise_gain_model')}-fold at the worst frequency{measured}",
    )


def _covered(record: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Whether the proof covers the mismatch that records show; below one it covers nothing, and no
    share is printed."""
    label, coverage = "Model error covered", record.get("coverage")
    if coverage is None:
        yield "coverage_reason", label, f"not covered: {record.get('coverage_reason')}"
        return
    if coverage < 1:
        where = record.get("coverage_reference")
        yield "coverage", label, f"not covered: the records show more than is proved ({where})"
        return
    times = math.floor(100 * coverage) / 100  # never rounded up to what is not proved
    covered = f"{times:.2f} times as large as the records show, at every frequency"
    needed = record.get("coverage_needed")
    fresh = "" if needed is None else f"; the test record needs {math.ceil(100 * needed) / 100:.2f}"
    yield "coverage", label, f"{covered}{fresh}"


def _prediction(record: Mapping[str, Any]) -> tuple[str, str, str]:
    """What model and validation record say of the plant."""
    if record.get("evidence") == CANNOT_JUDGE:
        return "evidence", "Prediction", "none: the evidence allows no judgement"
    said = "stays stable" if record.get("predicted_stable") else "not predicted to be stable"
    said += ", with doubts" if record.get("evidence") == DOUBT else ""
    rests_on = decides(
        *(record.get(name) for name in ("resolved_margin", "controller_radius", "noise_peak"))
    )
    label = "Prediction for the plant" if _on_plant(record) else "Prediction"
    return "predicted_stable", label, f"{said}: {rests_on}" if rests_on else said


def _certified(record: Mapping[str, Any], side: str) -> str:
    if record.get(f"{side}_certified"):
        return "certified"
    feasible = record.get(f"{side}_feasible")
    return "not reached" if feasible is None else "not certified" if feasible else "infeasible"


def _reasons(record: Mapping[str, Any]) -> Iterator[str]:
    """Whatever the record says about why a run is infeasible, not certified or failed."""
    told = re.split(
        r" (?=(?:note|doubt|cannot judge): )", str(record.get("evidence_reasons") or "")
    )
    yield from (
        f"{one[0].upper()}{one[1:]}"
        for one in told
        if one.startswith(("doubt: ", "cannot judge: "))
    )
    for name in ("infeasible_reason", "uncertified_reason", "error_message"):
        if record.get(name):
            yield f"{name.replace('_', ' ').capitalize()}: {record[name]}"
