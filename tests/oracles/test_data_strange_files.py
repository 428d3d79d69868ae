"""Files as loggers, spreadsheets and people leave them, each in one unusual way: read with the
right step and numbers, or refused in a sentence that says what to change."""

import gzip
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from recorded import assert_as_recorded

from ssm_study.data.look import look
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.metrics import judge_log_reading
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory

ROWS = 300
RNG = np.random.default_rng(3)
LEVELS = RNG.uniform(-1, 1, 20)
U = np.repeat(LEVELS.round(3), 15)
NUMERATOR = [0, 0.1]
DENOMINATOR = [1, -0.9]
FIRST_ORDER_LAG = scipy.signal.lfilter(NUMERATOR, DENOMINATOR, U)
Y = (20 + 3 * FIRST_ORDER_LAG).round(4)
BEGIN = datetime(2026, 3, 5, 10)
Row = Callable[[int], list[str]]


def number(value: float) -> str:
    return f"{value:.4f}"


def comma(value: float) -> str:
    return number(value).replace(".", ",")


def table(row: Row, separator: str = ",", names: str = "time,u,y") -> str:
    """A line of names, and a row of cells for each sample."""
    header = names.replace(",", separator)
    rows = [separator.join(row(k)) for k in range(ROWS)]
    return "\n".join([header, *rows]) + "\n"


def with_clock(clock: Callable[[int], str], name: str = "time") -> str:
    """A plain file but for its clock."""

    def row(k: int) -> list[str]:
        return [clock(k), number(U[k]), number(Y[k])]

    return table(row, names=f"{name},u,y")


def dated(form: str, step_s: float = 1.0) -> str:
    """A plain file whose clock is a date of this form."""

    def clock(k: int) -> str:
        passed = timedelta(seconds=step_s * k)
        return (BEGIN + passed).strftime(form)

    return with_clock(clock)


def summer_time(hours: float) -> str:
    """A file in local time, whose clock is put back at three o'clock on 25 October."""
    change = datetime(2026, 10, 25, 3)
    begin = datetime(2026, 10, 22)

    def local(k: int) -> str:
        time = begin + timedelta(hours=hours * k)
        if time >= change:
            time -= timedelta(hours=1)
        return str(time)

    return with_clock(local)


PLAIN = with_clock(lambda k: f"{0.1 * k:.1f}")
LINES = PLAIN.splitlines()
LINES_WITH_NAMES_AGAIN = [*LINES[:150], LINES[0], *LINES[150:]]
SPREADSHEET_MINUTES = with_clock(lambda k: f"{46086.4 + k / 1440:.10f}", "date")
SPREADSHEET_SECONDS = with_clock(lambda k: f"{46086.4 + k / 86400:.10f}")
MATLAB_MINUTES = with_clock(lambda k: f"{738586.4 + k / 1440:.9f}", "datenum")
MILLISECONDS_SINCE_1970 = with_clock(lambda k: f"{1772700000000 + 100 * k}", "stempel")
SECONDS_SINCE_1970 = with_clock(lambda k: f"{1772700000 + k}", "ts")
DAY_MONTH_YEAR = dated("%d-%b-%Y %H:%M:%S")
MONTH_DAY_YEAR = dated("%b %d %Y %H:%M:%S")
TWELVE_HOURS = dated("%d/%m/%Y %I:%M %p", 60.0)
A_M = TWELVE_HOURS.replace("AM", "a.m.")
STOP_WATCH = with_clock(lambda k: f"{k // 600:02d}:{(k / 10) % 60:04.1f}")
MILLISECONDS_AFTER_A_COLON = with_clock(
    lambda k: f"10:{k // 600:02d}:{(k // 10) % 60:02d}:{k % 10 * 100:03d}"
)
COUNTER_16_BITS = with_clock(lambda k: f"{(60000 + 100 * k) % 65536}", "time_ms")
COUNTER_32_BITS = with_clock(lambda k: f"{(4e9 + 2e6 * k) % 2**32:.0f}", "micros")
# Content and sampling time of files whose clock is unusual.
UNUSUAL_CLOCKS: dict[str, tuple[str, float]] = {}
UNUSUAL_CLOCKS["days of a spreadsheet"] = (SPREADSHEET_MINUTES, 60.0)
UNUSUAL_CLOCKS["days, by another name"] = (SPREADSHEET_SECONDS, 1.0)
UNUSUAL_CLOCKS["days of MATLAB"] = (MATLAB_MINUTES, 60.0)
UNUSUAL_CLOCKS["since 1970, any name"] = (MILLISECONDS_SINCE_1970, 0.1)
UNUSUAL_CLOCKS["seconds since 1970"] = (SECONDS_SINCE_1970, 1.0)
UNUSUAL_CLOCKS["stop watch"] = (STOP_WATCH, 0.1)
UNUSUAL_CLOCKS["milliseconds after a colon"] = (MILLISECONDS_AFTER_A_COLON, 0.1)
UNUSUAL_CLOCKS["counter of 16 bits"] = (COUNTER_16_BITS, 0.1)
UNUSUAL_CLOCKS["counter of 32 bits"] = (COUNTER_32_BITS, 2.0)
UNUSUAL_DATES: dict[str, tuple[str, float]] = {}
UNUSUAL_DATES["digits of a date"] = (dated("%Y%m%d%H%M%S"), 1.0)
UNUSUAL_DATES["digits to the minute"] = (dated("%Y%m%d%H%M", 60.0), 60.0)
UNUSUAL_DATES["digits of days"] = (dated("%Y%m%d", 86400.0), 86400.0)
UNUSUAL_DATES["name of a month"] = (DAY_MONTH_YEAR, 1.0)
UNUSUAL_DATES["name of a month, tabs"] = (DAY_MONTH_YEAR.replace(",", "\t"), 1.0)
UNUSUAL_DATES["month, day, year, tabs"] = (MONTH_DAY_YEAR.replace(",", "\t"), 1.0)
UNUSUAL_DATES["month, day, year"] = (dated('"%b %d, %Y %H:%M:%S"'), 1.0)
UNUSUAL_DATES["dates without dashes"] = (dated("%Y%m%dT%H%M%S"), 1.0)
UNUSUAL_DATES["zone of two digits"] = (dated("%Y-%m-%d %H:%M:%S+01"), 1.0)
UNUSUAL_DATES["twelve hours"] = (dated("%I:%M:%S %p", 30.0), 30.0)
UNUSUAL_DATES["a.m. and p.m."] = (A_M.replace("PM", "p.m."), 60.0)
UNUSUAL_DATES["summer time ends, hours"] = (summer_time(1.0), 3600.0)
UNUSUAL_DATES["summer time ends, quarters"] = (summer_time(0.25), 900.0)


