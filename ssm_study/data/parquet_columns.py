"""Parquet: number columns by name; a field's metadata may state its unit under the key `unit`."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from ssm_study.data.table import INTERPOLATE, Table
from ssm_study.refusal import BadRequest, require


def read_parquet(path: Path, names: list[str]) -> Table:
    """The named columns; page checksums are verified where the file has them. Refuses a file that is not whole."""
    try:
        schema = parquet.read_schema(path)
        for name in names:
            _check_field(path, schema, name)
        table = parquet.read_table(path, columns=names, page_checksum_verification=True)
        columns = {name: _numbers(path, name, table.column(name)) for name in names}
    except (pa.ArrowException, OSError, ValueError) as error:
        if isinstance(error, BadRequest):
            raise
        reason = f"not a complete Parquet file ({' '.join(str(error).split())})"
        raise BadRequest("data.path", path, reason, "write it again") from error
    stated = {name: (schema.field(name).metadata or {}).get(b"unit", b"") for name in names}
    return Table(columns=columns, units={n: u.decode(errors="replace") for n, u in stated.items() if u}, row_word="row")


def _check_field(path: Path, schema: pa.Schema, name: str) -> None:
    where = f"{path.name} (column)"
    found = schema.names.count(name)
    require(found > 0, where, name, f"the file has {', '.join(schema.names)}", "name one of these")
    require(found == 1, where, name, f"the file has it {found} times", "rename the others")
    kind = schema.field(name).type
    require(
        pa.types.is_floating(kind) or pa.types.is_integer(kind), where, name, f"holds {kind}, not numbers", "convert it"
    )


def _numbers(path: Path, name: str, column: pa.ChunkedArray) -> np.ndarray:
    if column.null_count:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise BadRequest(f"{path.name}, column {name}, row {row}", "null", "no number", INTERPOLATE)
    return np.ascontiguousarray(column.to_numpy(), dtype=np.float64)
