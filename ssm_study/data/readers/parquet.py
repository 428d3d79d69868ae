"""Reader of Parquet files. Number columns have their names, and a field's metadata may state its
unit under the key `unit`."""

from dataclasses import replace
from pathlib import Path

import pyarrow as pa
from pyarrow import parquet

from ssm_study.data.readers.reader import (
    Reader,
    Table,
    arrow_columns_to_arrays,
    require_known_columns,
)
from ssm_study.refusal import BadRequest, require

MOST_BYTES = 1 << 28  # of the named columns, unpacked


class ParquetReader(Reader, names=(".parquet",)):
    """Reader of Parquet files. Page checksums are verified where the file has them; a file that is
    not whole is refused."""

    def read_columns(self, path: Path, names: list[str]) -> Table:
        where = f"{path.name} (column)"
        try:
            schema = parquet.read_schema(path)
            require_known_columns(where, names, schema.names)
            for kind, name in ((schema.field(name).type, name) for name in names):
                numeric = is_numeric_type(kind)
                problem = f"holds {kind}, not numbers"
                remedy = "store the column as numbers"
                require(numeric, where, name, problem, remedy)
            rows = parquet.read_metadata(path).num_rows
            most = MOST_BYTES // 8 // len(names)
            problem = f"{rows} rows are more than {most}"
            remedy = "split the record"
            require(rows <= most, "data.path", path, problem, remedy)
            table = parquet.read_table(path, columns=names, page_checksum_verification=True)
            columns = arrow_columns_to_arrays(path, table, {name: name for name in names}, "row", 0)
        except BadRequest:
            raise
        except (pa.ArrowException, OSError, ValueError) as error:
            problem = f"not a complete Parquet file ({error})"
            remedy = "write it again"
            raise BadRequest("data.path", path, problem, remedy) from error
        units = {
            name: (schema.field(name).metadata or {}).get(b"unit", b"").decode(errors="replace")
            for name in names
        }
        kinds = {name: schema.field(name).type for name in names}
        dated = {name for name, kind in kinds.items() if pa.types.is_timestamp(kind)}
        return Table(columns=columns, units=units, row_word="row", dated=frozenset(dated))

    def read_all_columns(self, path: Path) -> Table:
        """Read every column of numbers or times in a Parquet file, and list the other columns as
        skipped."""
        try:
            schema = parquet.read_schema(path)
        except (pa.ArrowException, OSError, ValueError) as error:
            problem = f"not a complete Parquet file ({error})"
            remedy = "write it again"
            raise BadRequest("data.path", path, problem, remedy) from error
        numeric = [name for name in schema.names if is_numeric_type(schema.field(name).type)]
        skipped = {
            name: f"holds {schema.field(name).type}" for name in schema.names if name not in numeric
        }
        table = self.read_columns(path, numeric) if numeric else Table(columns={})
        return replace(table, skipped=skipped)


def is_numeric_type(kind: pa.DataType) -> bool:
    """Whether the type of a Parquet column is a number or a time."""
    tests = (pa.types.is_floating, pa.types.is_integer, pa.types.is_timestamp)
    return any(test(kind) for test in tests)
