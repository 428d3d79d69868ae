"""Data sets simulated with a plant of this project, with measurement noise.

A few more records are for one purpose only: how far the plant is from its model where the loop will
take it. No fit uses them. An excitation at full amplitude, held for some samples at a time, says
little of what happens near rest, above its own band, or from where the loop starts. Source:
docs/trust.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ssm_study.data.assembly import assemble_dataset
from ssm_study.data.excitations.excitation import Excitation, SignalRequest
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require_at_least
from ssm_study.signals import DataSet, Trajectories, Trajectory

FEWEST_SAMPLES = 20
SHARES = (0.05, 0.1, 0.2, 0.5, 1.0)  # amplitudes of the trials, as shares of the plant's own
PERIOD = 1024  # samples; every trial holds two, so that what repeats is told from what does not
LEAD_IN = (
    PERIOD // 4
)  # the end of a period runs before the first, so that the transient from rest is over
REST = PERIOD // 2  # samples at rest input behind the last period
DECAYS = (
    -1.0,
    -0.5,
    0.5,
    1.0,
)  # where the free decays start, as shares of the plant's initial range
RETURNS = (
    -0.5,
    -0.25,
    0.35,
    0.7,
)  # input levels, as SHARES, from which a straight line leads back to rest


SINE_SHARES = (0.01, 0.05, 0.2, 1.0)  # amplitudes of single sines
SINES = 13  # marks the seed of their noise
FRESH = 11  # marks the seeds of fresh data sets


class TrainingAmplitudeWarning(UserWarning):
    """Warning that the amplitude set for an excitation applies to the training records only."""


@dataclass(frozen=True, kw_only=True)
class HeldOutRecords:
    """Simulated records that neither the fit nor the design has used, for an independent
    measurement of the model error."""

    validation: Trajectories
    mismatch_records: Trajectories


@dataclass(frozen=True, kw_only=True)
class SimulatedData:
    """Data set that is simulated with one of the project's plants, with measurement noise. `y =
    h(x) + e`, `e ~ N(0, noise_variance)` on training and validation records; the test record is
    noise-free unless `test_noise`.

    Validation and test, one record each, are excited by `scoring_excitation` whatever the training
    excitation is, so that runs compare. Every record of the three parts starts at the plant's
    equilibrium; `trials` are for the mismatch. `fresh_sets` further data sets, which neither fit
    nor design sees, show how much model error the proof of a design would have to cover in them.
    """

    trajectories: int
    samples: int
    validation_samples: int
    test_samples: int
    scoring_excitation: Excitation
    noise_variance: float | None = None
    test_noise: bool = False
    start_up_samples: int = 0
    trials: bool = True
    fresh_sets: int = 0

    def __post_init__(self) -> None:
        require_at_least(1, "data.trajectories", self.trajectories, "use 8 or so")
        for name in ("samples", "validation_samples", "test_samples"):
            require_at_least(FEWEST_SAMPLES, f"data.{name}", getattr(self, name), "use 1000 or so")
        require_at_least(
            0,
            "data.noise_variance",
            self.noise_variance,
            "use 0 for no noise, or null for the plant's own",
        )
        require_at_least(0, "data.start_up_samples", self.start_up_samples, "use 0")
        require_at_least(0, "data.fresh_sets", self.fresh_sets, "use 0 for none")

    def build(self, plant: Plant, excitation: Excitation, seed: int) -> DataSet:
        """Build a data set by simulating a plant under excitation signals. Equal seeds give equal
        numbers."""
        rng = np.random.default_rng(seed)
        scoring = self.scoring_excitation
        training = self._simulate_records(plant, excitation, rng, self.trajectories, self.samples)
        validation = self._simulate_records(plant, scoring, rng, 1, self.validation_samples)
        noisy = self.test_noise
        test = self._simulate_records(plant, scoring, rng, 1, self.test_samples, has_noise=noisy)
        about = {
            "source": "simulated",
            "plant": type(plant).__name__,
            "excitation": excitation.kind,
            "seed": str(seed),
        }
        fields: dict[str, Any] = {"metadata": about}
        if self.trials:
            trial_rng = np.random.default_rng([seed, 7])
            deviation = self.noise_deviation(plant)
            trials = simulate_mismatch_records(plant, trial_rng, deviation)
            fields["mismatch_records"] = trials
        parts = (training, validation, test)
        rest = plant.equilibrium()
        channels = (plant.inputs, plant.outputs)
        return assemble_dataset(parts, (rest.u, rest.y), channels, self.start_up_samples, **fields)

    def simulate_held_out_records(self, plant: Plant, seed: int) -> Iterator[HeldOutRecords]:
        """Simulate several further sets of records that are used neither by the fit nor by the
        design."""
        for number in range(self.fresh_sets):
            rng = np.random.default_rng([seed, FRESH, number])
            scoring = self.scoring_excitation
            validation = self._simulate_records(plant, scoring, rng, 1, self.validation_samples)
            trials: Trajectories = ()
            if self.trials:
                trials = simulate_mismatch_records(plant, rng, self.noise_deviation(plant))
            yield HeldOutRecords(validation=tuple(validation), mismatch_records=trials)

    def simulate_sine_experiments(
        self, plant: Plant, seed: int, frequency_indices: Sequence[int]
    ) -> tuple[Trajectory, ...]:
        """Simulate single-sine experiments at the frequencies at which a controller design is most
        sensitive to model errors."""
        rng = np.random.default_rng([seed, SINES])
        return simulate_sine_records(plant, rng, self.noise_deviation(plant), frequency_indices)

    def noise_deviation(self, plant: Plant) -> Float[np.ndarray, "p"]:
        """Standard deviation of the simulated measurement noise, in physical units."""
        variance = np.array(plant.noise_variance)
        if self.noise_variance is not None:
            variance = np.full_like(variance, self.noise_variance)
        return np.asarray(np.sqrt(variance))

    def _simulate_records(
        self,
        plant: Plant,
        excitation: Excitation,
        rng: np.random.Generator,
        count: int,
        samples: int,
        *,
        has_noise: bool = True,
    ) -> list[Trajectory]:
        """Simulate records of a plant from its equilibrium under an excitation."""
        request = SignalRequest(
            samples=samples,
            step_s=plant.step_s,
            amplitude=plant.input_amplitude,
            clock_s=plant.input_clock_s,
        )
        signals = [excitation.signal(request, rng) for _ in range(count)]
        deviations = np.stack(signals)
        u = plant.equilibrium().u + deviations
        _, y = plant.simulate(u)
        if has_noise:
            noise = rng.standard_normal(y.shape)
            y = y + self.noise_deviation(plant) * noise
        pairs = zip(u, y, strict=True)
        return [Trajectory(u=inputs, y=outputs, step_s=plant.step_s) for inputs, outputs in pairs]


def simulate_mismatch_records(
    plant: Plant, rng: np.random.Generator, deviation: Float[np.ndarray, "p"]
) -> tuple[Trajectory, ...]:
    """Simulate records that only serve to measure the model error: periodic excitation, free decays
    and slow returns to equilibrium. Two periods at each of `SHARES` and then rest; free decays from
    each of `DECAYS`; noise of that `noise_deviation`.

    Then slow returns from each of `RETURNS`, and rest: friction may hold the plant away from rest
    after a slow return, but not after a jump.
    """
    rest = plant.equilibrium()
    clock_period_samples = round(plant.input_clock_s / plant.step_s)
    longest = 5 * max(clock_period_samples, 1)
    amplitude = np.array(plant.input_amplitude)
    signals = [_broadband_input(rng, longest) for _ in rest.u]
    period = np.stack(signals, axis=1) * amplitude
    at_rest = np.zeros((REST, len(rest.u)))
    whole = np.concatenate([period[-LEAD_IN:], period, period, at_rest])
    shares_driven = np.array(SHARES)[:, None, None]
    driven = rest.u + shares_driven * whole
    low, high = plant.initial_range
    share = np.array(DECAYS)[:, None] * np.ones(len(rest.y))
    reach = np.where(share < 0, -low, high)
    starts = rest.y + reach * share
    still = np.tile(rest.u, (len(DECAYS), PERIOD, 1))
    ends = [PERIOD // 4, PERIOD // 2]
    samples = np.arange(PERIOD)
    ramp = np.interp(samples, ends, [1.0, 0.0])
    line = ramp[:, None] * amplitude
    shares_returned = np.array(RETURNS)[:, None, None]
    returning = rest.u + shares_returned * line
    experiments: list[tuple[str, Sequence[float], np.ndarray, np.ndarray | None]] = [
        ("trial_at", SHARES, driven, None),
        ("decay_from", DECAYS, still, plant.equilibrium_states(starts)),
        ("return_from", RETURNS, returning, None),
    ]
    records: list[Trajectory] = []
    for word, shares, u, x0 in experiments:
        _, y = plant.simulate(u, x0)
        noise = rng.standard_normal(y.shape)
        noisy = y + deviation * noise
        names = [f"{word}_{share:g}" for share in shares]
        records += _split_into_records(plant, names, u, noisy)
    return tuple(records)


def _split_into_records(
    plant: Plant, names: Sequence[str], u: np.ndarray, y: np.ndarray
) -> list[Trajectory]:
    """Split stacked inputs and outputs of several simulations into one named record for each."""
    records = []
    for name, inputs, outputs in zip(names, u, y, strict=True):
        records.append(Trajectory(u=inputs, y=outputs, step_s=plant.step_s, name=name))
    return records


def simulate_sine_records(
    plant: Plant,
    rng: np.random.Generator,
    deviation: Float[np.ndarray, "p"],
    frequency_indices: Sequence[int],
) -> tuple[Trajectory, ...]:
    """Simulate single-sine experiments of a plant at given frequencies and several amplitudes. Each
    has one period of `PERIOD` samples as lead-in and two that count, at each of `SINE_SHARES` of
    the amplitude; all inputs move alike."""
    rest = plant.equilibrium()
    amplitude = np.array(plant.input_amplitude)
    inputs = []
    samples = np.arange(PERIOD)
    for line in frequency_indices:
        angles = 2 * np.pi * line * samples / PERIOD
        period = np.sin(angles)[:, None]
        wave = np.tile(period, (3, 1))  # the same bits in every period
        inputs += [rest.u + share * amplitude * wave for share in SINE_SHARES]
    if not inputs:
        return ()
    u = np.stack(inputs)
    _, y = plant.simulate(u)
    noise = rng.standard_normal(y.shape)
    noisy = y + deviation * noise
    names = [f"sine_{line}_at_{share:g}" for line in frequency_indices for share in SINE_SHARES]
    return tuple(_split_into_records(plant, names, u, noisy))


def _broadband_input(rng: np.random.Generator, longest_hold: int) -> Float[np.ndarray, "T"]:
    """Generate a broadband input signal with random levels and random holding times. Levels are
    uniform in [-1, 1]; the logarithm of the holding time is uniform up to `longest_hold`."""
    exponents = rng.uniform(0.0, np.log(longest_hold + 1), PERIOD)
    holding_times = np.exp(exponents).astype(int)
    levels = rng.uniform(-1.0, 1.0, PERIOD)
    signal = np.repeat(levels, holding_times)
    return signal[:PERIOD]
