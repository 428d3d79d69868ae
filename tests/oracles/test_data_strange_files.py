"""Files as loggers, spreadsheets and people leave them, each in one unusual way: read with the
right step and numbers, or refused in a sentence that says what to change."""

import gzip
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from ssm_study.data.look import look
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.metrics import judge_reading
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory

ROWS = 300
RNG = np.random.default_rng(3)
U = np.repeat(RNG.uniform(-1, 1, 20).round(3), 15)
Y = (20 + 3 * scipy.signal.lfilter([0, 0.1], [1, -0.9], U)).round(4)
BEGIN = datetime(2026, 3, 5, 10)
Row = Callable[[int], list[str]]


def number(value: float) -> str:
    return f"{value:.4f}"


def comma(value: float) -> str:
    return number(value).replace(".", ",")


def table(row: Row, separator: str = ",", names: str = "time,u,y") -> str:
    """A line of names, and a row of cells for each sample."""
    lines = [names.replace(",", separator), *(separator.join(row(k)) for k in range(ROWS))]
    return "\n".join(lines) + "\n"


def with_clock(clock: Callable[[int], str], name: str = "time") -> str:
    """A plain file but for its clock."""
    return table(lambda k: [clock(k), number(U[k]), number(Y[k])], names=f"{name},u,y")


def dated(form: str, step_s: float = 1.0) -> str:
    """A plain file whose clock is a date of this form."""
    return with_clock(lambda k: (BEGIN + timedelta(seconds=step_s * k)).strftime(form))


def summer_time(hours: float) -> str:
    """A file in local time, whose clock is put back at three o'clock on 25 October."""
    change = datetime(2026, 10, 25, 3)

    def local(k: int) -> str:
        time = datetime(2026, 10, 22) + timedelta(hours=hours * k)
        return str(time - timedelta(hours=1) if time >= change else time)

    return with_clock(local)


PLAIN = with_clock(lambda k: f"{0.1 * k:.1f}")
LINES = PLAIN.splitlines()
READ = {
    "days of a spreadsheet": (with_clock(lambda k: f"{46086.4 + k / 1440:.10f}", "date"), 60.0),
    "days, by another name": (with_clock(lambda k: f"{46086.4 + k / 86400:.10f}"), 1.0),
    "days of MATLAB": (with_clock(lambda k: f"{738586.4 + k / 1440:.9f}", "datenum"), 60.0),
    "digits of a date": (dated("%Y%m%d%H%M%S"), 1.0),
    "digits to the minute": (dated("%Y%m%d%H%M", 60.0), 60.0),
    "digits of days": (dated("%Y%m%d", 86400.0), 86400.0),
    "since 1970, any name": (with_clock(lambda k: f"{1772700000000 + 100 * k}", "stempel"), 0.1),
    "seconds since 1970": (with_clock(lambda k: f"{1772700000 + k}", "ts"), 1.0),
    "name of a month": (dated("%d-%b-%Y %H:%M:%S"), 1.0),
    "name of a month, tabs": (dated("%d-%b-%Y %H:%M:%S").replace(",", "\t"), 1.0),
    "month, day, year, tabs": (dated("%b %d %Y %H:%M:%S").replace(",", "\t"), 1.0),
    "month, day, year": (dated('"%b %d, %Y %H:%M:%S"'), 1.0),
    "dates without dashes": (dated("%Y%m%dT%H%M%S"), 1.0),
    "zone of two digits": (dated("%Y-%m-%d %H:%M:%S+01"), 1.0),
    "twelve hours": (dated("%I:%M:%S %p", 30.0), 30.0),
    "a.m. and p.m.": (
        dated("%d/%m/%Y %I:%M %p", 60.0).replace("AM", "a.m.").replace("PM", "p.m."),
        60.0,
    ),
    "stop watch": (with_clock(lambda k: f"{k // 600:02d}:{(k / 10) % 60:04.1f}"), 0.1),
    "summer time ends, hours": (summer_time(1.0), 3600.0),
    "summer time ends, quarters": (summer_time(0.25), 900.0),
    "counter of 16 bits": (with_clock(lambda k: f"{(60000 + 100 * k) % 65536}", "time_ms"), 0.1),
    "counter of 32 bits": (with_clock(lambda k: f"{(4e9 + 2e6 * k) % 2**32:.0f}", "micros"), 2.0),
    "grouped digits": (
        table(lambda k: [f"{0.1 * k:.1f}", number(U[k]), f"{1000 * Y[k]:,.1f}"], "\t"),
        0.1,
    ),
    "apostrophes": (
        table(lambda k: [f"{0.1 * k:.1f}", number(U[k]), f"{1000 * Y[k]:,.1f}".replace(",", "'")]),
        0.1,
    ),
    "percent": (table(lambda k: [f"{0.1 * k:.1f}", f"{100 * U[k]:.2f}%", number(Y[k])]), 0.1),
    "typographic minus": (PLAIN.replace("-", "\u2212"), 0.1),
    "exponents of Fortran": (
        table(lambda k: [f"{v:.6E}".replace("E", "D") for v in (0.1 * k, U[k], Y[k])]),
        0.1,
    ),
    "two lines of names": ("clock,drive,sensor\n" + PLAIN, 0.1),
    "groups above the names": ("System,,Process\n" + PLAIN, 0.1),
    "names, units, types": (PLAIN.replace("\n", "\ns,V,degC\nint,double,double\n", 1), 0.1),
    "names again": ("\n".join([*LINES[:150], LINES[0], *LINES[150:]]), 0.1),
    "two bytes a letter": (PLAIN.encode("utf-16-le"), 0.1),
    "unwritten end": (PLAIN.encode() + b"\0" * 5000, 0.1),
    "end mark of DOS": (PLAIN.encode() + b"\x1a", 0.1),
}
DATE_AND_TIME = table(
    lambda k: [*(BEGIN + timedelta(minutes=5 * k)).strftime("%d.%m.%Y %H:%M").split(), comma(U[k]),
               comma(Y[k])],
    ";",
    "Date,Time,u,y",
)  # fmt: skip
LABVIEW = """LabVIEW Measurement\t
Separator\tTab
Date\t2026/03/05
***End_of_Header***\t
\t\t\t
Channels\t2\t\t\t
Samples\t300\t300\t\t
Delta_X\t0.1\t0.1\t\t
***End_of_Header***\t\t\t\t
X_Value\tu\ty\tComment
"""
READ["LabVIEW"] = (
    LABVIEW
    + table(lambda k: [number(0.1 * k), number(U[k]), number(Y[k])], "\t").split("\n", 1)[1],
    0.1,
)
READ["milliseconds after a colon"] = (
    with_clock(lambda k: f"10:{k // 600:02d}:{(k // 10) % 60:02d}:{k % 10 * 100:03d}"),
    0.1,
)
READ["groups by spaces"] = (
    table(lambda k: [comma(0.1 * k), comma(U[k]), f"{Y[k]:.3f}".replace(".", " ") + ",0"], ";"),
    0.1,
)
READ["date beside time"] = (DATE_AND_TIME, 300.0)


