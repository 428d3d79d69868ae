"""The runner-up of the page: much more robust than the best run, hardly slower."""

from typing import Any

import pandas as pd

from ssm_study.report.page.runner_up import RobustAlternative, choose_robust_alternative
from ssm_study.report.words import SETTLED


def run(time_s: float, margin: float, gain: float, **values: Any) -> dict[str, Any]:
    record = {"verdict": SETTLED.word, "plant": "DCMotor", "predicted_stable": True}
    numbers = {"settling_time_mean_s": time_s, "resolved_margin": margin}
    gain_column = {"controller_gain_norm": gain}
    all_columns = record | numbers | gain_column
    return all_columns | values


def found(*runs: dict[str, Any]) -> RobustAlternative | None:
    return choose_robust_alternative(pd.DataFrame(list(runs)))


BEST = run(0.08, 1.36, 33.0)


def test_the_fastest_run_with_twice_the_margin_is_named_with_its_numbers() -> None:
    less_gain = run(0.099, 1.83, 4.2)
    robust = run(0.103, 3.83, 5.9)
    balanced = run(0.117, 4.06, 3.5)
    named = found(BEST, less_gain, robust, balanced)
    words = "settles in 0.103 s, with stability margin 3.83 (best run: 1.36) and gain 5.9 (33)"
    expected = RobustAlternative(place=2, text=words)
    assert named == expected
    second = found(BEST, less_gain)
    assert second is not None
    assert second.place == 1, "half the gain where no run has twice the margin"


def test_a_run_that_is_no_real_alternative_is_not_named() -> None:
    assert found(BEST) is None
    hardly_more_robust = run(0.09, 1.5, 30.0)
    choice = found(BEST, hardly_more_robust)
    assert choice is None, "hardly more robust"
    slow = run(0.17, 4.0, 5.0)
    choice_of_slow = found(BEST, slow)
    assert choice_of_slow is None, "more than twice as slow"
    of_another_plant = run(0.1, 4.0, 5.0, plant="Drive")
    choice_of_another = found(BEST, of_another_plant)
    assert choice_of_another is None, "another plant's seconds"
    unstable = run(0.1, 4.0, 5.0, predicted_stable=False)
    assert found(BEST, unstable) is None
    infeasible = run(0.1, 4.0, 5.0, verdict="infeasible")
    assert found(BEST, infeasible) is None
    without_gain = run(0.1, 4.0, float("nan"))
    choice_without_gain = found(BEST, without_gain)
    assert choice_without_gain is None, "no number to compare"
    best_without_verdict = BEST | {"verdict": "infeasible"}
    choice_without_verdict = found(best_without_verdict, run(0.1, 4.0, 5.0))
    assert choice_without_verdict is None
    no_runs = pd.DataFrame()
    choice_of_none = choose_robust_alternative(no_runs)
    assert choice_of_none is None
