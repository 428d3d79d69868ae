"""Predictions of a design on the plant: the margin by frequency, and the controller by itself."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_cases import BALLS, flat, motor_design, motor_model

from ssm_study.bounds.frequency import frequency_response
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import Loop
from ssm_study.models.identified import SSM
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.scaffolds.monotone import MonotoneScaffold
from ssm_study.plants.stribeck_drive import StribeckDrive
from ssm_study.robustness.bands import ANGLES
from ssm_study.robustness.mismatch import BAND, Mismatch, measure_mismatch
from ssm_study.robustness.prediction import PEAK, noise_peak, predict, robustness_measure
from ssm_study.robustness.record_errors import View
from ssm_study.robustness.sensitivity import (
    FINE_ANGLES,
    Responses,
    controller_radius,
    largest_singular_values,
    sensitivity,
    slope_combinations,
)
from ssm_study.signals import Scale, Trajectory
from ssm_study.synthesis.guaranteed_cost import RiccatiSynthesis
from ssm_study.systems import Balls, Gains, JacobianBall, StateSpace

STEEP_AND_FLAT = (JacobianBall(alpha=1.0, beta=0.0), JacobianBall(alpha=0.1, beta=0.0))
ONES = Balls(input=JacobianBall(alpha=1.0, beta=0.0), output=JacobianBall(alpha=1.0, beta=0.0))


def linear_model(seed: int, order: int = 3) -> SSM:
    """A stable linear model in its own units: every statement below is exact for it."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((order, order))
    a *= rng.uniform(0.6, 0.95) / np.abs(np.linalg.eigvals(a)).max()
    linear = StateSpace(
        a=a,
        b=rng.standard_normal((order, 1)),
        c=rng.standard_normal((1, order)),
        d=rng.standard_normal((1, 1)),
    )
    unit = LinearScaffold(gain=np.eye(1))
    return replace(
        motor_model(),
        linear=linear,
        scaffold_in=unit,
        scaffold_out=unit,
        scale=Scale.identity(1, 1),
        step_s=0.01,
    )


def recorded(model: SSM, taps: np.ndarray, samples: int = 4_000) -> Trajectory:
    """White input, and an output that misses the model by the finite impulse response `taps`."""
    u = np.random.default_rng(0).standard_normal((samples, 1))
    return Trajectory(
        u=u, y=model.simulate(u) + scipy.signal.lfilter(taps, [1.0], u[:, 0])[:, None], step_s=0.01
    )


def closed(model: SSM, k: np.ndarray, gain: np.ndarray, taps: np.ndarray) -> float:
    """Spectral radius of the loop of plant = model + taps, written out: states (x, past inputs,
    estimate)."""
    a = model.linear.a
    b = model.linear.b
    c = model.linear.c
    d = model.linear.d
    n = len(a)
    t = len(taps) - 1
    shift = np.eye(t, k=-1)
    first = np.eye(t, 1)
    injected = gain @ (c + d @ k) - gain @ (d + taps[:1, None]) @ k
    return float(
        np.abs(
            np.linalg.eigvals(
                np.block(
                    [
                        [a, np.zeros((n, t)), b @ k],
                        [np.zeros((t, n)), shift, first @ k],
                        [-gain @ c, -gain @ taps[None, 1:], a + b @ k + injected],
                    ]
                )
            )
        ).max()
    )


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.floats(0.01, 3.0), st.integers(1, 6))
def test_a_linear_mismatch_with_resolved_margin_above_one_never_loses_the_loop(seed, size, length):
    """Small gain by frequency: `g(w) sigma_max(T_ue(w)) < 1` at all w keeps every linear mismatch
    of gain g(w)."""
    model = linear_model(seed)
    design = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3).design(model, ONES)
    k = design.state_feedback.k
    gain = design.observer.l
    taps = size * np.random.default_rng(seed).standard_normal(length + 1)
    found = predict(
        model, Gains(k=k, l=gain), ONES, measure_mismatch(model, (recorded(model, taps),))
    )
    if found.resolved_margin > 1.2:  # Welch's estimate is within some percent
        assert closed(model, k, gain, taps) < 1


