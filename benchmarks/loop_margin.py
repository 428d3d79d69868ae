"""Does the mismatch margin predict the true plant? Certified designs of a study's models, one line
per design.

    ssm-study run -m experiment=fit_versus_stability seed=0,1
    python benchmarks/loop_margin.py count results/fit_versus_stability --to results/reference/loop
    python benchmarks/loop_margin.py draw results/reference/loop

Every run of that study leaves 151 certified designs, the choice of `auto` first, each closed on the
plant from every start (`ssm_study.loop.design_grid`). `count` writes ROC and confusion table, what
became of each requested rate, the choices beside the best design in hindsight, the exceptions, and
the designs that `draw` draws, beside the figures of `peers.csv` and `robustness.csv`.
"""

import argparse
from pathlib import Path

import pandas as pd
from loop_margin_figures import NEEDED, roc, settling

from ssm_study import style
from ssm_study.engine.records import read_record
from ssm_study.report.figures import peers, robustness
from ssm_study.report.study_folder import StudyFolder
from ssm_study.report.words import PlantUnits

ABOUT = ["plant", "order", "hidden_width", "slope_lower", "seed"]
"""What tells one model of the study from another."""
EXCEPTION = [
    *(*ABOUT, "design", "rate_controller", "rate_observer", "gain_norm", "observer_gain_norm"),
    *(
        "mismatch_gain",
        "mismatch_margin",
        "resolved_margin",
        "controller_radius",
        "noise_peak",
        "predicted_stable",
    ),
    *("stable_count", "stable_count_noise_free", "left_bound_count", "unsettled_as", "kind"),
]


def designs(folder: Path) -> pd.DataFrame:
    """Every design of every run, with the run's model beside it.

    `share` is the way of the controller's rate from the model's own to the exact limit, -1 at half
    its own; `relative_time` the mean settling time over that of the plant left alone (both -).
    """
    tables = []
    for path in sorted(folder.glob("*/comparison.csv")):
        record = read_record(path.parent)
        table = pd.read_csv(path)
        own = 1 - record["spectral_radius"] ** 2
        way = (table.rate_controller - own) / (record["controller_rate_limit"] - own)
        about = {name: record[name] for name in (*ABOUT, "fit_test_percent")}
        relative = table.settling_time_mean_s / table.settling_time_open_loop_s
        tables.append(
            table.assign(
                **about,
                share=way.where(way > 0, -1).round(2),
                relative_time=relative,
                kind=outcome(table),
            )
        )
    return pd.concat(tables, ignore_index=True)


def stable(table: pd.DataFrame) -> pd.Series:
    """The controller is stable by itself."""
    return table.controller_radius < 1


RULES = {
    "margin": lambda table: table.mismatch_margin > 1,
    "margin_stable": lambda table: (table.mismatch_margin > 1) & stable(table),
    "resolved": lambda table: table.resolved_margin > 1,
    "predicted": lambda table: table.predicted_stable,
    "stable": stable,
}
"""What may be known before the plant is tried; `predicted` is what `auto` asks for."""


def outcome(table: pd.DataFrame) -> pd.Series:
    """`settled`: all cases; `noisy`: all cases but for the noise; `slow`: still decaying; `lost`:
    none of these.

    Lost designs left the bound, oscillate or drift.
    """
    settled = table.stable_count == table.initial_conditions
    noisy = table.stable_count_noise_free == table.initial_conditions
    decaying = table.unsettled_as == "slow"
    kind = pd.Series("lost", index=table.index).mask(decaying, "slow").mask(noisy, "noisy")
    return kind.mask(settled, "settled")


