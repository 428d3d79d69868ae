"""A log with decimal commas in some lines and points in others is refused with both lines."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ssm_study.data.look import look
from ssm_study.data.mixed_decimals import describe_mixed_decimals
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest

ROWS = 200


def write_log(path: Path, has_comma: Callable[[int], bool]) -> None:
    rng = np.random.default_rng(0)
    lines = ["time;volt;speed"]
    for k, (u, y) in enumerate(rng.uniform(-3, 3, (ROWS, 2))):
        line = f"{0.1 * k:.1f};{u:.5f};{y:.5f}"
        lines.append(line.replace(".", ",") if has_comma(k) else line)
    path.write_text("\n".join(lines), encoding="utf-8")


@pytest.mark.parametrize("later", [False, True])
def test_the_sentence_names_the_two_lines_and_the_remedy(tmp_path: Path, later: bool) -> None:
    """It ended in "has no rows of numbers", of a file that has 200."""
    path = tmp_path / "log.csv"
    write_log(path, lambda k: (k >= ROWS // 2) == later)
    first, second = ("point", "comma") if later else ("comma", "point")
    words = rf"line 2 has a decimal {first} \(0.0\) and line 102 a decimal {second} \(10.0\); write"
    with pytest.raises(BadRequest, match=words):
        look(path)
    with pytest.raises(BadRequest, match=words):
        RecordedData(path=str(path), input="volt", output="speed").build(0)


def test_one_line_of_another_mark_is_named(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    write_log(path, lambda k: k == ROWS // 2)
    with pytest.raises(BadRequest, match=r"time: no number in line 102: 10,0\); correct the file"):
        look(path)


def test_a_comma_between_cells_is_no_decimal_mark() -> None:
    actual = describe_mixed_decimals([(1, "0.1,2.5"), (2, "0.2,3.5")])
    assert actual == ""
    assert describe_mixed_decimals([(1, "0,1;2,5"), (2, "0,2;3,5")]) == ""
    assert describe_mixed_decimals([]) == ""
