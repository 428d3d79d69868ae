"""The best run, the verdicts and the Pareto front are what a reader takes away: their rules, tested."""

import numpy as np
import pandas as pd
import report_tables
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.report import verdict
from ssm_study.report.pareto import pareto_front

POINTS = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=30)


@given(POINTS)
def test_a_point_is_on_the_front_exactly_if_no_other_beats_it(points: list[tuple[int, int]]) -> None:
    x, y = np.array(points, dtype=float).reshape(-1, 2).T
    beaten = [any(a >= px and b >= py and (a > px or b > py) for a, b in points) for px, py in points]
    assert pareto_front(x, y).tolist() == [not b for b in beaten]


def test_nan_is_never_on_the_front() -> None:
    nan = float("nan")
    assert pareto_front(np.array([9.0, 1.0, nan]), np.array([nan, 1.0, 5.0])).tolist() == [False, True, False]


def row(**values: object) -> dict[str, object]:
    good = {"status": "ok", "controller_certified": True, "observer_certified": True, "stable_fraction": 1.0}
    return good | {"settling_time_mean_s": 0.1, "fit_test_percent": 90.0} | values


def test_a_fast_loop_without_certificate_never_beats_a_certified_one() -> None:
    slow, quick = row(run="slow", settling_time_mean_s=0.3), row(run="quick", settling_time_mean_s=0.2)
    bare = row(run="bare", settling_time_mean_s=0.01, controller_certified=False)
    lost = row(run="lost", settling_time_mean_s=0.02, stable_fraction=0.9)
    failed = {"run": "failed", "status": "failed"}
    order = verdict.best_first(pd.DataFrame([failed, bare, slow, lost, quick]))["run"].tolist()
    assert order == ["quick", "slow", "lost", "bare", "failed"]


def test_a_baseline_that_is_only_scored_is_identified_not_uncertified() -> None:
    baseline = {"run": "gru", "status": "ok", "fit_test_percent": 95.0}
    assert verdict.verdicts(pd.DataFrame([baseline, row(run="ours")])).tolist() == ["identified", "certified, settles"]


def test_an_unknown_status_counts_as_failed_not_as_fine() -> None:
    for status in ("failed", "lost", "corrupt", "running", None):
        assert verdict.verdicts(pd.DataFrame([row(status=status)])).tolist() == [verdict.FAILED.word]


def test_counts_add_up() -> None:
    table = report_tables.table(50)
    assert sum(int(part.split()[0]) for part in verdict.counts(table).split(": ")[1].split("; ")) == 50
    assert verdict.counts(report_tables.empty()) == "0 runs"
