"""Loops of `auto` with neurons and with one layer, on the simulated plants over data seeds.

    python -m benchmarks.structured_loops [--plants ...] [--set model.starts=12 ...] >
    results/reference/loop/FILE

Per row: plant, model, seed; noise-free fit of the test record; whether both sides are certified,
their rates and what the controller's may be at most; what is predicted, nothing where the records
allow no judgement; how many of ten starts settle on the plant, their mean time, that of the plant
alone, and the time over one layer's of the same seed; processor seconds of the choice. Each as
configured, `ssm-study run model=... plant=...`, with neurons also by the settings given: nothing is
chosen by the loop. The files: structured_loops.csv as configured; _many.csv by `--plants dc_motor
--set model.starts=24 model.ridge=1e-7 model.among_starts.rate_enough=0.14`.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.common import study_of
from ssm_study.bounds.slopes import certified_balls
from ssm_study.evidence.finding import CANNOT_JUDGE
from ssm_study.evidence.metrics import collect_findings
from ssm_study.loop.metrics import behaviour_columns
from ssm_study.models.metrics import Simulation
from ssm_study.robustness.mismatch import measure_model_error
from ssm_study.robustness.prediction import predict_margins
from ssm_study.training.metrics import records_fit_percent

PLANTS = ("dc_motor", "stribeck_drive", "cascaded_tanks")
MODELS = ("ssm", "structured")
COLUMNS = "plant,model,seed,fit_test_percent,certified,"
COLUMNS += "rate_controller,rate_limit,rate_observer,margin,predicted,"
COLUMNS += "settled_of_10,settle_s,alone_s,ratio_to_one_layer,synthesis_s"


def row(plant: str, kind: str, seed: int, settings: list[str]) -> dict[str, Any]:
    """One line: identified, designed and closed as `ssm-study run` does it."""
    parts: Any = study_of(f"plant={plant}", f"model={kind}", f"seed={seed}", *settings)
    data = parts.data.build(parts.plant, parts.excitation, seed)
    with TemporaryDirectory() as folder:
        made = parts.reduction.reduce_model(
            parts.training.identify(parts.model, data, seed, Path(folder), False).model
        )
    shown = measure_model_error(made, data.validation, data.start_up_samples, data.mismatch_records)
    balls = certified_balls(made)
    validation = Simulation.simulate_records(made, data.validation, data.start_up_samples)
    test = Simulation.simulate_records(made, data.test, data.start_up_samples)
    silent = collect_findings(data, made, validation, test, shown).level == CANNOT_JUDGE
    started = time.process_time()
    design = (parts.synthesis.with_largest_margin() if silent else parts.synthesis).design(
        made, balls, data.validation, shown
    )
    spent = time.process_time() - started
    feedback = design.state_feedback
    about = {
        "plant": plant,
        "model": kind,
        "seed": seed,
        "fit_test_percent": f"{records_fit_percent(made, data.test, data):.2f}",
    }
    about |= {"certified": design.certified, "synthesis_s": f"{spent:.1f}"}
    about |= {"rate_controller": f"{feedback.rate:.3g}", "rate_limit": f"{feedback.rate_limit:.3g}"}
    about |= {"rate_observer": f"{design.observer.rate:.3g}"}
    if not design.feasible:
        return about
    predicted = predict_margins(made, design.gain_pair, balls, shown)
    about |= {
        "margin": f"{predicted.resolved_margin:.2f}",
        "predicted": "" if silent else predicted.predicts_stability(),
    }
    facts = behaviour_columns(
        parts.loop.with_default_horizon(made).run_design(parts.plant, made, design, parts.loop_seed)
    )
    times = {
        "settle_s": facts["settling_time_mean_s"],
        "alone_s": facts["settling_time_open_loop_s"],
    }
    return about | {"settled_of_10": facts["stable_count"]} | times


def main() -> None:
    """Every plant, seed and model; one layer first, with which the other is compared."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plants", nargs="*", default=PLANTS)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="of the seeds")
    parser.add_argument("--set", nargs="*", default=[], help="settings of the model with neurons")
    options = parser.parse_args()
    print(COLUMNS)
    for plant in options.plants:
        for seed in range(options.first, options.first + options.seeds):
            one = None
            for found in (
                row(plant, kind, seed, [] if kind == "ssm" else options.set) for kind in MODELS
            ):
                own = found.get("settle_s")
                one = one or own
                found["ratio_to_one_layer"] = f"{own / one:.3f}" if own and one else ""
                times = {
                    name: f"{found[name]:.4g}"
                    for name in ("settle_s", "alone_s")
                    if found.get(name)
                }
                print(
                    ",".join(str((found | times).get(name, "")) for name in COLUMNS.split(",")),
                    flush=True,
                )


if __name__ == "__main__":
    main()