@pytest.mark.parametrize("seed", range(5))
def test_a_flat_mismatch_has_the_same_margin_either_way(seed):
    model = linear_model(seed)
    design = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3).design(model, ONES)
    record = recorded(model, np.array([0.0, 0.3]))
    found = predict(model, design.pair, ONES, measure_mismatch(model, (record,)))
    assert found.resolved_margin == pytest.approx(found.mismatch_margin, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_what_pairs_share_changes_no_number(seed):
    """Two pairs one after the other, each with slopes and modes of its own, against each by
    itself."""
    model = linear_model(seed)
    shared = Responses(angles=FINE_ANGLES)
    shown = measure_mismatch(model, (recorded(model, np.array([0.2, 0.3])),))
    for rate in (0.1, 0.3):
        pair = RiccatiSynthesis(rate_controller=rate, rate_observer=rate).design(model, BALLS).pair
        alone = robustness_measure(model, pair, BALLS, shown)
        assert robustness_measure(model, pair, BALLS, shown, shared) == pytest.approx(
            alone, rel=1e-9
        )
        assert (
            alone / 2
            <= robustness_measure(model, pair, BALLS, shown, shared, refused=alone / 2)
            <= alone * (1 + 1e-9)
        )
        assert 0 < alone < np.inf


def test_a_resonance_that_the_total_gain_averages_away_is_seen():
    """The record's mismatch sits in a tenth of the band, where the loop is most sensitive."""
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k
    gain = design.observer.l
    angles = ANGLES
    loops = [
        sensitivity(*end) for end in slope_combinations(model.linear, Gains(k=k, l=gain), BALLS)
    ]
    largest = np.max(
        [largest_singular_values(frequency_response(loop, FINE_ANGLES)) for loop in loops], axis=0
    )
    sensitive = np.array([(near(w)(FINE_ANGLES) * largest).max() for w in angles])
    shown = flat(0.1 + 0.9 * near(angles[sensitive.argmax()])(angles), 0.1)
    found = predict(model, Gains(k=k, l=gain), BALLS, shown)
    assert found.resolved_margin == pytest.approx(0.1 * found.mismatch_margin, rel=0.05)


def near(centre: float):
    return lambda angles: np.clip(1 - np.abs(angles - centre) / 0.1, 0, 1)


@settings(max_examples=10)
@given(st.integers(0, 10_000))
def test_the_radius_is_the_growth_of_the_controller_alone(seed):
    """The plant held still: the controller's own memory grows or shrinks by the radius per
    sample."""
    model = linear_model(seed)
    rng = np.random.default_rng(seed)
    k = rng.standard_normal((1, 3))
    gain = rng.standard_normal((3, 1))
    law = ObserverFeedback(model=model, gains=Gains(k=k, l=gain))
    memory = 1e-8 * rng.standard_normal((1, 3))
    still = np.zeros((1, 1))
    target = law.targets(still)[0]
    grown = []
    for _ in range(200):
        following = law.advance(memory, law.input(memory, still, target), still, target)
        grown.append(np.log(np.linalg.norm(following) / np.linalg.norm(memory)))
        memory = following * np.linalg.norm(memory) / np.linalg.norm(following)
    radius = controller_radius(model.linear, Gains(k=k, l=gain), ONES)
    assert np.mean(grown[100:]) == pytest.approx(np.log(radius), abs=0.05)


def test_the_integrator_does_not_count():
    model = motor_model()
    design = motor_design()
    k = design.state_feedback.k[None]
    gain = design.observer.l[None]
    with_integral = np.concatenate([k, np.full((1, 1, 1), 0.3)], axis=2)
    assert controller_radius(
        model.linear, Gains(k=with_integral, l=gain), BALLS
    ) == controller_radius(model.linear, Gains(k=k, l=gain), BALLS)


def test_an_integrator_holds_where_the_plant_does():
    """Held by friction, the plant gives it no error: the view says nothing of it. A plant that
    answers does."""
    model = motor_model()
    pair = Gains(
        k=np.hstack([motor_design().state_feedback.k, [[-0.02]]]), l=motor_design().observer.l
    )
    ones = np.ones(len(ANGLES))
    large = View(
        amplitude=1.0, gain=0.01, by_frequency=0.01 * ones, linear=0j * ones, rest=0.01 * ones
    )
    held = View(
        amplitude=0.1,
        gain=0.5,
        by_frequency=9 * ones,
        linear=-1.02 * ones + 0j,
        rest=0 * ones,
        response=0.01,
    )
    alone = robustness_measure(model, pair, BALLS, Mismatch(views=(large,)))
    assert (
        0 < alone <= robustness_measure(model, pair, BALLS, Mismatch(views=(held, held, large))) < 1
    )
    answers = replace(held, response=0.5)
    assert robustness_measure(model, pair, BALLS, Mismatch(views=(answers, large))) > 1


@pytest.mark.parametrize(("knee", "passes"), [(1.0, True), (0.3, False)])
def test_a_small_swing_does_not_meet_the_slope_at_the_limit(knee, passes):
    """Small records pass at slope 1 and not at 0.1, where S_u bends beyond or within half the
    amplitude."""
    limit = MonotoneScaffold(
        breakpoints=np.array([[-knee, knee]]), slopes=np.array([[0.1, 1.0, 0.1]])
    )
    model = replace(motor_model(), scaffold_in=limit)
    balls = replace(ONES, input=limit.bound().ball)
    pair = motor_design().pair
    ones = np.ones(len(ANGLES))

    def seen(amplitude: float, gain: float) -> View:
        parts = {"by_frequency": gain * ones, "linear": 0j * ones, "rest": gain * ones}
        return View(amplitude=amplitude, gain=gain, **parts)

    alone = [
        robustness_measure(model, pair, replace(ONES, input=one), Mismatch(views=(seen(1.0, 1.0),)))
        for one in STEEP_AND_FLAT
    ]
    assert 1.2 * alone[0] < alone[1] < np.inf
    gain = 2 / sum(alone)  # between what the two slopes tolerate
    small = (seen(0.1, gain), seen(0.5, 0.0), seen(1.0, 0.0))
    assert (robustness_measure(model, pair, balls, Mismatch(views=small)) < 1) == passes
    large = (
        seen(0.1, 0.0),
        seen(0.5, gain),
        seen(1.0, 0.0),
    )  # the two largest count at every slope
    trial = Mismatch(views=(seen(0.1, 0.0), seen(0.5, 0.0), seen(1.0, 0.0)), loop=seen(0.1, gain))
    pair_alone = Mismatch(views=(seen(0.1, gain), seen(1.0, 0.0)))
    assert (
        min(
            robustness_measure(model, pair, balls, one)
            for one in (Mismatch(views=large), trial, pair_alone)
        )
        > 1
    )


@pytest.mark.parametrize(
    ("sigma", "held_up_to", "passes"),
    [(0.9, 0.0, True), (1.1, 0.0, False), (1.1, 2.0, False), (1.1, 4.0, True)],
)
def test_noise_beyond_the_band_refuses_a_loop(sigma, held_up_to, passes):
    """Input and output simulated: the loop's own equations, white noise. The plant holds still up
    to an amplitude.

    It is given in standard deviations of the input; a sinusoid with the peak of the noise has 4.5 /
    sqrt(2) of them.
    """
    model = linear_model(3)
    samples = 200_000
    pair = RiccatiSynthesis(rate_controller=0.3, rate_observer=0.3).design(model, ONES).pair
    loop = sensitivity(model.linear, pair, 1.0, 1.0)
    drawn = np.random.default_rng(0).standard_normal((samples, 1))
    driven = loop.simulate(drawn)[0]
    moved = float(np.std(model.linear.simulate(driven)[0]))
    strength = sigma * BAND / PEAK / moved
    noise = tuple(np.full(len(ANGLES), strength**2).tolist())
    none = 0 * ANGLES
    held, free = (held_up_to + more for more in (0.0, 0.5))
    views = [
        View(
            amplitude=at * strength * np.std(driven),
            gain=0.0,
            by_frequency=none,
            linear=0j * none,
            rest=none,
            response=r,
        )
        for at, r in ((held, 0.0), (free, 1.0))
    ]
    shown = Mismatch(views=tuple(views), noise=noise)
    found = predict(model, pair, ONES, shown)
    assert found.noise_peak == pytest.approx(0.0 if held_up_to > 3 else sigma, rel=0.02)
    assert found.predicts_stability() == passes
    assert np.isinf(found.resolved_margin)
    assert noise_peak(model, pair, ONES, replace(shown, farthest=1.2)) < 1
    # twice the slope of S_u behind half of B and D is the same loop
    halved = replace(model.linear, b=model.linear.b / 2, d=model.linear.d / 2)
    same = replace(model, linear=halved, scaffold_in=LinearScaffold(gain=2 * np.eye(1)))
    steeper = replace(ONES, input=JacobianBall(alpha=2.0, beta=0.0))
    assert noise_peak(same, pair, steeper, shown) == pytest.approx(found.noise_peak)
    falling = replace(model, scaffold_in=LinearScaffold(gain=-0.5 * np.eye(1)))
    rising = replace(model, scaffold_in=LinearScaffold(gain=0.5 * np.eye(1)))
    balls = [replace(ONES, input=JacobianBall(alpha=alpha, beta=0.4)) for alpha in (-0.5, 0.5)]
    turned = replace(pair, k=-pair.k)  # the same loop
    assert noise_peak(falling, turned, balls[0], shown) == noise_peak(rising, pair, balls[1], shown)
    # of a ball the slope at rest alone counts
    point = replace(ONES, input=JacobianBall(alpha=0.5, beta=0.0))
    assert noise_peak(rising, pair, balls[1], shown) == noise_peak(rising, pair, point, shown)


def drive() -> StribeckDrive:
    values = yaml.safe_load(
        (Path(__file__).parents[2] / "conf" / "plant" / "stribeck_drive.yaml").read_text()
    )
    return StribeckDrive(**{name: value for name, value in values.items() if name != "_target_"})


def drive_model() -> SSM:
    """The drive without friction, exact but for it: the current's lag, then the inertia."""
    plant = drive()
    h = drive().step_s
    lag = np.exp(-h / plant.current_lag_s)
    slip = np.exp(-h * plant.viscous_nms_per_rad / plant.inertia_kgm2)
    pushed = plant.torque_constant_nm_per_a * h / plant.inertia_kgm2
    unit = LinearScaffold(gain=np.eye(1))
    return replace(
        motor_model(),
        linear=StateSpace(
            a=np.array([[lag, 0.0], [pushed, slip]]),
            b=np.array([[1 - lag], [0.0]]),
            c=np.array([[0.0, 1.0]]),
            d=np.zeros((1, 1)),
        ),
        scaffold_in=unit, scaffold_out=unit, scale=Scale.identity(1, 1),
    )  # fmt: skip


@pytest.mark.parametrize("stable", [True, False])
def test_a_plant_with_stiction_comes_to_rest_only_under_a_stable_controller(stable):
    """Both designs are certified for the model. From rest, with an estimate off by a millionth:
    friction holds the drive, so the controller runs alone. The stable one forgets; the other pushes
    until the drive breaks loose, and the input never dies out."""
    model = drive_model()
    plant = drive()
    weights = (
        {"input_weight": 1.0, "output_noise": 1.0}
        if stable
        else {"input_weight": 1e-5, "output_noise": 1e-6}
    )
    design = RiccatiSynthesis(rate_controller=0.05, rate_observer=0.1, **weights).design(
        model, ONES
    )
    assert design.certified
    law = ObserverFeedback.from_design(model, design)
    radius = controller_radius(model.linear, law.gains, ONES)
    assert (radius < 1) == stable
    run = Loop(initial_conditions=1, horizon_s=6.0).simulate(
        plant, law, np.full((1, 1), 1e-6), np.zeros((1, 600, 1))
    )
    assert (np.abs(run.u[0, -100:]).max() < 1e-12) == stable
    assert (np.abs(run.y[0, 300:]).max() == 0.0) == stable
