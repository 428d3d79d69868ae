"""Words and settings of the table: which columns are settings, what they are called, what is
near."""

import json
from pathlib import Path

import pandas as pd
import pytest

from ssm_study.table.columns import (
    DECLARED,
    PARTS,
    boolean_column,
    column_label,
    describe_columns,
    find_declaration,
    group_by_part,
    numeric_column,
    requested_values,
    setting_columns,
    setting_path,
    suggest_column,
    swept_settings,
    text_column,
)
from ssm_study.table.doubts import (
    MOST,
    column_of_setting,
    comparable_setting_text,
    row_count_warnings,
    swept_values,
)
from ssm_study.table.folders import abbreviate_names, find_study_or_run
from ssm_study.table.gather import table_from_records

SETTINGS_AND_MORE = ["plant__step_s", "fit_test_percent", "order", "rates_chosen", "seed"]


def test_every_column_stands_in_the_part_that_declares_it() -> None:
    names = [column.name for column in DECLARED]
    parts = group_by_part(["plant__step_s", "undeclared", "stage_loop_key", *names])
    for title, room in PARTS.items():
        declared = [column.name for column in room.COLUMNS if not column.setting]
        expected = sorted(declared)
        actual = sorted(parts[title])
        assert actual == expected
    expected = set(parts["Settings"])
    actual = {"plant__step_s", "order", "seed"}
    assert actual <= expected
    expected = set(parts["Circumstances"])
    actual = {"undeclared", "stage_loop_key", "status"}
    assert actual <= expected
    counts = [len(part) for part in parts.values()]
    expected = len(names) + 3
    assert sum(counts) == expected
    titles = list(parts)
    expected = ["Settings", *PARTS, "Circumstances"]
    assert titles == expected


def test_settings_are_the_declared_ones_then_the_others_by_name() -> None:
    table = pd.DataFrame(columns=["z__b", *SETTINGS_AND_MORE, "a__b"])
    expected = ["seed", "order", "a__b", "plant__step_s", "z__b"]
    assert setting_columns(table) == expected


PATHS = {
    "plant__step_s": "plant.step_s",
    "order": "model.order",
    "fit_test_percent": "",
    "undeclared": "",
}
LABELS = {
    "plant__step_s": "plant.step_s",
    "order": "Model order",
    "fit_test_percent": "Fit on test record (%)",
    "undeclared_name": "undeclared name",
}


def test_a_setting_has_a_path_and_every_column_a_label() -> None:
    paths = {name: setting_path(name) for name in PATHS}
    assert paths == PATHS
    labels = {name: column_label(name) for name in LABELS}
    assert labels == LABELS


def test_at_most_three_near_names_are_suggested() -> None:
    near = ["fit_a", "fit_b", "fit_c", "fit_d"]
    suggestion = suggest_column("fit_e", near)
    assert suggestion.count(" or ") == 2
    assert suggestion.startswith("did you mean fit_")
    half_alike = suggest_column("abcd", ["abxy"])
    assert half_alike == "did you mean abxy?"
    other = suggest_column("abcd", ["axyz"])
    assert other == "`ssm-study show STUDY --columns` lists them"


def test_the_description_lists_what_has_values() -> None:
    everything = list(describe_columns())
    assert len(everything) == len(DECLARED)
    rows: list[dict[str, object]] = [{"run": "a", "fit_test_percent": 90.0, "seconds": 1.0}]
    rows[0] |= {"order": None, "stage_loop_key": "k", "zz": 1, "aa": 2}
    table = table_from_records(rows)
    described = {line[0]: line[1:] for line in describe_columns(table)}
    expected = ["aa", "zz"]
    actual = list(described)[-2:]
    assert actual == expected
    expected = ("declared nowhere", "", "")
    assert described["zz"] == expected
    expected = ("Fit on test record (%)", "high", "")
    assert described["fit_test_percent"] == expected
    expected = ("seconds", "low", "not checked: depends on when it ran")
    assert described["seconds"] == expected
    assert described["stage_*_key"][2].startswith("not checked: ")
    expected = {"run", "fit_test_percent", "seconds", "stage_*_key", "zz", "aa"}
    assert set(described) == expected


