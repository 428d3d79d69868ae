"""Printed names, verdicts and their colours. The words of the report: what print calls a column,
a choice, and what became of a run, with its colour and mark."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from ssm_study import style
from ssm_study.table.columns import column_label, numeric_column
from ssm_study.table.rank import outcome_class

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Columns that the report adds to the table.
DERIVED = {
    "verdict": "Outcome",
    "slope_ratio": "Certified slope ratio of S_u, smallest / largest (–)",
}
CHOICES: dict[str, str] = {
    "pi": "PI", "lqg": "LQG", "lmi": "LMI", "paper_lmi": "paper's LMI",
    "auto_integral": "auto, integral", "own_pi": "own PI",
    "load_periodic": "load sine", "noise_free": "no noise", "noise_4x": "noise × 4",
    "spread": "off-nominal",
    "dc_motor": "DC motor", "dc_motor_limited": "DC motor, limited",
    "stribeck_drive": "Stribeck drive",
    "DCMotor": "DC motor", "StribeckDrive": "Stribeck drive", "CascadedTanks": "cascaded tanks",
    "QuadrupleTank": "quadruple tank",
}  # fmt: skip


ZERO_BESIDE_BOUND = 1e-9  # share of the bound below which a number is printed as zero


def choice_label(choice: object) -> str:
    """Printed name of a controller, test condition or plant, such as `paper's LMI` for
    `paper_lmi`."""
    return CHOICES.get(str(choice), str(choice).replace("_", " "))


def printed_column_name(name: object) -> str:
    """Printed name of a table column, with its unit."""
    return DERIVED.get(str(name)) or column_label(str(name))


@dataclass(frozen=True, kw_only=True)
class PlantUnits:
    """Units of input and output of the plant that a study is about."""

    input: str = ""
    output: str = ""

    def replace_words_by_units(self, text: str) -> str:
        """Replace general words such as `output unit` in a text by the units of the plant."""
        if self.input:
            text = text.replace("unit of the input", self.input)
        if self.output:
            text = text.replace("squared output, s", f"({self.output})² s")
            text = text.replace("output unit", self.output)
        return text


def prediction_text(margin: float | None, radius: float | None, noise: float | None = None) -> str:
    """Text with the numbers that decide a prediction of stability, each next to its bound.

    `stability margin 2.03 > 1, spectral radius of the controller 0.892 < 1`; noise where it counts.
    """
    grounds = []
    if margin is not None:
        sign = ">" if margin > 1 else "≤"
        grounds.append(f"stability margin {format_beside_bound(margin)} {sign} 1")
    if radius is not None:
        sign = "<" if radius < 1 else "≥"
        grounds.append(f"spectral radius of the controller {format_beside_bound(radius)} {sign} 1")
    if noise is not None and noise > 0:
        sign = "<" if noise < 1 else "≥"
        grounds.append(f"the noise reaches {format_beside_bound(noise)} {sign} 1 of the band")
    return ", ".join(grounds)


def format_beside_bound(value: float, bound: float = 1.0) -> str:
    """Text of a number with enough digits to show on which side of a bound the number lies. Numbers
    that are zero beside the bound are printed as such."""
    if abs(value) < ZERO_BESIDE_BOUND * abs(bound):
        return "0"
    for digits in range(3, 17):
        text = f"{value:.{digits}g}"
        rounded = float(text)
        is_below = rounded < bound
        is_above = rounded > bound
        if is_below == (value < bound) and is_above == (value > bound):
            return text
    return repr(float(value))


@dataclass(frozen=True)
class Verdict:
    """Verdict on a run: a word for its outcome, an explaining sentence, a colour and a marker.
    Colours and markers all differ, so that either is enough to tell verdicts apart.

    The mark is `marker` in a figure and `shape` on the page; `style` is for the terminal.
    """

    word: str
    sentence: str
    colour: str
    marker: str
    shape: str
    style: str


SETTLED = Verdict(
    "certified, settles",
    "both certificates hold and every start settles",
    style.BLUE,
    "o",
    "circle",
    "bold green",
)
NO_FASTER = Verdict(
    "certified, no faster than without control",
    "both certificates hold and every start settles, but not sooner than uncontrolled",
    style.GREEN,
    ">",
    "triangle-right",
    "bold yellow",
)
LOST = Verdict(
    "certified, does not settle",
    "both certificates hold for the model, yet some start does not settle",
    style.VERMILLION, "^", "triangle-up", "bold yellow",
)  # fmt: skip
UNTRIED = Verdict(
    "certified, not tried",
    "both certificates hold; the model answers its input at once, so no loop is closed on it "
    "(model.feedthrough=false makes a model that has one)",
    style.SKY, "<", "triangle-left", "bold yellow",
)  # fmt: skip
UNCERTIFIED = Verdict(
    "not certified",
    "a design exists, but a certificate did not pass",
    style.ORANGE,
    "s",
    "square",
    "bold yellow",
)
IDENTIFIED = Verdict(
    "identified", "identified and scored; the command designs no controller for this class",
    style.PURPLE, "v", "triangle-down", "bold cyan",
)  # fmt: skip
INFEASIBLE = Verdict(
    "infeasible",
    "no certificate exists at the requested rate",
    style.GREY,
    "x",
    "cross",
    "bold magenta",
)
FAILED = Verdict("failed", "the run ended with an error", style.INK, "P", "diamond", "bold red")
BY_CLASS = (
    SETTLED,
    NO_FASTER,
    LOST,
    UNCERTIFIED,
    IDENTIFIED,
    INFEASIBLE,
    FAILED,
)  # see `table.rank.outcome_class`
VERDICTS = (SETTLED, NO_FASTER, LOST, UNTRIED, *BY_CLASS[3:])


def verdict_per_run(table: pd.DataFrame) -> pd.Series:
    """Verdict (word, sentence, colour and marker) on every run in a results table, by the outcome
    class of the run.

    A run that is certified but has no simulated closed loop has a word of its own."""
    classes = outcome_class(table)
    verdict_column = classes.map(lambda place: BY_CLASS[place]).astype(object)
    is_untried = numeric_column(table, "stable_fraction").isna()
    return verdict_column.mask((verdict_column == LOST) & is_untried, UNTRIED)


def verdict_words(table: pd.DataFrame) -> pd.Series:
    """Verdict of every run in a results table as one word."""
    words = verdict_per_run(table).map(lambda verdict: verdict.word)
    return words.astype(object).rename("verdict")


def verdict_counts(table: pd.DataFrame) -> str:
    """Text line with the number of runs of each verdict, such as `12 runs: 9 certified, settles; 2
    infeasible; 1 failed`."""
    tally = verdict_words(table).value_counts()
    words = [verdict.word for verdict in VERDICTS if verdict.word in tally]
    parts = [f"{tally[word]} {word}" for word in words]
    plural = "" if len(table) == 1 else "s"
    runs = f"{len(table)} run{plural}"
    return f"{runs}: {'; '.join(parts)}" if parts else runs


def draw_verdict_points(
    axes: "Axes", table: pd.DataFrame, x: pd.Series, y: pd.Series, dodge: float = 0.0
) -> None:
    """Draw one point for each run in the colour and marker of its verdict. The legend has only
    verdicts that occur.

    `dodge` moves each verdict sideways by that much, so that runs at one setting do not hide each
    other.
    """
    word = verdict_words(table)
    is_known = x.notna() & y.notna()
    for k, verdict in enumerate(VERDICTS):
        here = (word == verdict.word) & is_known
        if not here.any():
            continue
        look: dict[str, Any] = {"s": 18, "c": verdict.colour, "zorder": 3}
        look["marker"] = verdict.marker
        is_cross = verdict.marker == "x"  # all edge
        look["edgecolors"] = verdict.colour if is_cross else "white"
        look["linewidths"] = 0.9 if is_cross else 0.3
        across = x[here] + k * dodge
        axes.scatter(across, y[here], label=verdict.word, **look)
