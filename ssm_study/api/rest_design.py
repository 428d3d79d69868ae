"""A controller of a bilinear model in Python: proved facts, closed-loop simulation and export.

For them it is proved that the loop comes to rest; two motions are compared only inside a stated set
(`certificates.theorems.bilinear_loop`, `bilinear_contraction`).
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ssm_study.api.arguments import Values
from ssm_study.api.loops import tabulate_rollouts
from ssm_study.api.summaries import PROVED, html_table, render_text_table
from ssm_study.api.systems import read_number, read_path
from ssm_study.certificates.bilinear_certificates import BilinearDesign, failed_bilinear_checks
from ssm_study.certificates.certificate import certificate_digest
from ssm_study.data.arrays import signal_array_and_names
from ssm_study.durable import read_json
from ssm_study.export.bilinear_c import render_bilinear_c
from ssm_study.loop.bilinear_feedback import BilinearFeedback, BilinearPlant
from ssm_study.loop.rollout import simulate_closed_loop
from ssm_study.models.bilinear import Bilinear, hat_functions
from ssm_study.models.stored import model_from_json
from ssm_study.plants.plant import Plant
from ssm_study.refusal import require, require_positive
from ssm_study.signals import Channel

MODEL = "model.json"
CERTIFICATE = "certificate.json"
CHANNELS = "channels.json"
LARGEST_OUTPUT = 1e3  # output scales from the equilibrium, beyond which a loop is stopped
SHORTEST = 50  # samples of a simulated loop
DECAYED = 0.01  # share of the first distance from rest that is left at its end
LEVELS = 201  # inputs, from zero to an end, at which a start from rest is examined
LONGEST = 5000  # samples, where hardly anything decays
MODEL_WORDS = {
    "bilinear_loop": "the loop comes to rest from the stated starts",
    "bilinear_everywhere": "the loop comes to rest from every start",
    "bilinear_contraction": "two motions of the state feedback approach each other",
}


@dataclass(frozen=True, kw_only=True, repr=False)
class RestDesign:
    """Controller with observer for a bilinear model, whose closed loop is proved to come to rest.
    `v = K xh`, cut at the ends of the recorded inputs.

    `certificates` has the gains and what is proved; `channels` are the model's input and outputs.
    """

    model: Bilinear
    certificates: BilinearDesign
    channels: tuple[Channel, ...]

    @property
    def certified(self) -> bool:
        """Whether exact arithmetic proves that the closed loop comes to rest, from all initial
        states or from a stated set."""
        return self.certificates.certified

    @property
    def controller(self) -> BilinearFeedback:
        """State feedback with observer and limited input, in the form that is simulated and
        exported. Raises `BadRequest` with the reason where no gains were found."""
        reasons = self.certificates.reasons
        reason = reasons.get("gains", "")
        require(not reason, "design", "no gains", reason, "fit another model")
        certificates = self.certificates
        return BilinearFeedback(model=self.model, k=certificates.k, l_nodes=certificates.l_nodes)

    @property
    def proved_numbers(self) -> dict[str, Any]:
        """Numbers that are proved for the closed loop of a bilinear model, by the certificates'
        field names."""
        facts: dict[str, Any] = {"certified": self.certified}
        for label, part in self.certificates.parts.items():
            for name, value in vars(part).items():
                if isinstance(value, float) and name not in ("alpha", "beta", "seconds"):
                    facts[f"{label}_{name}"] = value
        return facts

    def simulate(
        self, y0: Values, horizon_s: float | None = None, plant: Plant | None = None
    ) -> pd.DataFrame:
        """Simulate the closed loop without noise from given initial outputs, on the model or on a
        plant. Outputs `(N, p)` or `(N,)`; the estimate starts at rest.

        One row per case and sample: `case, time_s`, inputs and outputs by name. Raises `BadRequest`
        for other channels.
        """
        on = plant or BilinearPlant.from_model(self.model, self.channels[:1], self.channels[1:])
        is_plant = isinstance(on, Plant)
        kind = type(on).__name__
        require(is_plant, "plant", kind, "is no plant", "leave it out to simulate the model")
        names = [channel.name for channel in on.outputs]
        output_count = len(names)
        _, starts = signal_array_and_names(y0, "y0", output_count, names)
        samples = self._default_sample_count
        if horizon_s is not None:
            seconds = read_number("horizon_s", horizon_s)
            require_positive("horizon_s", seconds, "give it in seconds")
            periods = seconds / on.step_s
            whole_periods = int(np.ceil(periods))
            samples = max(whole_periods, 1)
        scale = self.model.scale
        initial_states = on.equilibrium_states(starts)
        reference = np.tile(scale.output_equilibrium, (samples, 1))
        noise_shape = (len(starts), samples, len(names))
        noise = np.zeros(noise_shape)
        disturbance_shape = (len(starts), samples, len(on.disturbances))
        disturbance = np.zeros(disturbance_shape)
        rollouts = simulate_closed_loop(
            on,
            self.controller,
            initial_states=initial_states,
            reference=reference,
            noise=noise,
            disturbance=disturbance,
            bound=LARGEST_OUTPUT * scale.output_scale,
        )
        return tabulate_rollouts(rollouts, on)

    @property
    def _default_sample_count(self) -> int:
        """Default length of a simulation in samples: until the proved bound on the distance from
        rest is 1 % of its initial value."""
        factors = [value for name, value in self.proved_numbers.items() if name.endswith("_factor")]
        slowest = max(factors, default=DECAYED)
        decay_a_sample = np.log(slowest)
        samples_to_decay = np.log(DECAYED) / decay_a_sample
        samples = int(np.ceil(samples_to_decay))
        limited_samples = np.clip(samples, SHORTEST, LONGEST)
        return int(limited_samples)

    def to_c(self, path: str | Path, real: str = "double") -> Path:
        """Write the controller as C99 source code with a header and a program that replays
        measurements. The header is `path`.

        `real` is "double" or "float". Raises `BadRequest` where no gains were found.
        """
        path = read_path("path", path)
        digest = certificate_digest(self.certificates.to_json())
        rows = self.summary()
        lines = [f"{name}: {value}" for name, value in rows.items()]
        sources = render_bilinear_c(self.controller, path.stem, real, lines, digest)
        for name, text in sources.items():
            (path.parent / name).write_text(text, encoding="utf-8")
        return path

    def save(self, folder: str | Path) -> Path:
        """Save model, gains and certificates in a new folder, which `ssm-study verify` and
        `st.load` read. Raises `BadRequest` for a folder that exists."""
        folder = read_path("folder", folder)
        exists = folder.exists()
        require(not exists, "to", folder, "exists", "name a new folder")
        folder.mkdir(parents=True)
        channels = [[channel.name, channel.unit] for channel in self.channels]
        model_content = self.model.to_json()
        contents = {MODEL: model_content, CHANNELS: channels}
        for name, content in contents.items():
            text = json.dumps(content, indent=1, allow_nan=False)
            (folder / name).write_text(text + "\n", encoding="utf-8")
        self.certificates.save(folder / CERTIFICATE)
        return folder

    @classmethod
    def load(cls, folder: Path) -> "RestDesign":
        """Load a saved design for a bilinear model. Raises `BadRequest` where its claims do not
        hold."""
        refuse_foreign_files(folder)
        model = model_from_json(read_json(folder / MODEL))
        content = read_json(folder / CERTIFICATE)
        broken = failed_bilinear_checks(content, model)
        remedy = "`ssm-study verify` names every claim"
        failures = "; ".join(broken)
        require(not broken, "design", folder, failures, remedy)
        channels = [Channel(name=name, unit=unit) for name, unit in read_json(folder / CHANNELS)]
        certificates = BilinearDesign.from_json(content)
        assert isinstance(model, Bilinear)  # the checks refuse others
        channel_tuple = tuple(channels)
        return cls(model=model, certificates=certificates, channels=channel_tuple)

    def summary(self) -> pd.Series:
        """Table of what is proved for a controller of a bilinear model, as text."""
        model = self.model
        lines: dict[str, Any] = {"model": f"{model.order} states, {len(model.nodes)} nodes"}
        end_nodes = model.nodes[[0, -1], None]
        end_inputs = model.scale.physical_input(end_nodes)
        ends = end_inputs[:, 0]
        lines["input stays within"] = f"{ends[0]:.4g} to {ends[1]:.4g}"
        lines["comes to rest"] = PROVED[self.certified]
        for label, reason in self.certificates.reasons.items():
            lines[f"not proved: {MODEL_WORDS.get(label, 'any loop')}"] = reason
        for label, part in self.certificates.parts.items():
            lines[MODEL_WORDS[label]] = self._describe_certificate(part)
        return pd.Series(lines, name="design", dtype=object)

    def _describe_certificate(self, part: Any) -> str:
        """Text on the contraction factor that a certificate proves and the states for which the
        factor holds."""
        ten_thousandths = np.ceil(part.factor * 1e4)
        factor = ten_thousandths / 1e4
        words = f"to {factor:.4f} of its distance or less in each sample"
        if not hasattr(part, "radius"):
            return words
        lowest, highest = equilibrium_input_range(self.model, part)
        end_nodes = np.array([[lowest], [highest]])
        end_inputs = self.model.scale.physical_input(end_nodes)
        ends = end_inputs[:, 0]
        return f"{words}, from rest at inputs of {ends[0]:.4g} to {ends[1]:.4g}"

    def __repr__(self) -> str:
        return render_text_table("RestDesign", self.summary())

    def _repr_html_(self) -> str:
        """Render what is proved for the design as an HTML table for notebooks."""
        return html_table("RestDesign", self.summary())


def equilibrium_input_range(model: Bilinear, part: Any) -> tuple[float, float]:
    """Range of constant scaled inputs whose equilibria lie in the set of initial states that a
    certificate covers. The observer's estimate starts at zero."""
    ends = []
    for end in model.nodes[[0, -1]]:
        reached = 0.0
        levels = np.linspace(0.0, end, LEVELS)
        for v in levels[1:]:
            x = equilibrium_state(model, float(v))
            if x is None or certificate_norm(part, x) > part.radius:
                break
            reached = float(v)
        ends.append(reached)
    return ends[0], ends[1]


