"""A prediction that its records led astray, and what `refine` makes of it: a table of the
iterations, and the picture.

    python benchmarks/refined_loop.py --to results/reference/adversarial

The plant's gain is eleven at rest and one at full amplitude, and no record is taken at a small
amplitude: the first choice is predicted to settle and swings. `refine` measures the mismatch in
that loop and chooses again.
"""

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from omegaconf import open_dict

from ssm_study import style

HERE = Path(__file__).resolve().parent
PLANT = {"_target_": "benchmarks.adversarial.plants.peaking_gain.PeakingGain"}
PLANT |= {"first_s": 0.1, "second_s": 0.4, "peak": 10.0, "width": 0.01}
HIDDEN = [
    "study=refined",
    "+data.trials=false",
    "model.order=2",
    "loop.initial_conditions=3",
    "progress=false",
]
SHOWN = [
    "refinements",
    "predicted_stable",
    "resolved_margin",
    "mismatch_in_loop",
    "certified_tolerance",
    "coverage",
]
SHOWN += ["stable_count", "initial_conditions", "settling_time_mean_s", "settling_time_open_loop_s"]


def iterations(folder: Path, settings: list[str]) -> list[Path]:
    """The first run and those that `refine` makes of it, in order."""
    from ssm_study.cli.from_python import compose_configuration
    from ssm_study.study.line import STUDY
    from ssm_study.study.refine import refine_controller

    config = compose_configuration([*HIDDEN, f"results_dir={folder}", *settings])
    with open_dict(config):
        config.plant = PLANT
    runs = [STUDY.run_job(config).folder]
    for step in refine_controller(runs[0]):
        print(step.said)
        runs += [runs[0].parent / step.config.run] if step.config is not None else []
    return runs


def picture(runs: list[Path], table: pd.DataFrame) -> Figure:
    """The noise-free output of each iteration's loop from its own starts."""
    from ssm_study.study.loop_recordings import read_loop_recordings

    fig = style.new_figure(style.COLUMN_IN, 1.6 * len(runs))
    panels = fig.subplots(len(runs), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, run, (_, row) in zip(panels, runs, table.iterrows(), strict=True):
        loop = read_loop_recordings(run)[0].controlled
        time_s = loop.step_s * np.arange(loop.y.shape[1])
        axes.plot(time_s, loop.y[:, :, 0].T, lw=0.8)
        settled = f"{row.stable_count:.0f} of {row.initial_conditions:.0f} starts settle"
        proved = f"coverage {row.coverage:.2g}"
        axes.set_title(f"Choice {row.refinements + 1:.0f}: {settled}, {proved}", loc="left")
        axes.set_ylabel("Output (–)")
    panels[-1].set_xlabel("Time (s)")
    return fig


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("settings", nargs="*", help="of the study, as for ssm-study run")
    asked = parser.parse_args()
    from ssm_study.engine.records import read_record
    from ssm_study.study import allow_list

    sys.path.append(str(HERE.parent))
    allow_list.trusted_packages = lambda: {"benchmarks": HERE}  # its plants may be chosen

    with TemporaryDirectory() as folder:
        runs = iterations(Path(folder), asked.settings)
        table = (
            pd.DataFrame([read_record(run) for run in runs])
            .reindex(columns=SHOWN)
            .fillna({"refinements": 0})
        )
        print(table.to_string(index=False))
        asked.to.mkdir(parents=True, exist_ok=True)
        table.to_csv(
            asked.to / "refined.csv", index=False, lineterminator="\n", float_format="%.4g"
        )
        with style.paper_style():
            figure = picture(runs, table)
            figure.savefig(asked.to / "refined.png", dpi=200, metadata={"Software": None})


if __name__ == "__main__":
    main()
