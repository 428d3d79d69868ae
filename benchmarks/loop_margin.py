"""Does the mismatch margin predict the true plant? Certified designs of many models, one line per model.

    python benchmarks/loop_margin.py run --plant dc_motor --order 4 8 12 --seed 0 1 2 --to margin_dc_motor.csv
    python benchmarks/loop_margin.py pool margin_*.csv --to results/reference/loop
    python benchmarks/loop_margin.py draw results/reference/loop
    python benchmarks/loop_margin.py study results/fit_versus_stability --to results/reference/loop

`run` identifies one model per (plant, order, seed), draws 150 certified designs and closes each on the plant ten times
(`ssm_study.loop.design_grid`); models already in the file are skipped. `pool` writes ROC and confusion table,
hindsight, exceptions and the designs that `draw` draws, beside the figures of `peers.csv` and `robustness.csv`.
`ssm-study run -m experiment=fit_versus_stability` makes such designs with everything else a run records; `study` counts
what the runs predicted of them, and what became of these.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import hydra
import pandas as pd
from hydra import compose, initialize_config_dir
from loop_margin_figures import NEEDED, roc, settling

from ssm_study.bounds.slopes import certified_balls
from ssm_study.engine.records import read_record
from ssm_study.loop.design_grid import DesignGrid
from ssm_study.loop.peers.peer import Identified
from ssm_study.models.metrics import free_run
from ssm_study.report import style
from ssm_study.report.figures import peers, robustness
from ssm_study.report.study_folder import StudyFolder
from ssm_study.signals import fit_percent

CONF = Path(__file__).resolve().parents[1] / "conf"
MODEL = ["plant", "order", "seed"]
EXCEPTION = [
    *(*MODEL, "design", "rate_controller", "rate_observer", "gain_norm", "observer_gain_norm"),
    *("mismatch_gain", "mismatch_margin", "resolved_margin", "controller_radius"),
    *("stable_count", "stable_count_noise_free"),
    *("left_bound_count", "unsettled_as", "kind"),
]
GROUPS = ("plant", "excitation", "data", "model", "training", "reduction", "loop")


def parts(plant: str, *overrides: str) -> dict:
    """The objects of one configuration, without a run folder."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("study", [f"plant={plant}", "study=margin", *overrides])
    return {name: hydra.utils.instantiate(config[name], _convert_="all") for name in GROUPS}


def designs(plant: str, order: int, seed: int) -> pd.DataFrame:
    """One model's table, with what was identified beside every row."""
    started, part = time.perf_counter(), parts(plant, f"model.order={order}")
    data = part["data"].build(part["plant"], part["excitation"], seed)
    with TemporaryDirectory() as folder:
        found = part["training"].identify(part["model"], data, seed, Path(folder), False)
    model = part["reduction"].reduce(found.model)
    test, validation = data.test[0], data.validation
    known = Identified(model=model, balls=certified_balls(model), validation=validation)
    rows = pd.DataFrame(DesignGrid().rows(part["plant"], known, part["loop"], seed))
    fit = fit_percent(test.y, free_run(model, test, data.start_up_samples), data.start_up_samples)
    about = {"plant": plant, "order": order, "seed": seed, "fit_test_percent": fit, "order_kept": model.order}
    about |= {"slope_lower": known.balls.input.lower, "slope_upper": known.balls.input.upper}
    about |= {"seconds": time.perf_counter() - started}
    return rows.assign(**about)


def stable(table: pd.DataFrame) -> pd.Series:
    """The controller is stable by itself."""
    return table.controller_radius < 1


RULES = {
    "margin": lambda table: table.mismatch_margin > 1,
    "margin_stable": lambda table: (table.mismatch_margin > 1) & stable(table),
    "resolved": lambda table: table.resolved_margin > 1,
    "resolved_stable": lambda table: (table.resolved_margin > 1) & stable(table),
    "stable": stable,
}
"""What may be known before the plant is tried; `resolved_stable` is what `auto` asks for."""


def outcome(table: pd.DataFrame) -> pd.Series:
    """`settled`: all cases; `noisy`: all cases but for the noise; `slow`: still decaying; `lost`: none of these.

    Lost designs left the bound, oscillate or drift.
    """
    settled = table.stable_count == table.initial_conditions
    noisy = table.stable_count_noise_free == table.initial_conditions
    decaying = table.unsettled_as == "slow"
    kind = pd.Series("lost", index=table.index).mask(decaying, "slow").mask(noisy, "noisy")
    return kind.mask(settled, "settled")