def test_a_rate_that_the_program_chose_reads_auto() -> None:
    chosen = ["controller", "", "controller, observer", None]
    rates = {"rate_controller": [0.1, 0.2, 0.3, 0.4], "rate_observer": [0.1, 0.1, 0.1, 0.1]}
    table = pd.DataFrame({**rates, "order": [4] * 4, "rates_chosen": chosen})
    controller = requested_values(table, "rate_controller")
    expected = ["auto", 0.2, "auto", 0.4]
    assert controller.tolist() == expected
    observer = requested_values(table, "rate_observer")
    expected = [0.1, 0.1, "auto", 0.1]
    assert observer.tolist() == expected
    expected = [4] * 4
    values = requested_values(table, "order").tolist()
    assert values == expected
    # Without `auto`, the observer's rate is the same in all runs.
    expected = ["rate_controller", "rate_observer"]
    assert swept_settings(table) == expected
    actual = swept_settings(table.assign(rates_chosen=""))
    assert actual == ["rate_controller"]


def test_settings_of_many_values_stand_first_and_the_seed_last() -> None:
    varied = {"seed": range(6), "order": [2, 4] * 3, "hidden_width": [8, 16, 32] * 2}
    table = pd.DataFrame({**varied, "slope_lower": 0.1, "study": "s"})
    expected = ["hidden_width", "order", "seed"]
    assert swept_settings(table) == expected
    two_studies = table.assign(study=["a"] * 3 + ["b"] * 3)
    expected = ["hidden_width", "study", "order", "seed"]
    assert swept_settings(two_studies) == expected


def test_missing_values_are_nan_false_or_empty() -> None:
    table = pd.DataFrame({"x": ["1.5", None, "word"], "yes": [True, None, False]}, index=[7, 8, 9])
    numbers = numeric_column(table, "x")
    expected = {7: 1.5}
    values = numbers.dropna().to_dict()
    assert values == expected
    expected = {7: True, 8: False, 9: False}
    values = boolean_column(table, "yes").to_dict()
    assert values == expected
    expected = {7: "1.5", 8: "", 9: "word"}
    values = text_column(table, "x").to_dict()
    assert values == expected
    absent = numeric_column(table, "absent")
    expected = [True] * 3
    values = absent.isna().tolist()
    assert values == expected
    expected = {7: False, 8: False, 9: False}
    values = boolean_column(table, "absent").to_dict()
    assert values == expected
    expected = {7: "", 8: "", 9: ""}
    values = text_column(table, "absent").to_dict()
    assert values == expected


def test_a_pattern_never_hides_a_declared_column() -> None:
    pattern = find_declaration("stage_loop_seconds")
    assert pattern is not None
    assert pattern.name == "stage_*_seconds"
    order = find_declaration("order")
    assert order is not None
    assert order.name == "order"


# What repeats and what is missing.


def model_row(run: str, seed: int, fit: float | None) -> dict[str, object]:
    """One run with the same fit on each record."""
    row: dict[str, object] = {"run": run, "seed": seed}
    for record in ("train", "validation", "test"):
        row[f"fit_{record}_percent"] = fit
    return row


def doubts_of(tmp_path: Path, *rows: dict[str, object]) -> list[str]:
    """Sentences about the table of these runs."""
    table = table_from_records(rows)
    return row_count_warnings(tmp_path, table)


def test_seeds_of_one_model_count_once(tmp_path: Path) -> None:
    sentence = "Runs of different seeds have the same model, so they count once: a-1, b-2."
    first = model_row("a-1", 0, 90.0)
    second = model_row("b-2", 1, 90.0)
    actual = doubts_of(tmp_path, first, second)
    assert actual == [sentence]
    actual = doubts_of(tmp_path, first, second | {"seed": 0})
    assert actual == []
    actual = doubts_of(tmp_path, first, model_row("b-2", 1, 91.0))
    assert actual == []
    actual = doubts_of(tmp_path, model_row("a-1", 0, None), model_row("b-2", 1, None))
    assert actual == []
    other_test = second | {"fit_test_percent": 80.0}
    actual = doubts_of(tmp_path, first, other_test)
    assert actual == []