def write_log(folder: Path, content: str | bytes) -> Path:
    path = folder / "log.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def read_log(path: Path, input: str = "u", output: str = "y") -> tuple[Trajectory, str]:
    """The only piece of a log, and what the reader remarks on it."""
    source = RecordedData(path=str(path), input=input, output=output)
    (piece,), remark = source.read_pieces(path)
    return piece, remark


def assert_same_but_for_scale(values: np.ndarray, truth: np.ndarray) -> None:
    """Some of the files hold multiples of the signal, or rounded numbers."""
    straight_line = np.polyfit(truth, values, 1)
    fitted = np.polyval(straight_line, truth)
    np.testing.assert_allclose(values, fitted, atol=1)
    assert np.corrcoef(values, truth)[0, 1] > 0.9999


@pytest.mark.parametrize("kind", READ)
def test_the_right_step_and_numbers(tmp_path: Path, kind: str) -> None:
    content, step_s = READ[kind]
    path = write_log(tmp_path, content)
    piece, _ = read_log(path)
    overview = look(path, input="u", output="y")

    assert piece.step_s == pytest.approx(step_s, rel=1e-3)
    assert overview.records[0].step_s == piece.step_s
    assert len(piece) == ROWS
    assert_same_but_for_scale(piece.u[:, 0], U)
    assert_same_but_for_scale(piece.y[:, 0], Y)


def test_a_switch_is_one_or_zero(tmp_path: Path) -> None:
    text = table(lambda k: [f"{0.1 * k:.1f}", "ON" if U[k] > 0 else "off", number(Y[k])])
    piece, _ = read_log(write_log(tmp_path, text))
    is_on = (U > 0).astype(float)
    np.testing.assert_array_equal(piece.u[:, 0], is_on)


THOUSANDS_OR_DECIMALS = table(
    lambda k: [comma(0.1 * k), comma(U[k]), f"{1000 * Y[k]:,.0f}".replace(",", ".")], ";"
)
AMBIGUOUS = {
    "packed": (gzip.compress(PLAIN.encode()), r"is packed \(gzip\); unpack it first"),
    "footer": (PLAIN + f"Mean,0,{Y.mean():.3f}\n", "column time: no number in line 302: Mean"),
    "thousands or decimals": (
        THOUSANDS_OR_DECIMALS,
        "may stand between thousands, or before decimals",
    ),
    "row twice": (
        "\n".join([*LINES[:100], *LINES[99:]]),
        "row 99 of the file repeats the one before",
    ),
}


