"""One log written in many ways (`benchmarks/log_variants.py`), a small draw: read right or refused
in a sentence, never wrong in silence."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings

from ssm_study.data import clock_column

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_variants import Variant, outcome, variants

MILLISECONDS = Variant(
    separator=";",
    decimal=",",
    names="words",
    clock="ms in brackets",
    holes=1,
    missing=3,
    encoding="cp1252",
    comments=2,
    units_row=False,
    line_end="\r\n",
    step_s=0.01,
    trailing=True,
    quoted=False,
    counter=False,
    seed=1,
)


SUPPRESSED = [HealthCheck.function_scoped_fixture, HealthCheck.filter_too_much]


@settings(max_examples=40, deadline=None, suppress_health_check=SUPPRESSED)
@given(variant=variants)
def test_every_spelling_is_read(tmp_path: Path, variant: Variant) -> None:
    end, message = outcome(variant, tmp_path)
    assert end == "read", message


SEPARATORS = [",", " "]


@pytest.mark.parametrize("separator", SEPARATORS)
def test_quotes_tell_a_comma_between_numbers_from_one_within(
    tmp_path: Path, separator: str
) -> None:
    changes = {"separator": separator, "names": "plain", "clock": "ms", "quoted": True}
    plain = {"holes": 1, "missing": 0, "encoding": "utf-8"}
    variant = replace(MILLISECONDS, **changes, **plain)  # type: ignore[arg-type]
    expected = ("read", "")
    assert outcome(variant, tmp_path) == expected


def test_a_clock_in_the_wrong_unit_is_counted_as_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check itself is checked: milliseconds taken for seconds are noticed."""
    result = outcome(MILLISECONDS, tmp_path)
    end = result[0]
    assert end == "read"
    monkeypatch.setattr(clock_column, "stated_time_unit_s", lambda *_: 1.0)
    expected = ("wrong", "step 10")
    actual = outcome(MILLISECONDS, tmp_path)
    assert actual == expected


def test_numbers_that_are_names_and_places_of_different_columns(tmp_path: Path) -> None:
    from ssm_study.data.recorded import RecordedData
    from ssm_study.refusal import BadRequest

    rows = "\n".join(f"{0.1 * k:.1f},{(k * 7) % 13}.5,{(k * 5) % 11}.5" for k in range(60))
    path = tmp_path / "log.csv"
    path.write_text(f"1,2,3\n{rows}\n")
    fields: dict[str, object] = {"path": str(path), "input": 1, "output": 2, "step_s": 0.1}
    recorded_data = RecordedData(**fields)
    with pytest.raises(BadRequest, match=r"is both the name of column 0 .*data\.header=true"):
        recorded_data.read_pieces(path)
    names_of_columns = {"input": 2, "output": 3, "header": True}
    named_fields = fields | names_of_columns
    recorded_data = RecordedData(**named_fields)
    named = recorded_data.read_pieces(path)
    first_named = named[0][0]
    named_u = first_named.u
    assert named_u[1, 0] == 7.5
    recorded_data = RecordedData(**fields, header=False)
    counted = recorded_data.read_pieces(path)
    first_counted = counted[0][0]
    counted_u = first_counted.u
    expected = [2.0, 0.5]
    first_inputs = counted_u[:2, 0]
    values = first_inputs.tolist()
    assert values == expected
