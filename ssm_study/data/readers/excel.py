"""Reader of spreadsheets, by pandas if a spreadsheet engine for pandas is installed. The first
sheet is read as text."""

from dataclasses import replace
from pathlib import Path

import pandas as pd

from ssm_study.data.readers.reader import Reader, Table
from ssm_study.data.readers.text import TextReader
from ssm_study.refusal import BadRequest


class ExcelReader(Reader, names=(".xlsx", ".xls", ".ods", ".xlsm")):
    """Reader of spreadsheet files, which reads the first sheet. Names, units, dates and missing
    values are found as in a text with tabs."""

    def read_columns(self, path: Path, names: list[str]) -> Table:
        return self._sheet_as_text_reader(path).read_columns(path, names)

    def read_all_columns(self, path: Path) -> Table:
        return self._sheet_as_text_reader(path).read_all_columns(path)

    def _sheet_as_text_reader(self, path: Path) -> TextReader:
        """Convert the first sheet of a spreadsheet to CSV text, and return a reader of that
        text."""
        try:
            sheet = pd.read_excel(path, sheet_name=0, header=None, dtype=object)
        except ImportError as error:
            remedy = "save the sheet as CSV, or pip install openpyxl"
            raise BadRequest("data.path", path, "no reader of spreadsheets", remedy) from error
        except Exception as error:  # whatever the engines raise on damaged files (2026-11)
            problem = f"not a complete spreadsheet ({error})"
            raise BadRequest("data.path", path, problem, "save the sheet as CSV") from error
        text = sheet.to_csv(sep="\t", index=False, header=False)
        return TextReader.from_text(path, text, replace(self.settings, separator="tabs"))
