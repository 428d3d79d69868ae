"""Is the prediction right on plants that it was not made on? One line per plant, order and seed.

    python -m benchmarks.adversarial --plant play peaking_gain --order 4 8 --seed 0 1 2 3 4 --to
    adversarial.csv

Each line is what `ssm-study run plant=... comparison@loop.comparison=design_grid` computes: designs
drawn from a wide grid and the choice of `auto`, each on the plant. `old` is the rule that went
before: one record at full amplitude, its noise left in, an average where the input has no power,
and the fastest design that passes. `evidence` is what a run would say of data and model; where it
is "cannot judge", a run predicts nothing. With `--table` the lines of the file are summed by plant
and nothing is computed.
"""

import argparse
import importlib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import yaml

from benchmarks.common import study_of
from ssm_study.bounds.slopes import certified_balls
from ssm_study.evidence.metrics import collect_findings
from ssm_study.loop.design_grid import RandomDesignTable
from ssm_study.loop.peers.peer import IdentificationResult
from ssm_study.models.metrics import Simulation
from ssm_study.plants.plant import Plant
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.robustness.prediction import predict_margins
from ssm_study.robustness.record_errors import ModelErrorAtAmplitude
from ssm_study.signals import DataSet

HERE = Path(__file__).resolve().parent


def plant_of(name: str) -> Plant:
    """Of this folder, or of the project's own."""
    own = HERE / "conf" / f"{name}.yaml"
    if not own.is_file():
        return study_of(f"plant={name}").plant
    values = yaml.safe_load(own.read_text())
    module, kind = values.pop("_target_").rsplit(".", 1)
    return getattr(importlib.import_module(module), kind)(**values)


def before(known: IdentificationResult) -> Mismatch:
    """What the rule that went before knew: the validation record alone, its average where the input
    has no power."""
    shown = replace(known, mismatch_records=()).mismatch
    view: ModelErrorAtAmplitude = shown.views[0]
    unknown = np.isin(
        np.round(np.linspace(0, np.pi, len(view.rest)), 9), np.round(shown.unexcited, 9)
    )
    sizes = np.where(unknown, view.gain, view.by_frequency)
    return Mismatch(views=(replace(view, by_frequency=sizes, linear=0 * view.linear, rest=sizes),))


@lru_cache(maxsize=1)
def recorded(name: str, seed: int) -> tuple[Plant, DataSet]:
    """A plant and its records: the same for every order of the model."""
    plant = plant_of(name)
    parts = study_of(f"seed={seed}")
    return plant, parts.data.build(plant, parts.excitation, seed)


def line(name: str, order: int, seed: int, designs: int) -> dict:
    """Designs and choices of one model, by both rules."""
    (plant, data), parts = recorded(name, seed), study_of(f"model.order={order}", f"seed={seed}")
    with TemporaryDirectory() as folder:
        found = parts.training.identify(parts.model, data, seed, Path(folder), False)
    model = parts.reduction.reduce_model(found.model)
    known = IdentificationResult.from_data_set(model, certified_balls(model), data)
    grid = RandomDesignTable(designs=designs)
    loop = parts.loop.with_default_horizon(model)
    rows = pd.DataFrame(grid.rows(plant, known, loop, seed))
    about = {
        "plant": name,
        "shown_by": getattr(plant, "shown_by", "the project's own"),
        "order": order,
        "seed": seed,
    }
    if rows.empty:
        return about
    validation, test = (
        Simulation.simulate_records(model, part, data.start_up_samples)
        for part in (data.validation, data.test)
    )
    about["evidence"] = collect_findings(data, model, validation, test, known.mismatch).level
    settles = rows.stable_count_noise_free == rows.initial_conditions
    drawn = rows.index > 0
    candidates = grid.auto.compute_candidates(model, known.balls)
    pairs = grid.draw_gain_pairs(candidates, seed)
    record = before(known)
    old = [
        predict_margins(model, candidates.gains(pair), known.balls, record).predicts_stability()
        for pair in pairs
    ]
    old_predicted = np.array([False, *old])
    controlled, alone = (
        pd.to_numeric(rows[f"settling_time_{name}_s"])[0] for name in ("mean", "open_loop")
    )
    return about | {
        "designs": int(drawn.sum()), "settle": int((settles & drawn).sum()),
        "old_predicted": int(old_predicted.sum()),
        "old_wrong": int((old_predicted & ~settles).sum()),
        "predicted": int((rows.predicted_stable & drawn).sum()),
        "wrong": int((rows.predicted_stable & drawn & ~settles).sum()),
        "both_right": int((old_predicted & rows.predicted_stable & settles).sum()),
        "choice_predicted": bool(rows.predicted_stable[0]), "choice_settles": bool(settles[0]),
        "choice_margin": rows.resolved_margin[0], "choice_time_ratio": controlled / alone,
        "rests": known.mismatch.plant_comes_to_rest,
    }  # fmt: skip