def test_one_run_under_two_names_is_not_two_models(tmp_path: Path) -> None:
    names = [f"copy{k}-1a2b" for k in range(6)]
    rows = [model_row(name, k, 90.0) for k, name in enumerate(names)]
    sentence = "The same settings stand under several names, so they are one run: "
    four = ", ".join(names[:4])
    expected = [f"{sentence}{four} and 2 more."]
    actual = doubts_of(tmp_path, *rows)
    assert actual == expected


def test_a_table_without_fits_or_seeds_has_no_repeated_models(tmp_path: Path) -> None:
    rows = [model_row("a-1", 0, 90.0), model_row("b-2", 1, 90.0)]
    table = table_from_records(rows)
    for column in ("seed", "fit_train_percent"):
        actual = row_count_warnings(tmp_path, table.drop(columns=column))
        assert actual == []


def write_sweep(study: Path, *words: str) -> None:
    """Write the file that Hydra writes of a sweep."""
    content = {"hydra": {"overrides": {"task": list(words)}}}
    (study / "multirun.yaml").write_text(json.dumps(content))


def test_a_damaged_record_of_the_sweep_is_not_missing_as_well(tmp_path: Path) -> None:
    write_sweep(tmp_path, "model.order=4,6,8", "unknown.setting=1,2")
    full: list[dict[str, object]] = [{"run": f"r-{order}", "order": order} for order in (4, 6, 8)]
    actual = doubts_of(tmp_path, *full)
    assert actual == []
    damaged: dict[str, object] = {"run": "r-9", "order": None}
    actual = doubts_of(tmp_path, *full[:2], damaged)
    assert actual == []
    (sentence,) = doubts_of(tmp_path, full[0], damaged)
    assert sentence == (
        "1 of 3 runs of the sweep is missing (multirun.yaml lists them: not started, or removed)."
    )


def test_a_sweep_of_too_many_combinations_is_not_compared(tmp_path: Path) -> None:
    orders = ",".join(map(str, range(MOST)))
    write_sweep(tmp_path, f"model.order={orders}")
    count = len(swept_values(tmp_path)["model.order"])
    assert count == MOST
    write_sweep(tmp_path, f"model.order={orders},{MOST}")
    assert swept_values(tmp_path) == {}


TEXTS = {True: "True", "False": "False", "0.10": "0.1", 8.0: "8", 1e-3: "0.001", "lmi": "lmi"}
NAMES = {"model.order": "order", "plant.step_s": "plant__step_s", "seed": "seed"}


def test_values_of_command_and_table_read_alike() -> None:
    texts = {value: comparable_setting_text(value) for value in TEXTS}
    assert texts == TEXTS
    assert comparable_setting_text(pd.NA) == "<NA>"
    assert comparable_setting_text(None) == "None"
    columns = {path: column_of_setting(path) for path in NAMES}
    assert columns == NAMES


@pytest.mark.parametrize(("count", "text"), [(8, "a, b, c, d, e, f, g, h"), (2, "a, b")])
def test_names_within_the_limit_are_all_listed(count: int, text: str) -> None:
    actual = abbreviate_names("abcdefghij"[:count])
    assert actual == text
    assert abbreviate_names("abcdefghij") == "a, b, c, d, e, f, g, h and 2 more"


def test_a_path_is_a_run_if_it_has_a_record_or_names_a_part(tmp_path: Path) -> None:
    for name in ("order4-1a2b", "order8-3c4d"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "record.json").touch()
    run = tmp_path / "order4-1a2b"
    assert find_study_or_run(run) == run
    assert find_study_or_run(tmp_path / "1a2b") == run
    assert find_study_or_run(tmp_path) == tmp_path
    figures = tmp_path / "figures"
    figures.mkdir()
    assert find_study_or_run(figures) == figures


def test_a_part_means_an_end_before_a_beginning_before_digits(tmp_path: Path) -> None:
    names = ("a4-1b", "b7-1a4", "x4-b7", "c-44")
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "record.json").touch()
    named = {part: find_study_or_run(tmp_path / part).name for part in ("a4", "b7", "44", "1a")}
    expected = {"a4": "b7-1a4", "b7": "x4-b7", "44": "c-44", "1a": "b7-1a4"}
    assert named == expected