def tenths(k: int) -> str:
    """The time of the plain file."""
    return f"{0.1 * k:.1f}"


def row_with_date_and_time(k: int) -> list[str]:
    time = BEGIN + timedelta(minutes=5 * k)
    date_and_time = time.strftime("%d.%m.%Y %H:%M")
    return [*date_and_time.split(), comma(U[k]), comma(Y[k])]


def row_with_grouped_digits(k: int) -> list[str]:
    return [tenths(k), number(U[k]), f"{1000 * Y[k]:,.1f}"]


def row_with_apostrophes(k: int) -> list[str]:
    time, u, y = row_with_grouped_digits(k)
    return [time, u, y.replace(",", "'")]


def row_with_percent(k: int) -> list[str]:
    return [tenths(k), f"{100 * U[k]:.2f}%", number(Y[k])]


def row_of_fortran(k: int) -> list[str]:
    cells = [f"{value:.6E}" for value in (0.1 * k, U[k], Y[k])]
    return [cell.replace("E", "D") for cell in cells]


def row_with_groups_by_spaces(k: int) -> list[str]:
    grouped = f"{Y[k]:.3f}".replace(".", " ")
    return [comma(0.1 * k), comma(U[k]), grouped + ",0"]


def row_of_labview(k: int) -> list[str]:
    return [number(0.1 * k), number(U[k]), number(Y[k])]