@pytest.mark.parametrize(("content", "says"), AMBIGUOUS.values(), ids=AMBIGUOUS)
def test_what_is_ambiguous_is_refused(tmp_path: Path, content: str | bytes, says: str) -> None:
    path = write_log(tmp_path, content)
    with pytest.raises(BadRequest, match=says):
        read_log(path)


LAST_OUTPUT = LINES[200].rsplit(",")[-1]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (READ["days, by another name"][0], "taken for days, as a spreadsheet counts them, though"),
        (PLAIN.replace(LAST_OUTPUT, "-9999"), "y is -9999 in 1 row: a number that"),
        (PLAIN, ""),
        (READ["days of a spreadsheet"][0], ""),
    ],
)
def test_what_was_guessed_is_doubted(tmp_path: Path, content: str, says: str) -> None:
    _, remark = read_log(write_log(tmp_path, content))
    sentences = [finding.sentence for finding in judge_reading(remark)]
    assert len(sentences) == bool(says)
    assert says in " ".join(sentences)


def test_a_fast_clock_in_the_range_of_days_stays_in_seconds(tmp_path: Path) -> None:
    """Twelve hours after a machine was switched on its clock may read 46086 s."""
    twelve_hours = with_clock(lambda k: f"{46086.4 + 0.01 * k:.3f}")
    piece, remark = read_log(write_log(tmp_path, twelve_hours))

    assert piece.step_s == pytest.approx(0.01)
    assert "(no unit: seconds)" in remark


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("cp1251", "Время (с),Ток,Момент"),
        ("cp866", "время,вход,выход"),
        ("gb18030", "时间(s),电压,转速"),
        ("gb18030", "时间,频率,阈值"),
        ("cp1252", "Zeit,Öltemp,Température"),
    ],
)
def test_names_in_a_code_page_are_spelled(tmp_path: Path, page: str, names: str) -> None:
    _, u, y = names.split(",")
    log = PLAIN.replace("time,u,y", names).encode(page)
    path = write_log(tmp_path, log)
    source = RecordedData(path=str(path), input=u, output=y)
    (piece,), remark = source.read_pieces(path)

    assert f"encoding {page}" in remark
    assert len(piece) == ROWS
    assert piece.step_s == pytest.approx(0.1)
    stored = [channel.name for channel in (*source.inputs, *source.outputs)]
    assert stored[0] != stored[1]
    assert all(map(str.isidentifier, stored))
    assert all(map(str.isascii, stored))


def test_an_ambiguous_code_page_is_read_by_number(tmp_path: Path) -> None:
    """Korean syllables are Chinese characters in another page: the names stay unread."""
    korean = PLAIN.replace("time,u,y", "시간,전압,속도")
    path = write_log(tmp_path, korean.encode("euc_kr"))
    with pytest.raises(BadRequest, match="the header has"):
        read_log(path, input="전압", output="속도")

    by_number = RecordedData(path=str(path), input="1", output="2", time="0")
    (piece,), remark = by_number.read_pieces(path)
    assert len(piece) == ROWS
    assert "encoding cp1252" in remark


@pytest.mark.parametrize(
    ("below", "lines"),
    [
        ("End of the log\n", 1),
        ("\n-----\nLogger stopped: 300 samples, ok\nTotal: 300\n", 3),
        ("Logged by A, B, C\n", 1),
    ],
)
def test_prose_below_the_rows_is_no_row(tmp_path: Path, below: str, lines: int) -> None:
    piece, remark = read_log(write_log(tmp_path, PLAIN + below))
    noun = "line" if lines == 1 else "lines"

    assert len(piece) == ROWS
    assert f"{lines} {noun} of prose below" in remark


def test_values_that_are_never_together_are_counted(tmp_path: Path) -> None:
    """A logger that writes the input only where it changes."""
    rows = table(lambda k: [number(0.1 * k), "" if k % 10 else number(U[k]), number(Y[k])])
    path = write_log(tmp_path, rows)
    with pytest.raises(BadRequest, match=r"missing: u 90%, y 0%; fill in what is held"):
        read_log(path)


@pytest.mark.parametrize("below", ["30.0,0.3\n", "Sum,0.3,20.1\n"])
def test_numbers_below_the_rows_are_refused(tmp_path: Path, below: str) -> None:
    """A row cut short, or one of sums, may be a damaged sample."""
    path = write_log(tmp_path, PLAIN + below)
    with pytest.raises(BadRequest, match=r"does not fit|no number in line 302"):
        read_log(path)
