"""Spreadsheets and MAT files of version 7.3: read where a package is installed, else a sentence."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from good_log import source

from ssm_study.refusal import BadRequest


def test_a_sheet_is_read_as_a_text_with_its_names_units_and_dates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Table of an engine: a sheet of objects with a line of names and one of units."""
    times = pd.date_range("2026-01-01", periods=200, freq="1min")
    u = np.repeat([0.0, 1.0, -1.0, 0.5], 50)
    heads = ["time", "u", "y"]
    units = ["", "V", "rpm"]
    rows = [heads, units]
    running_sum = np.cumsum(u)
    rows += [list(row) for row in zip(times, u, running_sum, strict=True)]
    sheet = pd.DataFrame(rows, dtype=object)
    monkeypatch.setattr(pd, "read_excel", lambda *_, **__: sheet)
    path = tmp_path / "log.xlsx"
    path.write_bytes(b"PK")
    recorded_data = source(path)
    pieces, remark = recorded_data.read_pieces(path)
    assert pieces[0].step_s == 60.0
    pieces_y = pieces[0].y
    actual = pieces_y[:, 0]
    expected = running_sum
    np.testing.assert_array_equal(actual, expected)
    assert "clock time (dates)" in remark


NO_ENGINE = ImportError("openpyxl")
NO_SPREADSHEET = ValueError("bad zip")
FAILURES = [
    (NO_ENGINE, r"no reader of spreadsheets; save the sheet as CSV, or pip"),
    (NO_SPREADSHEET, r"not a complete spreadsheet \(bad zip\)"),
]


@pytest.mark.parametrize(("raised", "says"), FAILURES)
def test_a_sheet_without_an_engine_or_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raised: Exception, says: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise raised

    monkeypatch.setattr(pd, "read_excel", refuse)
    path = tmp_path / "log.xlsx"
    path.write_bytes(b"PK")
    recorded_data = source(path, step_s=1.0)
    with pytest.raises(BadRequest, match=says):
        recorded_data.read_pieces(path)


def test_a_mat_file_of_version_7_3_that_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file" + bytes(200))
    recorded_data = source(path, step_s=1.0)
    with pytest.raises(BadRequest, match=r"not a complete MAT file|save it with -v7"):
        recorded_data.read_pieces(path)