DATE_AND_TIME = table(row_with_date_and_time, ";", "Date,Time,u,y")
LABVIEW_HEADER = """LabVIEW Measurement\t
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
_, LABVIEW_ROWS = table(row_of_labview, "\t").split("\n", 1)
# Content of files with the plain clock, a sample every 0.1 s.
UNUSUAL_NUMBERS: dict[str, str | bytes] = {}
UNUSUAL_NUMBERS["grouped digits"] = table(row_with_grouped_digits, "\t")
UNUSUAL_NUMBERS["apostrophes"] = table(row_with_apostrophes)
UNUSUAL_NUMBERS["percent"] = table(row_with_percent)
UNUSUAL_NUMBERS["typographic minus"] = PLAIN.replace("-", "\u2212")
UNUSUAL_NUMBERS["exponents of Fortran"] = table(row_of_fortran)
UNUSUAL_NUMBERS["groups by spaces"] = table(row_with_groups_by_spaces, ";")
UNUSUAL_LINES: dict[str, str | bytes] = {}
UNUSUAL_LINES["two lines of names"] = "clock,drive,sensor\n" + PLAIN
UNUSUAL_LINES["groups above the names"] = "System,,Process\n" + PLAIN
UNUSUAL_LINES["names, units, types"] = PLAIN.replace("\n", "\ns,V,degC\nint,double,double\n", 1)
UNUSUAL_LINES["names again"] = "\n".join(LINES_WITH_NAMES_AGAIN)
UNUSUAL_LINES["two bytes a letter"] = PLAIN.encode("utf-16-le")
UNUSUAL_LINES["unwritten end"] = PLAIN.encode() + b"\0" * 5000
UNUSUAL_LINES["end mark of DOS"] = PLAIN.encode() + b"\x1a"
UNUSUAL_LINES["LabVIEW"] = LABVIEW_HEADER + LABVIEW_ROWS
READ: dict[str, tuple[str | bytes, float]] = {**UNUSUAL_CLOCKS, **UNUSUAL_DATES}
READ |= {kind: (content, 0.1) for kind, content in UNUSUAL_NUMBERS.items()}
READ |= {kind: (content, 0.1) for kind, content in UNUSUAL_LINES.items()}
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
    correlation = np.corrcoef(values, truth)[0, 1]
    assert correlation > 0.9999


@pytest.mark.parametrize("kind", READ)
def test_the_right_step_and_numbers(tmp_path: Path, kind: str) -> None:
    content, step_s = READ[kind]
    path = write_log(tmp_path, content)
    piece, _ = read_log(path)
    overview = look(path, input="u", output="y")

    expected_step_s = pytest.approx(step_s, rel=1e-3)
    assert piece.step_s == expected_step_s
    first_record = overview.records[0]
    assert first_record.step_s == piece.step_s
    assert len(piece) == ROWS
    assert_same_but_for_scale(piece.u[:, 0], U)
    assert_same_but_for_scale(piece.y[:, 0], Y)


def test_the_looks_are_the_recorded_ones(tmp_path: Path) -> None:
    overviews = {}
    for kind, (content, _) in READ.items():
        path = write_log(tmp_path, content)
        text = str(look(path, input="u", output="y"))
        overviews[kind] = text.replace(str(tmp_path), "FOLDER").splitlines()[1:]
    assert_as_recorded("strange_files", overviews, 1e-4)


def test_a_switch_is_one_or_zero(tmp_path: Path) -> None:
    def row(k: int) -> list[str]:
        switch = "ON" if U[k] > 0 else "off"
        return [tenths(k), switch, number(Y[k])]

    text = table(row)
    path = write_log(tmp_path, text)
    piece, _ = read_log(path)
    is_on = (U > 0).astype(float)
    np.testing.assert_array_equal(piece.u[:, 0], is_on)


def row_of_thousands_or_decimals(k: int) -> list[str]:
    grouped = f"{1000 * Y[k]:,.0f}"
    return [comma(0.1 * k), comma(U[k]), grouped.replace(",", ".")]


PACKED = gzip.compress(PLAIN.encode())
FOOTER = f"Mean,0,{Y.mean():.3f}\n"
THOUSANDS_OR_DECIMALS = table(row_of_thousands_or_decimals, ";")
ROW_TWICE = "\n".join([*LINES[:100], *LINES[99:]])
AMBIGUOUS: dict[str, tuple[str | bytes, str]] = {}
AMBIGUOUS["packed"] = (PACKED, r"is packed \(gzip\); unpack it first")
AMBIGUOUS["footer"] = (PLAIN + FOOTER, "column time: no number in line 302: Mean")
AMBIGUOUS["thousands or decimals"] = (
    THOUSANDS_OR_DECIMALS,
    "may stand between thousands, or before decimals",
)
AMBIGUOUS["row twice"] = (ROW_TWICE, "row 99 of the file repeats the one before")


@pytest.mark.parametrize(("content", "says"), AMBIGUOUS.values(), ids=AMBIGUOUS)
def test_what_is_ambiguous_is_refused(tmp_path: Path, content: str | bytes, says: str) -> None:
    path = write_log(tmp_path, content)
    with pytest.raises(BadRequest, match=says):
        read_log(path)


LAST_OUTPUT = LINES[200].rsplit(",")[-1]


WITH_MISSING_VALUE = PLAIN.replace(LAST_OUTPUT, "-9999")
DOUBTED = [
    (SPREADSHEET_SECONDS, "taken for days, as a spreadsheet counts them, though"),
    (WITH_MISSING_VALUE, "y is -9999 in 1 row: a number that"),
    (PLAIN, ""),
    (SPREADSHEET_MINUTES, ""),
]


@pytest.mark.parametrize(("content", "says"), DOUBTED)
def test_what_was_guessed_is_doubted(tmp_path: Path, content: str, says: str) -> None:
    path = write_log(tmp_path, content)
    _, remark = read_log(path)
    sentences = [finding.sentence for finding in judge_log_reading(remark)]
    assert len(sentences) == bool(says)
    assert says in " ".join(sentences)


def test_a_fast_clock_in_the_range_of_days_stays_in_seconds(tmp_path: Path) -> None:
    """Twelve hours after a machine was switched on its clock may read 46086 s."""
    twelve_hours = with_clock(lambda k: f"{46086.4 + 0.01 * k:.3f}")
    path = write_log(tmp_path, twelve_hours)
    piece, remark = read_log(path)

    expected_step_s = pytest.approx(0.01)
    assert piece.step_s == expected_step_s
    assert "(no unit: seconds)" in remark


NAMES_IN_CODE_PAGES = [
    ("cp1251", "Время (с),Ток,Момент"),
    ("cp866", "время,вход,выход"),
    ("gb18030", "时间(s),电压,转速"),
    ("gb18030", "时间,频率,阈值"),
    ("cp1252", "Zeit,Öltemp,Température"),
]


@pytest.mark.parametrize(("page", "names"), NAMES_IN_CODE_PAGES)
def test_names_in_a_code_page_are_spelled(tmp_path: Path, page: str, names: str) -> None:
    _, u, y = names.split(",")
    renamed = PLAIN.replace("time,u,y", names)
    log = renamed.encode(page)
    path = write_log(tmp_path, log)
    source = RecordedData(path=str(path), input=u, output=y)
    (piece,), remark = source.read_pieces(path)

    assert f"encoding {page}" in remark
    assert len(piece) == ROWS
    expected_step_s = pytest.approx(0.1)
    assert piece.step_s == expected_step_s
    channels = (*source.inputs, *source.outputs)
    stored = [channel.name for channel in channels]
    assert stored[0] != stored[1]
    assert all(map(str.isidentifier, stored))
    assert all(map(str.isascii, stored))


def test_an_ambiguous_code_page_is_read_by_number(tmp_path: Path) -> None:
    """Korean syllables are Chinese characters in another page: the names stay unread."""
    korean = PLAIN.replace("time,u,y", "시간,전압,속도")
    content = korean.encode("euc_kr")
    path = write_log(tmp_path, content)
    with pytest.raises(BadRequest, match="the header has"):
        read_log(path, input="전압", output="속도")

    by_number = RecordedData(path=str(path), input="1", output="2", time="0")
    (piece,), remark = by_number.read_pieces(path)
    assert len(piece) == ROWS
    assert "encoding cp1252" in remark


PROSE = [
    ("End of the log\n", 1),
    ("\n-----\nLogger stopped: 300 samples, ok\nTotal: 300\n", 3),
    ("Logged by A, B, C\n", 1),
]


@pytest.mark.parametrize(("below", "lines"), PROSE)
def test_prose_below_the_rows_is_no_row(tmp_path: Path, below: str, lines: int) -> None:
    path = write_log(tmp_path, PLAIN + below)
    piece, remark = read_log(path)
    noun = "line" if lines == 1 else "lines"

    assert len(piece) == ROWS
    assert f"{lines} {noun} of prose below" in remark


def test_values_that_are_never_together_are_counted(tmp_path: Path) -> None:
    """A logger that writes the input only where it changes."""

    def row(k: int) -> list[str]:
        u = "" if k % 10 else number(U[k])
        return [number(0.1 * k), u, number(Y[k])]

    rows = table(row)
    path = write_log(tmp_path, rows)
    with pytest.raises(BadRequest, match=r"missing: u 90%, y 0%; fill in what is held"):
        read_log(path)


DAMAGED_ROWS = ["30.0,0.3\n", "Sum,0.3,20.1\n"]


@pytest.mark.parametrize("below", DAMAGED_ROWS)
def test_numbers_below_the_rows_are_refused(tmp_path: Path, below: str) -> None:
    """A row cut short, or one of sums, may be a damaged sample."""
    path = write_log(tmp_path, PLAIN + below)
    with pytest.raises(BadRequest, match=r"another number of cells|no number in line 302"):
        read_log(path)
