"""Data from a plant of this project: excite, simulate, add measurement noise, keep the three parts apart."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ssm_study.data.assembly import assemble
from ssm_study.data.excitation import Excitation, Request
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require
from ssm_study.signals import DataSet, Trajectory

FEWEST_SAMPLES = 20


@dataclass(frozen=True, kw_only=True)
class SimulatedData:
    """`y = h(x) + e`, `e ~ N(0, noise_variance)` on training and validation records; the test record is noise-free.

    `trajectories` training records of `samples` each, one validation and one test record. Validation and test are
    excited by `scoring_excitation` (multilevel) whatever the training excitation is, so that runs compare.
    `noise_variance` None takes the plant's own. Every record starts at the plant's equilibrium.
    """

    trajectories: int
    samples: int
    validation_samples: int
    test_samples: int
    scoring_excitation: Excitation
    noise_variance: float | None = None
    test_noise: bool = False
    start_up_samples: int = 0

    def __post_init__(self) -> None:
        require(self.trajectories >= 1, "data.trajectories", self.trajectories, "must be at least one", "use 8 or so")
        for name in ("samples", "validation_samples", "test_samples"):
            value = getattr(self, name)
            require(
                value >= FEWEST_SAMPLES, f"data.{name}", value, f"fewer than {FEWEST_SAMPLES} samples", "use 1000 or so"
            )
        noise = self.noise_variance
        require(
            noise is None or 0 <= noise < np.inf,
            "data.noise_variance",
            noise,
            "a variance is never negative",
            "use 0 for no noise, or null for the plant's own",
        )
        require(
            self.start_up_samples >= 0, "data.start_up_samples", self.start_up_samples, "must not be negative", "use 0"
        )

    def build(self, plant: Plant, excitation: Excitation, seed: int) -> DataSet:
        """The data set of this plant under this excitation; equal seeds give equal numbers."""
        rng = np.random.default_rng(seed)
        training = self._records(plant, excitation, rng, "training", self.trajectories, self.samples, noisy=True)
        scoring = self.scoring_excitation
        validation = self._records(plant, scoring, rng, "validation", 1, self.validation_samples, noisy=True)
        test = self._records(plant, scoring, rng, "test", 1, self.test_samples, noisy=self.test_noise)
        rest = plant.equilibrium()
        return assemble(
            training=training,
            validation=validation,
            test=test,
            inputs=plant.inputs,
            outputs=plant.outputs,
            input_equilibrium=rest.u,
            output_equilibrium=rest.y,
            start_up_samples=self.start_up_samples,
            metadata={
                "source": "simulated",
                "plant": type(plant).__name__,
                "excitation": excitation.kind,
                "seed": str(seed),
            },
        )

    def _records(
        self,
        plant: Plant,
        excitation: Excitation,
        rng: np.random.Generator,
        part: str,
        count: int,
        samples: int,
        noisy: bool,
    ) -> tuple[Trajectory, ...]:
        request = Request(
            samples=samples, step_s=plant.step_s, amplitude=plant.input_amplitude, clock_s=plant.input_clock_s
        )
        u = plant.equilibrium().u + np.stack([excitation.signal(request, rng) for _ in range(count)])
        _, y = plant.simulate(u)
        if noisy:
            y = y + self._noise_deviation(plant) * rng.standard_normal(y.shape)
        return tuple(Trajectory(u=u[i], y=y[i], step_s=plant.step_s, name=f"{part}_{i + 1}") for i in range(count))

    def _noise_deviation(self, plant: Plant) -> Float[np.ndarray, "p"]:
        own = np.array(plant.noise_variance)
        return np.sqrt(own if self.noise_variance is None else np.full_like(own, self.noise_variance))
