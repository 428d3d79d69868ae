"""Logs whose input and output stand in two files, and pairs that do not go together."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from good_log import GOOD, assert_equal_signals, csv, data, write_mcap_log

from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest


def timed_values(name: str) -> pd.DataFrame:
    """One signal of the good log in a table of its own."""
    columns = {"t": GOOD["t"], "value": GOOD[name]}
    return pd.DataFrame(columns)


U = timed_values("u")
Y = timed_values("y")
VALUES = {"input": "value", "output": "value"}


def apart(folder: Path, outputs: pd.DataFrame = Y, **changes: object) -> RecordedData:
    """Input and output of the good log in two files."""
    input_path = folder / "in.csv"
    output_path = folder / "out.csv"
    U.to_csv(input_path, index=False)
    outputs.to_csv(output_path, index=False)
    fields = VALUES | {"output_path": str(output_path)}
    fields |= changes
    return data(input_path, **fields)


def test_input_and_output_in_two_files(tmp_path: Path) -> None:
    """Equal names tell the sides apart; every file counts as one that the data set rests on."""
    source = apart(tmp_path, time="t", step_s=None)
    built = source.build(0)
    in_one_file = data(csv(tmp_path), time="t", step_s=None).build(0)

    assert_equal_signals(built.validation[0], in_one_file.validation[0])
    assert built.inputs[0].name == "input_value"
    assert built.outputs[0].name == "output_value"
    names = [path.name for path in source.data_files()]
    assert names == ["in.csv", "out.csv"]


def test_two_files_with_names_of_their_own(tmp_path: Path) -> None:
    """Listed together, the files are one log with the columns of both."""
    paths = apart(tmp_path).data_files()
    files = [str(path) for path in paths]
    speeds = Y.rename(columns={"value": "speed"})
    speeds.to_csv(paths[1], index=False)

    both = data(paths[0], path=files, input="value", output="speed").build(0)
    in_one_file = data(csv(tmp_path), time="t", step_s=None).build(0)

    assert len(both.training) == 1
    assert both.inputs[0].name == "value"
    assert both.outputs[0].name == "speed"
    test_output = both.test[0].y
    expected = in_one_file.test[0].y
    np.testing.assert_array_equal(test_output, expected)


def test_a_test_record_in_two_files(tmp_path: Path) -> None:
    source = apart(tmp_path)
    paths = {"test_path": source.path, "test_output_path": source.output_path}
    built = apart(tmp_path, **paths).build(0)
    test_output = built.test[0].y[:, 0]
    np.testing.assert_array_equal(test_output, GOOD["y"])


LATER_TIMES = Y.t + 0.2
LATE = Y.assign(t=LATER_TIMES)
FILES = ["a.csv", "b.csv"]
DIFFERENT_ROWS = [
    (Y[:-1], {}, r"data.output_path = .*out.csv: has 199 rows, in.csv 200; cut them to the"),
    (LATE, {"time": "t"}, r"its rows are up to 0.2 s away from those of the inputs; log both"),
]
TWO_OUTPUTS = r"data.output_path = \['a.csv', 'b.csv'\]: 2 files of outputs, 1 expected"
NO_TEST_OUTPUT = r"data.test_output_path = \[\]: 0 files of outputs, 1 expected"
DIFFERENT_FILES = [
    (Y, {"output_path": FILES}, TWO_OUTPUTS),
    (Y, {"test_path": "test.csv"}, NO_TEST_OUTPUT),
    (Y, {"output_path": None}, r"data.output = \['value'\]: is an input too"),
]
MISMATCHED_FILES = pytest.mark.parametrize(
    ("outputs", "changes", "words"), [*DIFFERENT_ROWS, *DIFFERENT_FILES]
)


@MISMATCHED_FILES
def test_two_files_that_do_not_go_together(
    tmp_path: Path, outputs: pd.DataFrame, changes: dict[str, object], words: str
) -> None:
    with pytest.raises(BadRequest, match=words):
        apart(tmp_path, outputs, **changes).build(0)


def test_two_recordings_have_no_common_clock(tmp_path: Path) -> None:
    inputs = tmp_path / "in.mcap"
    outputs = tmp_path / "out.mcap"
    write_mcap_log(inputs, value=GOOD["u"])
    write_mcap_log(outputs, value=GOOD["y"])

    output_path = str(outputs)
    source = data(inputs, output_path=output_path, **VALUES)
    words = r"log times count from each recording's own start; put both signals into one"
    with pytest.raises(BadRequest, match=words):
        source.build(0)
