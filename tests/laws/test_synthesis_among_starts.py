"""Among trained models that fit about as well, the one whose controller may be fastest is kept."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssm_study.bounds.slopes import certified_balls
from ssm_study.models.structured import StructuredSSM
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.synthesis.model_selection import LargestCertifiableRate, largest_certifiable_rate
from ssm_study.systems import JacobianBall, StructuredSystem
from tests.structured_cases import drawn, model

BALL = JacobianBall.from_slopes(0.5, 1.0)


def trained(of: StructuredSSM, fit: float) -> SimpleNamespace:
    return SimpleNamespace(model=of, fit_validation_percent=fit)


def slower(of: StructuredSSM) -> StructuredSSM:
    """The same with a mode that no input reaches."""
    a = of.a.copy()
    b = of.b.copy()
    a[0] = 0.0
    a[:, 0] = 0.0
    b[0] = 0.0
    a[0, 0] = 0.99
    first = of.e[:1]
    without_first = 0.0 * first
    others = of.e[1:]
    e = np.vstack([without_first, others])
    return replace(of, a=a, b=b, e=e)


def test_nearly_equal_fits_leave_the_choice_to_the_rate_and_a_better_fit_does_not() -> None:
    fast = model()
    slow = slower(model())
    rule = LargestCertifiableRate(within_percent=0.3)
    slow_trained = trained(slow, 98.0)
    fast_trained = trained(fast, 97.8)
    models = [slow_trained, fast_trained, trained(fast, 97.6)]
    assert rule(models) is models[1]
    far_behind = [slow_trained, trained(fast, 97.6)]
    assert rule(far_behind).model is slow
    best_fit = LargestCertifiableRate(within_percent=0.0)
    assert best_fit(models) is models[0]


def test_neurons_must_gain_a_percent_point() -> None:
    """A model without them is kept where it fits nearly as well and is faster to control, not where
    they gain more."""
    slow = slower(model())
    rule = LargestCertifiableRate()
    e = slow.e[:, :0]
    f = slow.f[:0]
    g = slow.g[:0]
    h = slow.h[:, :0]
    bias = slow.bias[:0]
    none = {"e": e, "f": f, "g": g, "h": h, "bias": bias}
    plain = replace(model(), **none, neurons=())
    with_neurons = trained(slow, 98.0)
    nearly_as_good = [with_neurons, trained(plain, 97.1)]
    assert rule(nearly_as_good).model is plain
    not_as_good = [with_neurons, trained(plain, 96.9)]
    assert rule(not_as_good).model is slow


def test_every_other_start_has_half_the_states_and_the_last_no_neurons() -> None:
    spec = StructuredSpec(order=5, neurons=4, starts=3, among_starts=LargestCertifiableRate())
    runs = [spec.settings_of_training_run(k) for k in range(spec.training_run_count)]
    sizes = [(run.order, run.neurons) for run in runs]

    large = (5, 4)
    small = (3, 4)
    without_neurons = (3, 0)
    expected = [large, small, (5, 4), without_neurons]
    assert sizes == expected
    best = replace(spec, among_starts=None)
    expected = [best] * 3
    numbers_of_runs = range(best.training_run_count)
    specs = [best.settings_of_training_run(k) for k in numbers_of_runs]
    assert specs == expected


def test_neurons_that_do_nothing_leave_the_exact_limit() -> None:
    """Bisection on the inequality with neurons, and the frontier in closed form."""
    idle = drawn(seed=3, size=1e-6)
    assert isinstance(idle, StructuredSystem)
    slopes = np.zeros(idle.neurons)
    system = idle.linearise_at_slopes(slopes)
    exact = largest_certifiable_rate(system, BALL)
    rate_of_idle = largest_certifiable_rate(idle, BALL)
    expected_rate = pytest.approx(exact, abs=2e-3)
    assert rate_of_idle == expected_rate
    assert largest_certifiable_rate(idle, BALL) <= exact


def test_of_those_that_are_fast_enough_the_best_fit_is_kept() -> None:
    fast = model()
    slow = slower(model())
    best = trained(slow, 98.0)
    first = trained(fast, 97.8)
    second = trained(fast, 97.9)
    limits = []
    for candidate in (slow, fast):
        balls = certified_balls(candidate)
        limits.append(largest_certifiable_rate(candidate.system, balls.input))
    assert limits[0] < limits[1]
    models = [best, first, second]
    middle = 0.5 * sum(limits)
    half_of_the_sum = LargestCertifiableRate(rate_enough=middle)
    assert half_of_the_sum(models) is second
    nearly_slow = 0.9 * limits[0]
    nearly_the_first = LargestCertifiableRate(rate_enough=nearly_slow)
    assert nearly_the_first(models) is best
    beyond = 0.5 * (1 + limits[1])
    beyond_both = LargestCertifiableRate(rate_enough=beyond)
    assert beyond_both(models) is first  # none is: the fastest


OUT_OF_RANGE = [("within_percent", -1.0), ("rate_enough", 1.5), ("rate_enough", 0.0)]


@pytest.mark.parametrize(("name", "value"), OUT_OF_RANGE)
def test_a_share_or_rate_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(BadRequest, match=name):
        LargestCertifiableRate(**{name: value})