def area_under_roc(score: pd.Series, good: pd.Series) -> float:
    """The chance that a good design scores above a bad one (Mann and Whitney); NaN if one kind is missing."""
    ranks, positives = score.rank(), int(good.sum())
    negatives = len(good) - positives
    if not positives or not negatives:
        return float("nan")
    return float((ranks[good].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def ordered(table: pd.DataFrame) -> pd.Series:
    """The margins' ranks, every unstable controller below the rest."""
    return table.resolved_margin.rank() - len(table) * ~stable(table)


def summary(table: pd.DataFrame) -> dict:
    """One group of designs as one row: areas under the ROC curve, and for each rule what it admits and leaves out."""
    kind = outcome(table)
    settled = kind == "settled"
    admitted = {name: rule(table) for name, rule in RULES.items()}
    return {
        "models": table[["plant", "order", "seed"]].drop_duplicates().shape[0],
        "designs": len(table),
        "roc_settled": area_under_roc(table.mismatch_margin, settled),
        "roc_not_lost": area_under_roc(table.mismatch_margin, kind != "lost"),
        "roc_resolved_settled": area_under_roc(table.resolved_margin, settled),
        "roc_resolved_stable_settled": area_under_roc(ordered(table), settled),
        **{f"{kind_}": int((kind == kind_).sum()) for kind_ in ("settled", "noisy", "slow", "lost")},
        **{f"{name}_settled": int((inside & settled).sum()) for name, inside in admitted.items()},
        **{f"{name}_not": int((inside & ~settled).sum()) for name, inside in admitted.items()},
    }


def hindsight(model: pd.DataFrame) -> dict:
    """What auto chose (design 0) beside the best certified design found on the true plant, in uncontrolled times."""
    all_settle = model[model.stable_count == model.initial_conditions]
    chosen = model[model.design == 0].iloc[0]
    best = all_settle.settling_time_mean_s.min() / chosen.settling_time_open_loop_s
    own = chosen.settling_time_mean_s / chosen.settling_time_open_loop_s
    return {
        "fit_test_percent": chosen.fit_test_percent,
        "auto_margin": chosen.resolved_margin,
        "auto_stable_count": int(chosen.stable_count),
        "auto_relative_time": own,
        "hindsight_relative_time": best,
        "hindsight_margin": all_settle.loc[all_settle.settling_time_mean_s.idxmin(), "resolved_margin"]
        if len(all_settle)
        else None,
    }


def run(arguments: argparse.Namespace) -> None:
    target = Path(arguments.to)
    for order in arguments.order:
        for seed in arguments.seed:
            done = pd.read_csv(target) if target.exists() else pd.DataFrame(columns=["order", "seed"])
            if ((done.order == order) & (done.seed == seed)).any():
                continue
            table = designs(arguments.plant, order, seed)
            table.to_csv(target, mode="a", header=not target.exists(), index=False)
            print(arguments.plant, order, seed, f"{table.seconds.iloc[0]:.1f} s", hindsight(table), flush=True)


def pool(arguments: argparse.Namespace) -> None:
    table = pd.concat([pd.read_csv(name) for name in arguments.files], ignore_index=True)
    table, to = table.assign(kind=outcome(table)), Path(arguments.to)
    groups = {("all", "all"): table} | {(plant, "all"): own for plant, own in table.groupby("plant")}
    groups |= {(plant, order): own for (plant, order), own in table.groupby(["plant", "order"])}
    rows = [{"plant": plant, "order": order} | summary(own) for (plant, order), own in groups.items()]
    written = {"margin_summary.csv": pd.DataFrame(rows)}
    models = [dict(zip(MODEL, key, strict=True)) | hindsight(own) for key, own in table.groupby(MODEL)]
    written["hindsight.csv"] = pd.DataFrame(models)
    either = (table.mismatch_margin > 1) | (table.resolved_margin > 1)
    written["margin_exceptions.csv"] = table.loc[either & (table.kind != "settled"), EXCEPTION]
    relative = table.settling_time_mean_s / table.settling_time_open_loop_s
    written["margin_designs.csv.gz"] = table.assign(relative_time=relative)[[*MODEL, "design", *NEEDED[1:]]]
    for name, content in written.items():
        packed = {"method": "gzip", "mtime": 0} if name.endswith(".gz") else None
        content.to_csv(to / name, index=False, float_format="%.4g", compression=packed)


def study(arguments: argparse.Namespace) -> None:
    """One row for all plants and one for each: designs of the runs' comparisons by what was predicted and happened."""
    tables = []
    for path in sorted(Path(arguments.folder).glob("*/comparison.csv")):
        tables.append(pd.read_csv(path).assign(plant=read_record(path.parent)["plant"], run=path.parent.name))
    table = pd.concat(tables, ignore_index=True)
    rows = []
    for plant, own in [("all", table), *table.groupby("plant")]:
        counts = pd.crosstab(own.predicted_stable.map({True: "predicted", False: "other"}), outcome(own))
        told = {f"{said}_{kind}": int(counts[kind][said]) for said in counts.index for kind in counts}
        area = area_under_roc(ordered(own), outcome(own) == "settled")
        rows.append({"plant": plant, "models": own.run.nunique(), "designs": len(own), "roc": area, **told})
    pd.DataFrame(rows).fillna(0).to_csv(Path(arguments.to) / "margin_study.csv", index=False, float_format="%.4g")


def _of(comparison: pd.DataFrame) -> StudyFolder:
    """A study of which only this table is known."""
    study = StudyFolder(folder=Path())
    vars(study)["comparison"] = comparison
    return study


def draw(arguments: argparse.Namespace) -> None:
    folder = Path(arguments.folder)
    designs = pd.read_csv(folder / "margin_designs.csv.gz")
    peers_table, robustness_table = (pd.read_csv(folder / f"{name}.csv") for name in ("peers", "robustness"))
    with style.paper():
        figures = {
            "margin_roc": roc(designs),
            "margin_settling": settling(designs),
            "peers": peers.draw(_of(peers_table.assign(situation="nominal"))),
            "robustness": robustness.draw(_of(robustness_table)),
        }
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=200, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("run")
    one.add_argument("--plant", required=True)
    one.add_argument("--order", type=int, nargs="+", default=[4, 8, 12])
    one.add_argument("--seed", type=int, nargs="+", default=list(range(10)))
    one.add_argument("--to", required=True)
    one.set_defaults(act=run)
    two = commands.add_parser("pool")
    two.add_argument("files", nargs="+")
    two.add_argument("--to", required=True)
    two.set_defaults(act=pool)
    three = commands.add_parser("draw")
    three.add_argument("folder")
    three.set_defaults(act=draw)
    four = commands.add_parser("study")
    four.add_argument("folder")
    four.add_argument("--to", required=True)
    four.set_defaults(act=study)
    arguments = parser.parse_args()
    arguments.act(arguments)


if __name__ == "__main__":
    main()
