"""How well the plant itself, its load unknown, predicts the logs with an unmeasured load: `python
benchmarks/unmeasured_load.py`.

The plant's exact response to the logged input is simulated over the log of kind `unmeasured` of
`log_kinds.py`. What is missing is the load; its mean over the training and validation part is added
as a constant, the best that a model without the load can know. A fit above that is chance: the
load's mean in the test part happened to lie nearer. One row a seed goes into `unmeasured_load.csv`,
beside the fits of the chosen model and of the best baseline, which `log_choice_kinds.csv` has.
Under a second.
"""

import numpy as np
from common import REFERENCE, rows_of, write
from log_kinds import SAMPLES, kind_named, responses_to_both_inputs

from ssm_study.signals import fit_percent

TARGET = REFERENCE / "training"
KIND = kind_named("unmeasured")
TEST_FROM = SAMPLES * 4 // 5  # the command's split: a fifth of the log is tested
COMPARED = ("fit_predicted_percent", "fit_baseline_percent")


def plant_row(seed: int) -> dict[str, object]:
    """Fit of the plant's response to the logged input, with the mean load of training and
    validation."""
    y = KIND.log(seed)["y"].to_numpy()
    rng = np.random.default_rng([seed, *KIND.name.encode()])
    _, _, to_input, _ = responses_to_both_inputs(rng, SAMPLES)
    unexplained = y - to_input
    mean_load = unexplained[:TEST_FROM].mean()
    simulated = to_input + mean_load
    fit = fit_percent(y[TEST_FROM:, None], simulated[TEST_FROM:, None])
    test_load = unexplained[TEST_FROM:].mean()
    return {
        "seed": seed,
        "mean_load_before_test": round(mean_load, 3),
        "mean_load_in_test": round(test_load, 3),
        "fit_of_plant_percent": round(fit, 1),
    }


def main() -> None:
    """Write the table, and print it."""
    rows = []
    for measured in rows_of(TARGET / "log_choice_kinds.csv"):
        if measured["log"] == KIND.name:
            fits = {name: round(float(measured[name]), 1) for name in COMPARED}
            rows.append(plant_row(int(measured["seed"])) | fits)
            print(rows[-1])
    write(TARGET / "unmeasured_load.csv", rows)


if __name__ == "__main__":
    main()
