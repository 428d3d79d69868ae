"""What the log of `ssm-study excite` predicts: by its three amplitudes, and by the one of its
validation record.

    python -m benchmarks.excited_log --seed 0 1 2 --to results/reference/adversarial/excited.csv

One line per plant, seed and way of reading the log: designs drawn from a wide grid and the choice
of `auto`, judged from the log alone, each then tried on the plant that made it (noise-free). Some
20 s of one core a plant and seed.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from benchmarks.adversarial.__main__ import plant_of
from benchmarks.common import study_of
from ssm_study.bounds.slopes import certified_balls
from ssm_study.data.excitations.user_excitation import IdentificationExperiment
from ssm_study.data.recorded import RecordedData
from ssm_study.loop.design_grid import RandomDesignTable
from ssm_study.loop.peers.peer import IdentificationResult
from ssm_study.plants.plant import Plant
from ssm_study.robustness.return_to_rest import is_return_to_rest
from ssm_study.signals import DataSet

PLANTS = ["dc_motor", "stribeck_drive", "peaking_gain", "thinning_damping", "stiction",
          "hysteresis", "play",
          "rate_limited"]  # fmt: skip
HOLDS = 10  # of the plant's clock, in a settling time


def recorded(plant: Plant, seed: int, folder: Path) -> DataSet:
    """The log of one experiment, read as a stranger's."""
    rest = plant.equilibrium()
    reach = float(plant.input_amplitude[0])
    settle_s = float(np.clip(HOLDS * plant.input_clock_s, 20.5 * plant.step_s, 80 * plant.step_s))
    middle = float(rest.u[0])
    ends = {"lower": float(rest.u[0]) - reach, "upper": float(rest.u[0]) + reach}
    u = IdentificationExperiment(
        **ends, rest=middle, step_s=plant.step_s, settle_s=settle_s, seed=seed
    ).input_signal()
    y = plant.simulate(u[None, :, None])[1][0, :, 0]
    y = y + np.sqrt(plant.noise_variance[0]) * np.random.default_rng([seed, 3]).standard_normal(
        len(y)
    )
    pd.DataFrame({"u": u, "y": y}).to_csv(folder / "log.csv", index=False)
    read = {"path": str(folder / "log.csv"), "input": "u", "output": "y", "step_s": plant.step_s}
    around = {"input_equilibrium": [middle], "output_equilibrium": [float(rest.y[0])]}
    return RecordedData(**read, **around, start_up_samples=20).build(seed)


def lines(name: str, seed: int, order: int, designs: int) -> list[dict]:
    """Both readings of one log, of the same model."""
    plant = plant_of(name)
    parts = study_of(f"model.order={order}", f"seed={seed}")
    with TemporaryDirectory() as folder:
        data = recorded(plant, seed, Path(folder))
        model = parts.reduction.reduce_model(
            parts.training.identify(parts.model, data, seed, Path(folder), False).model
        )
    loop = parts.loop.with_default_horizon(model)
    made = []
    for views, trials in (
        ("three", data.mismatch_records),
        ("one", tuple(filter(is_return_to_rest, data.mismatch_records))),
    ):
        known = IdentificationResult.from_data_set(
            model, certified_balls(model), replace(data, mismatch_records=trials)
        )
        rows = pd.DataFrame(RandomDesignTable(designs=designs).rows(plant, known, loop, seed))
        settles = rows.stable_count_noise_free == rows.initial_conditions
        drawn = rows.index > 0
        said = rows.predicted_stable.astype(bool)
        made.append({
            "plant": name, "seed": seed, "views": views, "designs": int(drawn.sum()),
            "settle": int((settles & drawn).sum()), "predicted": int((said & drawn).sum()),
            "wrong": int((said & drawn & ~settles).sum()), "choice_predicted": bool(said[0]),
            "choice_settles": bool(settles[0]), "choice_margin": rows.resolved_margin[0],
            "choice_settling_s": pd.to_numeric(rows["settling_time_mean_s"])[0],
        })  # fmt: skip
    return made


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plant", nargs="+", default=PLANTS)
    parser.add_argument("--seed", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--order", type=int, default=4)
    parser.add_argument("--designs", type=int, default=30)
    parser.add_argument("--to", type=Path, required=True)
    asked = parser.parse_args()
    found: list[dict] = []
    for name in asked.plant:
        for seed in asked.seed:
            found += lines(name, seed, asked.order, asked.designs)
            print(*found[-2:], sep="\n", flush=True)
            pd.DataFrame(found).to_csv(
                asked.to, index=False, lineterminator="\n", float_format="%.4g"
            )
    print(pd.DataFrame(found).groupby("views").sum(numeric_only=True))


if __name__ == "__main__":
    main()