def area_under_roc(score: pd.Series, good: pd.Series) -> float:
    """The chance that a good design scores above a bad one (Mann and Whitney); NaN if one kind is
    missing."""
    ranks = score.rank()
    positives = int(good.sum())
    negatives = len(good) - positives
    if not positives or not negatives:
        return float("nan")
    return float((ranks[good].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def ordered(table: pd.DataFrame) -> pd.Series:
    """The margins' ranks, below them every design that its own radius or the noise refuses."""
    return table.resolved_margin.rank() - len(table) * ~(stable(table) & (table.noise_peak < 1))


def summary(table: pd.DataFrame) -> dict:
    """One group of designs as one row: areas under the ROC curve, and for each rule what it admits
    and leaves out."""
    settled = table.kind == "settled"
    admitted = {name: rule(table) for name, rule in RULES.items()}
    inside = table[admitted["predicted"]].kind.value_counts()
    return {
        "models": table[ABOUT].drop_duplicates().shape[0],
        "designs": len(table),
        "roc_prediction": area_under_roc(ordered(table), settled),
        "roc_margin_in_total": area_under_roc(table.mismatch_margin, settled),
        **{name: int((table.kind == name).sum()) for name in ("settled", "noisy", "slow", "lost")},
        **{f"predicted_{name}": int(inside.get(name, 0)) for name in ("noisy", "slow", "lost")},
        **{f"{name}_settled": int((rule & settled).sum()) for name, rule in admitted.items()},
        **{f"{name}_not": int((rule & ~settled).sum()) for name, rule in admitted.items()},
    }


def hindsight(model: pd.DataFrame) -> dict:
    """What auto chose (design 0) beside the best certified design found on the true plant, in
    uncontrolled times."""
    all_settle = model[model.kind == "settled"]
    chosen = model[model.design == 0].iloc[0]
    best = all_settle.loc[all_settle.relative_time.idxmin()] if len(all_settle) else None
    return {
        "fit_test_percent": chosen.fit_test_percent,
        "auto_margin": chosen.resolved_margin,
        "auto_stable_count": int(chosen.stable_count),
        "auto_relative_time": chosen.relative_time,
        "hindsight_relative_time": None if best is None else best.relative_time,
        "hindsight_margin": None if best is None else best.resolved_margin,
    }


def count(arguments: argparse.Namespace) -> None:
    table = designs(Path(arguments.folder))
    to = Path(arguments.to)
    groups = {("all", "all"): table} | {
        (plant, "all"): own for plant, own in table.groupby("plant")
    }
    groups |= {(plant, order): own for (plant, order), own in table.groupby(["plant", "order"])}
    rows = [
        {"plant": plant, "order": order} | summary(own) for (plant, order), own in groups.items()
    ]
    written = {"margin_summary.csv": pd.DataFrame(rows)}
    grid = table[table.design > 0].groupby(["plant", "share"])
    written["margin_rates.csv"] = grid.agg(
        designs=("kind", "size"), settled=("kind", lambda kind: (kind == "settled").sum())
    )
    models = [
        dict(zip(ABOUT, key, strict=True)) | hindsight(own) for key, own in table.groupby(ABOUT)
    ]
    written["hindsight.csv"] = pd.DataFrame(models)
    either = (table.mismatch_margin > 1) | (table.resolved_margin > 1)
    written["margin_exceptions.csv"] = table.loc[either & (table.kind != "settled"), EXCEPTION]
    written["margin_designs.csv.gz"] = table[[*ABOUT, "design", *NEEDED[1:]]]
    for name, content in written.items():
        packed = {"method": "gzip", "mtime": 0} if name.endswith(".gz") else None
        content.to_csv(
            to / name, index=name == "margin_rates.csv", float_format="%.4g", compression=packed
        )


def _of(comparison: pd.DataFrame) -> StudyFolder:
    """A study of which only this table is known."""
    study = StudyFolder(folder=Path())
    vars(study)["controller_comparison"] = comparison
    vars(study)["units"] = PlantUnits(input="V", output="rad/s")  # of the motor, whose table it is
    return study


def draw(arguments: argparse.Namespace) -> None:
    folder = Path(arguments.folder)
    drawn = pd.read_csv(folder / "margin_designs.csv.gz")
    peers_table, robustness_table = (
        pd.read_csv(folder / f"{name}.csv") for name in ("peers", "robustness")
    )
    with style.paper_style():
        figures = {
            "margin_roc": roc(drawn),
            "margin_settling": settling(drawn),
            "peers": peers.draw(_of(peers_table.assign(situation="nominal"))),
            "robustness": robustness.draw(_of(robustness_table)),
        }
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=200, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("count")
    one.add_argument("folder")
    one.add_argument("--to", required=True)
    one.set_defaults(act=count)
    two = commands.add_parser("draw")
    two.add_argument("folder")
    two.set_defaults(act=draw)
    arguments = parser.parse_args()
    arguments.act(arguments)


if __name__ == "__main__":
    main()
