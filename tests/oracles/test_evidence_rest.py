"""What stays off after the input has moved: a valve that sticks rests at rest input, and away from rest."""

import numpy as np
import pytest
from test_evidence_response import LEVELS, answer, case

from ssm_study.evidence.records import findings
from ssm_study.signals import Trajectory
from ssm_study.synthesis.mismatch import Mismatch, mismatch

THEN_REST = np.concatenate([LEVELS[:5400], np.zeros(600)])


def said(u: np.ndarray, y: np.ndarray) -> list[str]:
    log = case(u, y)
    shown: Mismatch = mismatch(log.model, log.data.validation)
    return [found.sentence for found in findings(log, shown) if "scales off at rest input" in found.sentence]


@pytest.mark.parametrize("stick", [0.0, 0.3])
def test_an_output_that_stays_off_after_the_last_motion_is_a_doubt(stick):
    """The stem follows where it is pushed by more than `stick`; the input ends at less, the output stays there."""
    stem, out = 0.0, np.zeros(len(THEN_REST))
    u = THEN_REST.copy()
    u[5300:5400] = 0.25
    u[5200:5300] = -0.1
    for k, pushed in enumerate(u):
        stem = pushed if abs(pushed - stem) > stick else stem
        out[k] = stem
    assert bool(said(u, answer(out))) == (stick > 0)
    log = case(u, answer(out))
    rest = Trajectory(u=np.zeros((600, 1)), y=np.linspace(-1.5, 0, 600)[:, None] ** 3, step_s=0.1)
    shown = mismatch(log.model, log.data.validation, 0, (*log.data.test, rest))
    assert shown.stuck == pytest.approx((0.25 / log.model.scale.output_scale[0],) if stick else (), abs=0.01)
    assert shown.farthest == pytest.approx(1.5**3 / log.model.scale.output_scale[0])
    assert (shown.offset > 0) == (stick > 0)


def test_a_record_that_ends_before_the_answer_does_says_nothing():
    u = np.concatenate([LEVELS[:5980], np.zeros(20)])
    assert said(u, answer(u)) == []
