"""Cache of data sets from logs, so that a process reads each log only once.

A run asks for its log when it is checked, and again when its first stage is computed; to verify it
in the same process asks once more. A long log takes seconds to read, so the last data sets are
remembered, by the settings that read them and the content of their files.
"""

from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING

from ssm_study.durable import sha256_of_file

if TYPE_CHECKING:
    from ssm_study.data.recorded import RecordedSource
    from ssm_study.signals import DataSet

MOST = 4  # data sets that are remembered: the folds of a sweep may read one log in several ways
Key = tuple[object, ...]

_DATA_SETS: "OrderedDict[Key, DataSet]" = OrderedDict()


def read_data_set(source: "RecordedSource", seed: int) -> "DataSet":
    """Read the data set from recorded logs; read them again only if a file has changed."""
    key = (repr(source), seed, *_file_checksums(source.data_files()))
    if key not in _DATA_SETS:
        _DATA_SETS[key] = source.build(seed)
    _DATA_SETS.move_to_end(key)
    while len(_DATA_SETS) > MOST:
        _DATA_SETS.popitem(last=False)
    return _DATA_SETS[key]


def _file_checksums(paths: tuple[Path, ...]) -> list[tuple[str, str]]:
    """Absolute path and checksum of each of several files."""
    return [(str(path.absolute()), sha256_of_file(path)) for path in paths]