def equilibrium_state(model: Bilinear, v: float) -> Float[np.ndarray, "n"] | None:
    """Equilibrium state of a bilinear model under a constant scaled input; None if the model has no
    stable one."""
    level = np.array([v])
    weights = hat_functions(model.nodes, level)
    hats = weights[0]
    a = np.einsum("q,qij->ij", hats, model.a)
    eigenvalues = np.linalg.eigvals(a)
    moduli = np.abs(eigenvalues)
    if moduli.max() >= 1.0:
        return None
    identity = np.eye(model.order)
    input_vector = hats @ model.b
    equilibrium = np.linalg.solve(identity - a, input_vector)
    return np.asarray(equilibrium)


def certificate_norm(part: Any, x: Float[np.ndarray, "n"]) -> float:
    """Norm that decides whether an initial state lies in the set for which a certificate holds."""
    squared_state_norm = x @ part.p @ x
    norm = float(np.sqrt(squared_state_norm))
    if not hasattr(part, "m"):
        return norm
    squared_error_norm = x @ part.m @ x
    error_norm = float(np.sqrt(squared_error_norm))
    return norm + part.weight * error_norm


def holds_rest_design(folder: Path) -> bool:
    """Whether a folder holds a saved design for a bilinear model."""
    files = (MODEL, CERTIFICATE, CHANNELS)
    return all((folder / name).is_file() for name in files)


def foreign_files(folder: Path) -> list[str]:
    """Names of files in the folder of a saved design that the design itself did not write.

    A record of another run beside the design would be taken for the design's.
    """
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    own = {MODEL, CERTIFICATE, CHANNELS}
    return sorted(name for name in names if name not in own and not name.endswith((".c", ".h")))


def refuse_foreign_files(folder: Path) -> None:
    """Raise `BadRequest` where the folder of a saved design holds files that the design did not
    write."""
    names = foreign_files(folder)
    problem = f"{', '.join(names[:3])} belongs to no saved bilinear design"
    require(not names, "design", folder, problem, "take it out, or save the design again")