def by_plant(lines: pd.DataFrame) -> str:
    """The table of docs/trust.md: what both rules predict, and how many of these designs do not
    settle.

    `time` is the median settling time of the predicted choices, relative to the plant left alone.
    """
    lines = lines.assign(
        settled=lines.choice_predicted & lines.choice_settles,
        silent=lines.evidence == "cannot judge", models=1,
        **{f"sound_{name}": lines[name].where(lines.evidence == "sound",
                                              0) for name in ("predicted", "wrong")},
    )  # fmt: skip
    counts = [
        "models",
        "designs",
        "settle",
        "old_predicted",
        "old_wrong",
        "predicted",
        "wrong",
        "both_right",
    ]
    groups = lines.groupby(["plant", "shown_by"])
    table = groups[
        [*counts, "choice_predicted", "settled", "silent", "sound_predicted", "sound_wrong"]
    ].sum()
    table["time"] = (
        lines[lines.choice_predicted].groupby(["plant", "shown_by"])["choice_time_ratio"].median()
    )
    table.loc[("all", ""), :] = table.sum(min_count=1)
    heads = [
        "plant",
        "fault shown by",
        "models",
        "designs",
        "settle",
        "old rule: predicted / wrong",
    ]
    heads += [
        "this rule: predicted / wrong",
        "without a doubt",
        "right by both",
        "choices predicted / settle",
        "cannot judge",
        "time",
    ]
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for (plant, shown_by), row in table.iterrows():
        pairs = [f"{row[a]:.0f} / {row[b]:.0f}" for a, b in
                 (("old_predicted", "old_wrong"), ("predicted", "wrong"), ("sound_predicted",
                                                                           "sound_wrong"),
                  ("choice_predicted", "settled"))]  # fmt: skip
        cells = [
            plant,
            shown_by,
            *(f"{row[name]:.0f}" for name in counts[:3]),
            *pairs[:3],
            f"{row.both_right:.0f}",
        ]
        time = f"{row.time:.2f}" if plant != "all" and row.choice_predicted else ""
        rows.append("| " + " | ".join([*cells, pairs[3], f"{row.silent:.0f}", time]) + " |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [path.stem for path in sorted((HERE / "conf").glob("*.yaml"))]
    parser.add_argument("--plant", nargs="+", default=names)
    parser.add_argument("--order", nargs="+", type=int, default=[4, 8])
    parser.add_argument("--seed", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--designs", type=int, default=60)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("--table", action="store_true")
    asked = parser.parse_args()
    if asked.table:
        print(by_plant(pd.read_csv(asked.to)))
        return
    lines = pd.read_csv(asked.to).to_dict("records") if asked.to.is_file() else []
    done = {(one["plant"], one["order"], one["seed"]) for one in lines}
    for seed in asked.seed:
        for name in asked.plant:
            for order in asked.order:
                if (name, order, seed) not in done:
                    lines.append(line(name, order, seed, asked.designs))
                    print(
                        {key: value for key, value in lines[-1].items() if key != "shown_by"},
                        flush=True,
                    )
                    pd.DataFrame(lines).to_csv(
                        asked.to, index=False, lineterminator="\n", float_format="%.4g"
                    )


if __name__ == "__main__":
    main()
