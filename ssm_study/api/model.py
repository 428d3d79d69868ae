"""An identified model as Python users hold it: predictions, scores, poles, and a summary."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Complex, Float

from ssm_study.api.steps import judge_evidence, measure_mismatch
from ssm_study.bounds.metrics import bound_facts
from ssm_study.bounds.slopes import certified_balls
from ssm_study.data.arrays import check_time_index, disturbance_values, signal_columns
from ssm_study.data.metrics import data_columns
from ssm_study.evidence.metrics import Judgement
from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.members import mean_output, member_facts
from ssm_study.models.metrics import fit_facts, size_facts
from ssm_study.models.structured import StructuredSSM, at_rest
from ssm_study.models.warm_start import simulate_parts, start_facts
from ssm_study.refusal import BadRequest, require
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import DataSet, fit_percent
from ssm_study.training.metrics import mean_fit, training_facts

if TYPE_CHECKING:
    import control as python_control

    from ssm_study.api.pictures.picture import Picture
    from ssm_study.training.metrics import Identification

Values = Float[np.ndarray, "..."] | pd.Series | pd.DataFrame | list[float]


@dataclass(frozen=True, kw_only=True, repr=False)
class Model:
    """Model identified from records, `y = simulate(u)`, in physical units.

    `simulator` holds the numbers: a `StructuredSSM`, an `SSM`, or a baseline. `data` are the
    records with their parts. `facts` are the columns that a run's table has up to the model
    (`fit_test_percent`, `input_slope_lower`, ...). `overrides` are the command's words for it,
    `later_words` those among them that speak of the design.
    """

    simulator: Simulator
    data: DataSet
    identification: "Identification"
    seed: int = 0
    overrides: tuple[str, ...] = ()
    later_words: tuple[str, ...] = ()

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Columns of the record that describe data and model."""
        data = self.data
        validation, test = simulate_parts(self.simulator, data)
        training = self.identification
        facts = dict(data_columns(data))
        facts |= training_facts(training.seconds, training.ended)
        facts |= size_facts(self.simulator)
        facts |= {"fit_train_percent": mean_fit(self.simulator, data.training, data)}
        facts |= fit_facts(validation, test)
        facts |= start_facts(self.simulator, data, test)
        facts |= member_facts(training.members, data)
        if isinstance(self.simulator, SSM | StructuredSSM):
            facts |= bound_facts(self.simulator)
        return facts

    @cached_property
    def mismatch(self) -> Mismatch:
        """Error of the model at each frequency and amplitude, as the records show it."""
        return measure_mismatch(self.ssm, self.data)

    @cached_property
    def evidence(self) -> Judgement:
        """Judgement of what the records allow to be said of the plant: `level` and `reasons`."""
        return judge_evidence(self.ssm, self.data, self.mismatch)

    @property
    def ssm(self) -> SSM | StructuredSSM:
        """State-space model that can be certified. Raises `BadRequest` for a baseline."""
        if isinstance(self.simulator, SSM | StructuredSSM):
            return self.simulator
        kind = type(self.simulator).__name__
        problem = "a baseline is scored only, nothing is certified of it"
        raise BadRequest("model", kind, problem, "fit model=structured or ssm")

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs, in order."""
        return [channel.name for channel in self.data.inputs]

    @property
    def output_names(self) -> list[str]:
        """Names of the outputs, in order."""
        return [channel.name for channel in self.data.outputs]

    @property
    def disturbance_names(self) -> list[str]:
        """Names of the measured disturbances, in order. None where there are none."""
        return [channel.name for channel in self.data.disturbances]

    def predict(self, u: Values, disturbance: Values | None = None) -> Values:
        """Simulate outputs `(T, p)` from the equilibrium for inputs `(T, m)` or `(T,)`.

        With `model.members` the mean of the members' outputs; control stays with `simulator`.
        A frame or series in gives a frame out, with its index. Measured disturbances of the same
        length stay at their mean where they are not given. Raises `BadRequest` for a disturbance
        that the model was not fitted with, or of another length.
        """
        check_time_index(u, None, self.data.step_s)
        inputs = signal_columns(u, "u", len(self.data.inputs), self.input_names)[1]
        measured = disturbance_values(disturbance, self.disturbance_names, len(inputs))
        members = self.identification.members or (self.simulator,)
        y = mean_output(members, inputs, measured)
        if not isinstance(u, pd.DataFrame | pd.Series):
            return y
        return pd.DataFrame(y, index=u.index, columns=self.output_names)

    def score(self, u: Values, y: Values, disturbance: Values | None = None) -> float:
        """Fit of a free run from the equilibrium, `100 (1 - ||y - y_hat|| / ||y - mean(y)||)` in
        percent.

        Raises `BadRequest` where the shapes differ.
        """
        measured, predicted = self._measured_and_predicted(u, y, disturbance)
        moves = bool(np.ptp(measured, axis=0).any())
        problem = "is constant, and the score compares the error with its deviation from the mean"
        require(moves, "y", "one value", problem, "score a record in which it moves")
        return fit_percent(measured, predicted)

    def simulation_errors(
        self, u: Values, y: Values, disturbance: Values | None = None
    ) -> pd.DataFrame:
        """Measured minus simulated outputs of a free run, one column per output."""
        measured, predicted = self._measured_and_predicted(u, y, disturbance)
        return pd.DataFrame(measured - predicted, columns=self.output_names)

    def _measured_and_predicted(
        self, u: Values, y: Values, disturbance: Values | None
    ) -> tuple[Float[np.ndarray, "T p"], Float[np.ndarray, "T p"]]:
        """Measured and simulated outputs of one record."""
        check_time_index(u, y, self.data.step_s)
        measured = signal_columns(y, "y", columns=self.output_names)[1]
        predicted = np.asarray(self.predict(u, disturbance), dtype=np.float64)
        problem = f"the model answers with {predicted.shape}"
        remedy = "give the outputs of this input"
        require(measured.shape == predicted.shape, "y", measured.shape, problem, remedy)
        return measured, predicted

    def eigenvalues(self) -> Complex[np.ndarray, "n"]:
        """Eigenvalues of the model linearised at its equilibrium, per sample."""
        return np.asarray(np.linalg.eigvals(at_rest(self.ssm).a), dtype=complex)

    def to_control(self) -> "python_control.StateSpace":
        """Linearise at the equilibrium, as python-control's state space of physical deviations.

        `x+ = A x + B J_u u/s_u,  y = s_y J_y (C x + D J_u u/s_u)`, neurons by their slopes at rest
        within A, B, C, D. Raises `BadRequest` for a baseline, which has no state space.
        """
        python_control = import_python_control("to_control")
        model = self.ssm
        linear = at_rest(model)
        input_slope = model.scaffold_in.jacobian(np.zeros(model.scaffold_in.inputs))
        output_slope = model.scaffold_out.jacobian(np.zeros(model.scaffold_out.inputs))
        inward = input_slope / model.scale.input_scale
        outward = model.scale.output_scale[:, None] * output_slope
        b = linear.b @ inward
        c = outward @ linear.c
        d = outward @ linear.d @ inward
        return python_control.StateSpace(linear.a, b, c, d, model.step_s)

    def to_continuous(self) -> "python_control.StateSpace":
        """Linearise, and undo the sampling: the continuous system whose input is held.

        By the matrix logarithm of `[A B; 0 I]`. Raises `BadRequest` where a pole lies on the
        negative real axis or at zero, for then no such system of the same order exists.
        """
        import scipy

        python_control = import_python_control("to_continuous")
        discrete = self.to_control()
        poles = np.linalg.eigvals(discrete.A)
        on_axis = (poles.real <= 0) & (np.abs(poles.imag) < 1e-12)
        problem = f"a pole at {poles[on_axis][0].real:.3g}" if on_axis.any() else ""
        remedy = "use the discrete system, to_control()"
        require(not on_axis.any(), "model", "linearised", problem, remedy)
        n, m = discrete.B.shape
        held = np.block([[discrete.A, discrete.B], [np.zeros((m, n)), np.eye(m)]])
        logarithm = np.real(scipy.linalg.logm(held)) / self.data.step_s
        a = logarithm[:n, :n]
        b = logarithm[:n, n:]
        return python_control.StateSpace(a, b, discrete.C, discrete.D)

    def frequency_response(self, points: int = 200) -> pd.DataFrame:
        """Frequency response at the equilibrium from each input to each output, physical units.

        Columns `input, output, frequency_rad_s, magnitude, phase_deg`; frequencies up to half the
        sampling rate.
        """
        system = self.to_control()
        nyquist = np.pi / self.data.step_s
        omega = np.geomspace(nyquist * 1e-4, nyquist, points)
        z = np.exp(1j * omega * self.data.step_s)
        identity = np.eye(len(system.A))
        resolvent = np.linalg.inv(z[:, None, None] * identity - system.A)
        response = system.C @ resolvent @ system.B + system.D
        rows = []
        for i, output in enumerate(self.output_names):
            for j, name in enumerate(self.input_names):
                channel = response[:, i, j]
                rows.append(
                    pd.DataFrame(
                        {
                            "input": name,
                            "output": output,
                            "frequency_rad_s": omega,
                            "magnitude": np.abs(channel),
                            "phase_deg": np.rad2deg(np.unwrap(np.angle(channel))),
                        }
                    )
                )
        return pd.concat(rows, ignore_index=True)

    def summary(self) -> pd.Series:
        """Table of the model's properties: class, size, fits, poles, slopes, evidence."""
        facts = self.facts
        lines: dict[str, Any] = {
            "class": type(self.simulator).__name__,
            "inputs": ", ".join(map(_name_with_unit, self.data.inputs)),
            "outputs": ", ".join(map(_name_with_unit, self.data.outputs)),
            "measured disturbances": ", ".join(map(_name_with_unit, self.data.disturbances)),
            "sampling time": f"{self.data.step_s:g} s",
            "samples": _samples(self.data),
            "fit on the training records": f"{facts['fit_train_percent']:.1f} %",
            "fit on the validation records": f"{facts['fit_validation_percent']:.1f} %",
            "fit on the test records": f"{facts['fit_test_percent']:.1f} %",
        }
        if "members" in facts:
            fit = facts["fit_test_members_percent"]
            words = f"{facts['members']} models, fit on the test records {fit:.1f} %"
            lines["mean that predicts"] = words
        if self.identification.chosen:
            lines["chosen by the records"] = self.identification.chosen
        if not self.data.disturbances:
            del lines["measured disturbances"]
        if isinstance(self.simulator, SSM | StructuredSSM):
            slowest = np.abs(self.eigenvalues()).max()
            lines["states"] = self.simulator.order
            lines["neurons"] = facts.get("neurons", 0)
            lines["slowest pole"] = f"{slowest:.4f} per sample"
            lower = facts.get("input_slope_lower")
            upper = facts.get("input_slope_upper")
            if lower is not None and upper is not None:
                lines["slopes of the input map"] = f"{lower:.3g} to {upper:.3g}"
            lines["evidence"] = self.evidence.level
        return pd.Series(lines, name="model", dtype=object)

    def __repr__(self) -> str:
        width = max(map(len, self.summary().index))
        rows = [f"  {name:<{width}}  {value}" for name, value in self.summary().items()]
        return "\n".join(["Model", *rows])

    def _repr_html_(self) -> str:
        return html_table("Model", self.summary())

    def plot(self) -> Any:
        """Draw measured and simulated outputs of the longest test record, errors below.

        Returns the Matplotlib figure.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.free_run import free_run_picture
        from ssm_study.api.pictures.loop_response import label_of

        data = self.data
        _, simulation = simulate_parts(self.simulator, data)
        longest = int(np.argmax([len(record) for record in data.test]))
        record = data.test[longest]
        simulated = {"model": simulation.simulated[longest]}
        labels = [label_of(channel) for channel in data.outputs]
        start_up = data.start_up_samples
        return draw_picture(free_run_picture(record.time_s, record.y, simulated, labels, start_up))

    def bode(self) -> Any:
        """Draw gain and phase at the equilibrium, beside what the validation record shows.

        First input to first output. Returns the Matplotlib figure. The numbers of all channels:
        `frequency_response`.
        """
        from ssm_study.api.pictures.bode import bode_picture
        from ssm_study.api.pictures.drawing import draw_picture

        record = max(self.data.validation, key=len)
        slopes = certified_balls(self.ssm).input
        units = (self.data.outputs[0].unit, self.data.inputs[0].unit)
        return draw_picture(bode_picture(self.ssm, record, slopes, units))

    def residuals(self) -> Any:
        """Draw the correlations of the test records' residuals with themselves and the input.

        Returns the Matplotlib figure. The numbers: `simulation_errors`.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.residual_correlation import residual_correlation_picture

        data = self.data
        start = data.start_up_samples
        _, simulation = simulate_parts(self.simulator, data)
        pairs = zip(data.test, simulation.simulated, strict=True)
        errors = [record.y[start:] - simulated[start:] for record, simulated in pairs]
        inputs = [record.u[start:] for record in data.test]
        return draw_picture(
            residual_correlation_picture(errors, inputs, self.output_names[0], self.input_names)
        )

    def poles(self) -> Any:
        """Draw the eigenvalues at the equilibrium in the unit circle.

        Returns the Matplotlib figure. The numbers: `eigenvalues`.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.poles import poles_picture

        return draw_picture(poles_picture({"model": self.eigenvalues()}))

    def input_map(self) -> Any:
        """Draw the learned input map and its slope within the interval that is certified.

        Returns the Matplotlib figure. Raises `BadRequest` for several inputs.
        """
        from ssm_study.api.pictures.input_map import input_map_picture
        from ssm_study.api.pictures.loop_response import label_of

        label = label_of(self.data.inputs[0])
        slopes = certified_balls(self.ssm).input
        return draw_or_refuse("input_map", lambda: input_map_picture(self.ssm, slopes, label))

    def save(self, folder: str | Path) -> Path:
        """Write `model.json`, complete enough to simulate the model without torch.

        Returns the folder. Raises `BadRequest` for a folder that exists.
        """
        folder = Path(folder)
        require(not folder.exists(), "folder", folder, "exists", "name a new folder")
        folder.mkdir(parents=True)
        content = json.dumps(self.simulator.to_json(), indent=1, allow_nan=False)
        (folder / "model.json").write_text(content + "\n", encoding="utf-8")
        return folder


def import_python_control(function: str) -> Any:
    """Import python-control. Raises `BadRequest` where it is not installed."""
    try:
        import control
    except ImportError as error:
        remedy = "pip install 'ssm-study[export]'"
        raise BadRequest(function, "control", "is not installed", remedy) from error
    return control


def draw_or_refuse(name: str, make: Callable[[], "Picture"]) -> Any:
    """Draw a picture, or raise `BadRequest` where there is nothing to show. Raises `BadRequest`
    with the reason where there is none."""
    from ssm_study.api.pictures.drawing import draw_picture
    from ssm_study.api.pictures.picture import NothingToShow

    try:
        picture = make()
    except NothingToShow as reason:
        remedy = "look at the other pictures"
        raise BadRequest(name, "there is no picture", str(reason).rstrip("."), remedy) from reason
    return draw_picture(picture)


def _name_with_unit(channel: Any) -> str:
    """Name of a channel, its unit in parentheses where there is one."""
    return f"{channel.name} ({channel.unit})" if channel.unit else channel.name


def _samples(data: DataSet) -> str:
    """Words on the numbers of samples in training, validation and test."""
    parts = ("training", "validation", "test")
    counts = [sum(len(record) for record in getattr(data, part)) for part in parts]
    return ", ".join(f"{count} {part}" for count, part in zip(counts, parts, strict=True))


def html_table(title: str, summary: pd.Series) -> str:
    """Render a summary as an HTML table for notebooks."""
    rows = [
        f"<tr><th style='text-align:left'>{escape(str(name))}</th>"
        f"<td style='text-align:left'>{escape(str(value))}</td></tr>"
        for name, value in summary.items()
    ]
    return f"<table><caption>{escape(title)}</caption>{''.join(rows)}</table>"
