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
    a[0], a[:, 0], b[0] = 0.0, 0.0, 0.0
    a[0, 0] = 0.99
    without_first = 0.0 * of.e[:1]
    e = np.vstack([without_first, of.e[1:]])
    return replace(of, a=a, b=b, e=e)


def test_nearly_equal_fits_leave_the_choice_to_the_rate_and_a_better_fit_does_not() -> None:
    fast = model()
    slow = slower(model())
    rule = LargestCertifiableRate(within_percent=0.3)
    slow_trained = trained(slow, 98.0)
    found = [slow_trained, trained(fast, 97.8), trained(fast, 97.6)]
    assert rule(found) is found[1]
    assert rule([trained(slow, 98.0), trained(fast, 97.6)]).model is slow
    assert LargestCertifiableRate(within_percent=0.0)(found) is found[0]


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
    assert rule([trained(slow, 98.0), trained(plain, 97.1)]).model is plain
    assert rule([trained(slow, 98.0), trained(plain, 96.9)]).model is slow


def test_every_other_start_has_half_the_states_and_the_last_no_neurons() -> None:
    spec = StructuredSpec(order=5, neurons=4, starts=3, among_starts=LargestCertifiableRate())
    sizes = [
        (one.order, one.neurons) for one in map(spec.for_training_run, range(spec.training_count))
    ]

    expected = [(5, 4), (3, 4), (5, 4), (3, 0)]
    assert sizes == expected
    best = replace(spec, among_starts=None)
    expected = [best] * 3
    assert [best.for_training_run(k) for k in range(best.training_count)] == expected


def test_neurons_that_do_nothing_leave_the_exact_limit() -> None:
    """Bisection on the inequality with neurons, and the frontier in closed form."""
    idle = drawn(seed=3, size=1e-6)
    assert isinstance(idle, StructuredSystem)
    slopes = np.zeros(idle.neurons)
    system = idle.linearise_at_slopes(slopes)
    exact = largest_certifiable_rate(system, BALL)
    assert largest_certifiable_rate(idle, BALL) == pytest.approx(exact, abs=2e-3)
    assert largest_certifiable_rate(idle, BALL) <= exact


def test_of_those_that_are_fast_enough_the_best_fit_is_kept() -> None:
    fast = model()
    slow = slower(model())
    best = trained(slow, 98.0)
    first = trained(fast, 97.8)
    second = trained(fast, 97.9)
    limits = [
        largest_certifiable_rate(one.system, certified_balls(one).input) for one in (slow, fast)
    ]
    assert limits[0] < limits[1]
    found = [best, first, second]
    half_of_the_sum = LargestCertifiableRate(rate_enough=0.5 * sum(limits))
    assert half_of_the_sum(found) is second
    nearly_the_first = LargestCertifiableRate(rate_enough=0.9 * limits[0])
    assert nearly_the_first(found) is best
    beyond_both = LargestCertifiableRate(rate_enough=0.5 * (1 + limits[1]))
    assert beyond_both(found) is first  # none is: the fastest


@pytest.mark.parametrize(
    ("name", "value"), [("within_percent", -1.0), ("rate_enough", 1.5), ("rate_enough", 0.0)]
)
def test_a_share_or_rate_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(BadRequest, match=name):
        LargestCertifiableRate(**{name: value})
