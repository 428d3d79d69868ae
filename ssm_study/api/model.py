"""Identified models in Python: predictions, scores, poles and a summary."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Complex

from ssm_study.api.arguments import Values
from ssm_study.api.linearisation import (
    convert_to_continuous,
    linearise_model,
    tabulate_frequency_response,
)
from ssm_study.api.model_files import holds_saved_model, read_model_fields, write_model_files
from ssm_study.api.scoring import require_varying_outputs, simulate_given_record
from ssm_study.api.steps import judge_evidence, measure_model_error
from ssm_study.api.summaries import html_table, render_text_table, summarise_model
from ssm_study.api.systems import read_path
from ssm_study.bounds.metrics import model_bound_columns
from ssm_study.bounds.slopes import certified_balls
from ssm_study.data.arrays import (
    disturbance_array,
    require_consistent_time_indexes,
    signal_array_and_names,
)
from ssm_study.data.metrics import data_set_columns
from ssm_study.evidence.metrics import Judgement
from ssm_study.models.bilinear import Bilinear
from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.members import mean_output_of_models, member_columns
from ssm_study.models.metrics import fit_columns, model_size_columns
from ssm_study.models.structured import StructuredSSM, linearise_at_equilibrium
from ssm_study.models.warm_start import initial_state_columns, simulate_validation_and_test
from ssm_study.refusal import BadRequest, require
from ssm_study.robustness.mismatch import Mismatch
from ssm_study.signals import DataSet
from ssm_study.training.metrics import records_fit_percent, training_columns

if TYPE_CHECKING:
    import control as python_control

    from ssm_study.api.pictures.picture import Picture
    from ssm_study.training.metrics import Identification


@dataclass(frozen=True, kw_only=True, repr=False)
class Model:
    """Identified model with its training data, for use from Python. `y = simulate(u)`.

    `simulator` holds the numbers: a `StructuredSSM`, an `SSM`, or a baseline. `data` are the
    records with their parts. `facts` are a run's columns up to the model (`fit_test_percent`, ...).
    `overrides` are the words of a command that gives this model, `later_words` those about the
    design.
    """

    simulator: Simulator
    data: DataSet
    identification: "Identification"
    seed: int = 0
    overrides: tuple[str, ...] = ()
    later_words: tuple[str, ...] = ()

    @cached_property
    def result_columns(self) -> dict[str, Any]:
        """Numbers and texts on data and model, by the column names of the results table."""
        data = self.data
        validation, test = simulate_validation_and_test(self.simulator, data)
        training = self.identification
        facts = dict(data_set_columns(data))
        facts |= training_columns(training.seconds, training.ended)
        facts |= model_size_columns(self.simulator)
        fit_train_percent = records_fit_percent(self.simulator, data.training, data)
        facts |= {"fit_train_percent": fit_train_percent}
        facts |= fit_columns(validation, test)
        facts |= initial_state_columns(self.simulator, data, test)
        facts |= member_columns(training.members, data)
        if isinstance(self.simulator, SSM | StructuredSSM):
            facts |= model_bound_columns(self.simulator)
        return facts

    @cached_property
    def mismatch(self) -> Mismatch:
        """Model error that the records show, at each frequency and each amplitude of the input."""
        return measure_model_error(self.ssm, self.data)

    @cached_property
    def evidence(self) -> Judgement:
        """Findings that say whether the recorded data support statements about the plant."""
        return judge_evidence(self.ssm, self.data, self.mismatch)

    @property
    def ssm(self) -> SSM | StructuredSSM:
        """State-space form of an identified model, for which a controller can be certified."""
        if isinstance(self.simulator, SSM | StructuredSSM):
            return self.simulator
        kind = type(self.simulator).__name__
        problem = "has products of input and state, so that it is no linear or structured system"
        remedy = "use predict, score and st.control, or fit model=structured"
        is_bilinear = isinstance(self.simulator, Bilinear)
        require(not is_bilinear, "model", kind, problem, remedy)
        problem = "is a baseline: it can be scored, but no controller can be certified for it"
        raise BadRequest("model", kind, problem, "fit model=structured or ssm")

    @property
    def input_names(self) -> list[str]:
        """Names of the model's inputs, in order."""
        channels = self.data.inputs
        return [channel.name for channel in channels]

    @property
    def output_names(self) -> list[str]:
        """Names of the model's outputs, in order."""
        channels = self.data.outputs
        return [channel.name for channel in channels]

    @property
    def disturbance_names(self) -> list[str]:
        """Names of the model's measured disturbances, in order; empty if there are none."""
        channels = self.data.disturbances
        return [channel.name for channel in channels]

    def predict(self, u: Values, disturbance: Values | None = None) -> Values:
        """Simulate the model's outputs from its equilibrium for given inputs. Inputs `(T, m)` or
        `(T,)`, outputs `(T, p)`.

        With `model.members` the mean of the members' outputs; control stays with `simulator`.
        A frame or series in gives a frame out, with its index. Measured disturbances of the same
        length stay at their mean where they are not given. Raises `BadRequest` for a disturbance
        that the model was not fitted with, or of another length.
        """
        step_s = self.data.step_s
        require_consistent_time_indexes(u, None, step_s)
        channels = len(self.data.inputs)
        _, inputs = signal_array_and_names(u, "u", channels, self.input_names)
        samples = len(inputs)
        measured = disturbance_array(disturbance, self.disturbance_names, samples)
        members = self.identification.members or (self.simulator,)
        y = mean_output_of_models(members, inputs, measured)
        table_types = pd.DataFrame | pd.Series
        if not isinstance(u, table_types):
            return y
        return pd.DataFrame(y, index=u.index, columns=self.output_names)

    def score(
        self,
        u: Values,
        y: Values,
        disturbance: Values | None = None,
        *,
        start_up_samples: int | None = None,
    ) -> float:
        """Fit of the model's free run to measured outputs, in percent. `100 (1 - ||y - y_hat|| /
        ||y - mean||)`, as `facts["fit_test_percent"]` is measured.

        The record may begin in motion: its first `start_up_samples` (20, or what the data say) tell
        the initial state and are not scored. With 0 the run starts from equilibrium and all of it
        is scored. Raises `BadRequest` where the shapes differ, and for a record no longer than its
        start.
        """
        simulation = simulate_given_record(self, u, y, disturbance, start_up_samples)
        require_varying_outputs(simulation)
        return simulation.fit_percent

    def simulation_errors(
        self,
        u: Values,
        y: Values,
        disturbance: Values | None = None,
        *,
        start_up_samples: int | None = None,
    ) -> pd.DataFrame:
        """Errors of a free run: measured minus simulated outputs, one column for each output."""
        simulation = simulate_given_record(self, u, y, disturbance, start_up_samples)
        record = simulation.records[0]
        simulated = simulation.simulated[0]
        errors = record.y - simulated
        return pd.DataFrame(errors, columns=self.output_names)

    def eigenvalues(self) -> Complex[np.ndarray, "n"]:
        """Eigenvalues of the model after linearisation at its equilibrium."""
        state_space = linearise_at_equilibrium(self.ssm)
        eigenvalues = np.linalg.eigvals(state_space.a)
        return np.asarray(eigenvalues, dtype=complex)

    def to_control(self) -> "python_control.StateSpace":
        """Linearise the model at its equilibrium, as a discrete-time state space of python-control.

        `x+ = A x + B J_u u/s_u,  y = s_y J_y (C x + D J_u u/s_u)`, neurons by their slopes at rest
        within A, B, C, D. Raises `BadRequest` for a baseline, which has no state space.
        """
        return linearise_model(self.ssm)

    def to_continuous(self) -> "python_control.StateSpace":
        """Linearise the model at its equilibrium and convert it to continuous time.

        By the matrix logarithm of `[A B; 0 I]`. Raises `BadRequest` where a pole lies on the
        negative real axis or at zero, for then no such system of the same order exists.
        """
        return convert_to_continuous(self.to_control())

    def frequency_response(self, points: int = 200) -> pd.DataFrame:
        """Table of the model's frequency response at the equilibrium from each input to each
        output.

        Columns `input, output, frequency_rad_s, magnitude, phase_deg`; frequencies up to half the
        sampling rate.
        """
        system = self.to_control()
        return tabulate_frequency_response(system, self.input_names, self.output_names, points)

    def summary(self) -> pd.Series:
        """Table of the model's properties: class, size, fits, poles, slopes and evidence."""
        return summarise_model(self)

    def __repr__(self) -> str:
        return render_text_table("Model", self.summary())

    def _repr_html_(self) -> str:
        """Render the model's properties as an HTML table for notebooks."""
        return html_table("Model", self.summary())

    def plot(self) -> Any:
        """Draw measured and simulated outputs of the longest test record, with errors below.

        Returns the Matplotlib figure.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.free_run import free_run_picture
        from ssm_study.api.pictures.loop_response import channel_label

        data = self.data
        _, simulation = simulate_validation_and_test(self.simulator, data)
        lengths = [len(record) for record in data.test]
        longest = int(np.argmax(lengths))
        record = data.test[longest]
        simulated = {"model": simulation.simulated[longest]}
        labels = [channel_label(channel) for channel in data.outputs]
        start_up = data.start_up_samples
        picture = free_run_picture(record.time_s, record.y, simulated, labels, start_up)
        return draw_picture(picture)

    def bode(self) -> Any:
        """Draw the Bode plot of the model at its equilibrium, beside an estimate from the
        validation record.

        First input to first output. Returns the Matplotlib figure. The numbers of all channels:
        `frequency_response`.
        """
        from ssm_study.api.pictures.bode import bode_picture
        from ssm_study.api.pictures.drawing import draw_picture

        validation = self.data.validation
        record = max(validation, key=len)
        slopes = certified_balls(self.ssm).input
        unit = self.data.outputs[0].unit
        inputs = self.data.inputs
        units = (unit, inputs[0].unit)
        picture = bode_picture(self.ssm, record, slopes, units)
        return draw_picture(picture)

    def residuals(self) -> Any:
        """Draw the correlations of the simulation errors with themselves and with the input, on the
        test records.

        Returns the Matplotlib figure. The numbers: `simulation_errors`.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.residual_correlation import residual_correlation_picture

        data = self.data
        start = data.start_up_samples
        _, simulation = simulate_validation_and_test(self.simulator, data)
        pairs = zip(data.test, simulation.simulated, strict=True)
        errors = [record.y[start:] - simulated[start:] for record, simulated in pairs]
        inputs = [record.u[start:] for record in data.test]
        output_name = self.output_names[0]
        picture = residual_correlation_picture(errors, inputs, output_name, self.input_names)
        return draw_picture(picture)

    def poles(self) -> Any:
        """Draw the eigenvalues of the model at the equilibrium, together with the unit circle.

        Returns the Matplotlib figure. The numbers: `eigenvalues`.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.poles import poles_picture

        groups = {"model": self.eigenvalues()}
        picture = poles_picture(groups)
        return draw_picture(picture)

    def input_map(self) -> Any:
        """Draw the learned static map at the model's input and its slope, with the certified
        interval of slopes.

        Returns the Matplotlib figure. Raises `BadRequest` for several inputs.
        """
        from ssm_study.api.pictures.input_map import input_map_picture
        from ssm_study.api.pictures.loop_response import channel_label

        channel = self.data.inputs[0]
        label = channel_label(channel)
        slopes = certified_balls(self.ssm).input
        return draw_or_refuse("input_map", lambda: input_map_picture(self.ssm, slopes, label))

    def save(self, folder: str | Path) -> Path:
        """Write the model with its records into a new folder, from which `st.load` reads it again.

        `model.json` alone can be simulated without torch. Returns the folder. Raises `BadRequest`
        for a folder that exists.
        """
        folder = read_path("folder", folder)
        exists = folder.exists()
        require(not exists, "folder", folder, "exists", "name a new folder")
        folder.mkdir(parents=True)
        write_model_files(self, folder)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> "Model":
        """Load a model from the folder in which it was saved; its numbers are exactly the same.

        Raises `BadRequest` where there is none.
        """
        folder = read_path("folder", folder)
        problem = "holds no saved model"
        remedy = "name the folder that model.save wrote"
        is_saved_model = holds_saved_model(folder)
        require(is_saved_model, "folder", folder, problem, remedy)
        return cls(**read_model_fields(folder))


def draw_or_refuse(name: str, make_picture: Callable[[], "Picture"]) -> Any:
    """Draw a picture, or raise `BadRequest` with the reason where the picture would be empty."""
    from ssm_study.api.pictures.drawing import draw_picture
    from ssm_study.api.pictures.picture import EmptyPictureError

    try:
        picture = make_picture()
    except EmptyPictureError as reason:
        sentence = str(reason).rstrip(".")
        problem = sentence[:1].lower() + sentence[1:]
        raise BadRequest(name, "not drawn", problem, "draw another picture") from reason
    return draw_picture(picture)
