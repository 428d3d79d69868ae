"""Designed controllers in Python: certificates, predictions, closed loops and export."""

import json
import shutil
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Complex, Float

from ssm_study import save_as_run
from ssm_study.api.arguments import Values
from ssm_study.api.design_files import read_stored_design, write_export_records
from ssm_study.api.known_maps import refuse_unknown_maps, unknown_map_ranges, warn_of_unknown_maps
from ssm_study.api.loop_of_both import add_loop_verdict
from ssm_study.api.model import Model, draw_or_refuse
from ssm_study.api.scope_of_proof import refuse_picture_without_records
from ssm_study.api.scratch import make_scratch_folder
from ssm_study.api.summaries import html_table, render_text_table, summarise_design
from ssm_study.api.systems import read_channel_values, read_number, read_path
from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates.certificate import Design as Certificates
from ssm_study.evidence.metrics import withhold_predictions
from ssm_study.export import targets
from ssm_study.loop.regulation import IdentifiedPlant, LoopExperiment, has_direct_feedthrough
from ssm_study.models.identified import SSM
from ssm_study.models.structured import StructuredSSM
from ssm_study.refusal import BadRequest, require
from ssm_study.synthesis.deployed import RangeWithinLimits, prove_within_input_limits
from ssm_study.synthesis.expected_response import faster_response_column
from ssm_study.synthesis.loop_poles import eigenvalue_groups
from ssm_study.synthesis.measured_discs_run import coverage_columns
from ssm_study.synthesis.metrics import design_columns, proof_columns
from ssm_study.synthesis.withheld_coverage import withhold_coverage

if TYPE_CHECKING:
    import control as python_control

    from ssm_study.plants.plant import Plant

STARTS = (-1.0, 1.0)  # from where a loop is drawn unless it is told, in output scales


@dataclass(frozen=True, kw_only=True, repr=False)
class Design:
    """Certified controller with its observer, for use from Python. `u = K xh`.

    `certificate` holds `state_feedback` and `observer` with their gains and matrices, at the rates
    that were requested or chosen. The printed rates are the largest proved of these gains:
    `certificate.certified_rate("state_feedback")`, with their matrices in
    `certificate.certificates_by_name["state_feedback_deployed"]` and `["observer_deployed"]` where
    they are larger. `model` is what is certified. `origin` is the identified model it was designed
    for, None for a bare system or a design that was loaded, which lies in `run_folder`.
    """

    certificate: Certificates
    model: SSM | StructuredSSM
    origin: Model | None = None
    run_folder: Path | None = None
    overrides: tuple[str, ...] = ()
    loop: LoopExperiment | None = None
    loop_seed: int = 0
    stored_record: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path) -> "Design":
        """Load the controller of a run folder or of a saved design.

        Raises `BadRequest` where the folder has no controller, and where its certificates or its
        record are not as they were written.
        """
        stored = read_stored_design(folder)
        return cls(run_folder=folder, **stored)

    @cached_property
    def folder(self) -> Path:
        """Folder that holds the files of a design, from which its controller is exported."""
        return self.run_folder or self._write_files(make_scratch_folder())

    def _write_files(self, folder: Path) -> Path:
        """Write model, certificates and signal ranges of a design into a folder."""
        content = json.dumps(self.model.to_json(), indent=1, allow_nan=False)
        (folder / "model.json").write_text(content + "\n", encoding="utf-8")
        self.certificate.save(folder / "certificate.json")
        if self.origin is not None:
            write_export_records(self.origin.data, folder)
        return folder

    @property
    def certified(self) -> bool:
        """Whether exact arithmetic confirms the certificates of controller, observer and closed
        loop of a design."""
        return all(self.verdicts.values())

    @property
    def verdicts(self) -> dict[str, bool]:
        """Whether the controller, the observer and the closed loop are certified in exact
        arithmetic.

        The loop is certified where both sides are and the observer computes the plant's own maps;
        it cannot where `unknown_maps` has an entry, and such a design is not exported.
        """
        sides = self.certificate.certificates_by_name
        verdicts = {"controller": sides["state_feedback"].certified}
        verdicts["observer"] = sides["observer"].certified
        return add_loop_verdict(verdicts, self.unknown_maps)

    @cached_property
    def unknown_maps(self) -> dict[str, str]:
        """Static maps, such as an input nonlinearity, that are known only by their range of
        slopes."""
        is_identified = self.origin is not None or bool(self.stored_record)
        if is_identified:
            return {}
        return unknown_map_ranges(self.model, self.certificate)

    @cached_property
    def result_columns(self) -> dict[str, Any]:
        """Numbers and texts on a design, by the column names of the results table: rates, limits,
        gains, predictions.

        A bare system has no records, hence no predictions; a loaded design has its run's columns.
        """
        if self.origin is None:
            return dict(self.stored_record) or proof_columns(self.certificate)
        balls = certified_balls(self.model)
        mismatch = self.origin.mismatch
        facts = design_columns(self.certificate, self.model, balls, mismatch)
        facts |= self._coverage_columns()
        data = self.origin.data
        facts |= faster_response_column(
            self.certificate,
            self.model,
            self.origin.mismatch,
            data.validation,
            data.mismatch_records,
        )
        evidence = self.origin.evidence
        if self.certificate.feasible:
            facts = withhold_coverage(facts, self.model, self.certificate.gain_pair)
        facts = withhold_predictions(facts, evidence.level)
        facts |= {"evidence": evidence.level, "evidence_reasons": evidence.reasons}
        return facts

    def _coverage_columns(self) -> dict[str, Any]:
        """Columns of the results table that say how far the proof covers the model error in the
        records."""
        from ssm_study.api.steps import measure_error_to_cover
        from ssm_study.robustness.coverage import measure_error_spectra

        assert self.origin is not None
        data = self.origin.data
        mismatch = self.origin.mismatch
        spectra = measure_error_to_cover(self.model, data, mismatch)
        fresh = measure_error_spectra(self.model, data.test, mismatch, data.start_up_samples, ())
        return coverage_columns(self.certificate, self.model, spectra, fresh)

    @cached_property
    def record(self) -> dict[str, Any]:
        """Values of all columns of the results table for a design. A loaded design has those of its
        run; the design of a bare system has those of `result_columns`."""
        if self.origin is None:
            return dict(self.result_columns)
        facts = self.origin.result_columns
        return facts | self.result_columns | self._loop_columns()

    def _loop_columns(self) -> dict[str, Any]:
        """Columns of the results table on the closed loop with the identified model."""
        from ssm_study.loop.metrics import behaviour_columns, certified_bound_columns

        assert self.origin is not None
        if self.loop is None or not self.certificate.feasible or has_direct_feedthrough(self.model):
            return {}
        data = self.origin.data
        twin = IdentifiedPlant.from_model(self.model, data.inputs, data.outputs)
        loop = self.loop.with_default_limits(data.training_inputs).with_default_horizon(self.model)
        runs = loop.run_design(twin, self.model, self.certificate, self.loop_seed)
        return (
            {"loop_on": "identified model"}
            | behaviour_columns(runs)
            | certified_bound_columns(runs, self.certificate)
        )

    def eigenvalues(self) -> dict[str, Complex[np.ndarray, "n"]]:
        """Eigenvalues, at the equilibrium, of the model, of the controlled model and of the
        estimation error.

        Per sample, with the slopes of the maps and of the neurons at rest.
        """
        gains = self.certificate.gain_pair
        return eigenvalue_groups(self.model, gains)

    def within_limits(self, lower: Values, upper: Values) -> RangeWithinLimits:
        """Proved properties of the closed loop while the input stays within given limits.

        Raises `BadRequest` for a model with neurons, about which nothing is proved within limits.
        """
        if not isinstance(self.model, SSM):
            problem = "has neurons, and the theorems on input limits hold only without them"
            raise BadRequest("model", type(self.model).__name__, problem, "fit model=ssm")
        limits = (("lower", lower), ("upper", upper))
        inputs = self.model.scale.inputs
        ends = [read_channel_values(name, limit, inputs) for name, limit in limits]
        return prove_within_input_limits(self.model, self.certificate, *ends)

    def to_c(self, path: str | Path, real: str = "double") -> Path:
        """Write the controller as C99 source code with a header and a program that replays
        recorded signals. The header is `path`.

        `real` is "double" or "float". Raises `BadRequest` where there is no controller, and where
        the observer cannot compute the plant's maps (`unknown_maps`).
        """
        refuse_unknown_maps(self.unknown_maps)
        path = read_path("path", path)
        name = path.stem if self.run_folder is None else ""
        sources = targets.render_c_sources(self.folder, real=real, prefix=path.stem, name=name)
        for name, text in sources.items():
            (path.parent / name).write_text(text, encoding="utf-8")
        return path

    def to_control(self) -> "python_control.NonlinearIOSystem":
        """Controller as a python-control system from measured outputs to inputs, without input
        limits.

        Raises `BadRequest` as `to_c` does.
        """
        refuse_unknown_maps(self.unknown_maps)
        return targets.as_python_control(self.folder)

    def save(self, folder: str | Path) -> Path:
        """Save a design as a run folder, which can be verified, exported and loaded. `ssm-study
        verify`, `export` and `st.load` read it.

        Raises `BadRequest` for a folder that exists, and as `to_c` does for a design with
        `unknown_maps`.
        """
        refuse_unknown_maps(self.unknown_maps)
        folder = read_path("folder", folder)
        require(not folder.exists(), "to", folder, "exists", "name a new folder")
        if self.run_folder is not None:
            return Path(shutil.copytree(self.run_folder, folder))
        if self.origin is None:
            folder.mkdir(parents=True)
            return self._write_files(folder)
        saved: Path = save_as_run(self, folder)
        return saved

    def summary(self) -> pd.Series:
        """Table of what is proved and what is predicted of the design."""
        return summarise_design(self)

    def __repr__(self) -> str:
        return render_text_table("Design", self.summary())

    def _repr_html_(self) -> str:
        """Render the design's properties as an HTML table for notebooks."""
        return html_table("Design", self.summary())

    def plot(self, y0: Values | None = None, *, plant: "Plant | None" = None) -> Any:
        """Draw outputs and inputs of the closed loop from given initial outputs, beside the
        response without control.

        By default from one output scale above and below the equilibrium, on the identified model or
        on `plant`; dashed is the range of the recorded inputs. Returns the Matplotlib figure.
        """
        from ssm_study.api.loops import choose_plant, simulate_loop
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.loop_response import initial_response_picture
        from ssm_study.loop.controller import NoControl

        warn_of_unknown_maps(self.unknown_maps)
        on = choose_plant(self, plant)
        scale = self.model.scale
        if y0 is None:
            outer_product = np.outer(STARTS, scale.output_scale)
            y0 = scale.output_equilibrium + outer_product
        controlled = simulate_loop(self, y0, on)
        controller = NoControl.for_plant(on)
        uncontrolled = simulate_loop(self, y0, on, controller=controller)
        picture = initial_response_picture(
            controlled, uncontrolled, on, self._recorded_inputs, self._describe_loop_plant(plant)
        )
        return draw_picture(picture)

    def step(self, size: float | None = None, *, plant: "Plant | None" = None) -> Any:
        """Draw the closed loop's response to a step of the set point. The step has the given
        `size`.

        The step is known in advance: with a linear model the input moves before the step. In the
        output's unit; by default half the output's scale, or less where the recorded inputs cannot
        hold so much. Returns the Matplotlib figure. Raises `BadRequest` for a step that no input
        holds.
        """
        from ssm_study.api.loops import choose_plant
        from ssm_study.api.pictures.loop_response import set_point_picture

        warn_of_unknown_maps(self.unknown_maps)
        if size is not None:
            size = read_number("size", size)
        on = choose_plant(self, plant)
        loop = LoopExperiment().with_default_horizon(self.model)
        recorded = self._recorded_inputs
        if recorded:
            scale = self.model.scale
            loop = loop.with_default_limits(scale.append_equilibrium_input(recorded))
        place = self._describe_loop_plant(plant)
        return draw_or_refuse(
            "step",
            lambda: set_point_picture(
                on, self.certificate, self.model, loop, recorded, place, size
            ),
        )

    def margin_plot(self) -> Any:
        """Draw the stability margin over frequency for every recorded amplitude of the input.

        A dot marks the smallest margin. Returns the Matplotlib figure. Raises `BadRequest` for a
        design without records.
        """
        from ssm_study.api.pictures.margin import margin_picture, physical_input_scale
        from ssm_study.robustness.margin_by_frequency import margin_curves

        origin = self._model_with_records()
        balls = certified_balls(self.model)
        pair = self.certificate.gain_pair
        curves = margin_curves(self.model, pair, balls, origin.mismatch)
        margin = self.result_columns.get("resolved_margin")
        scale = physical_input_scale(self.model, origin.data.inputs[0].unit)
        return draw_or_refuse(
            "margin_plot", lambda: margin_picture(curves, self.model.step_s, margin, scale)
        )

    def coverage_plot(self) -> Any:
        """Draw the coverage (tolerated model error divided by the measured one) for each frequency
        band.

        Returns the Matplotlib figure. Raises `BadRequest` for a design without records, and where
        nothing is covered for want of a proof.
        """
        from ssm_study.api.pictures.coverage import coverage_picture
        from ssm_study.api.pictures.margin import physical_input_scale
        from ssm_study.api.steps import measure_error_to_cover

        origin = self._model_with_records()
        spectra = measure_error_to_cover(self.model, origin.data, origin.mismatch)
        step_s = self.model.step_s
        scale = physical_input_scale(self.model, origin.data.inputs[0].unit)
        return draw_or_refuse(
            "coverage_plot", lambda: coverage_picture(self.certificate, spectra, step_s, scale)
        )

    def nyquist(self) -> Any:
        """Draw the Nyquist curve of the control loop, with discs for the measured model error.

        Returns the Matplotlib figure. Raises `BadRequest` for several inputs or outputs.
        """
        from ssm_study.api.pictures.nyquist import nyquist_picture

        warn_of_unknown_maps(self.unknown_maps)
        mismatch = None if self.origin is None else self.origin.mismatch
        return draw_or_refuse(
            "nyquist", lambda: nyquist_picture(self.model, self.certificate.gain_pair, mismatch)
        )

    def poles(self) -> Any:
        """Draw the eigenvalues of model, controlled model and estimation error in the unit circle.

        The inner circle is the factor per sample of the certified rate. Returns the Matplotlib
        figure. The numbers: `eigenvalues`.
        """
        from ssm_study.api.pictures.drawing import draw_picture
        from ssm_study.api.pictures.poles import poles_picture

        warn_of_unknown_maps(self.unknown_maps)
        rate = self.certificate.certified_rate("state_feedback")
        picture = poles_picture(self.eigenvalues(), rate)
        return draw_picture(picture)

    @property
    def _recorded_inputs(self) -> list[Float[np.ndarray, "T m"]]:
        """Inputs of the training records of a design's model; empty for a model without records."""
        return [] if self.origin is None else [record.u for record in self.origin.data.training]

    def _describe_loop_plant(self, plant: "Plant | None") -> str:
        """Text that says on which plant or model a closed loop was simulated."""
        if plant is not None:
            return "the simulated plant"
        is_identified = self.origin is not None or bool(self.stored_record)
        if self.unknown_maps:
            return "the given model with slopes in the middle of their range"
        return "the identified model" if is_identified else "the given model"

    def _model_with_records(self) -> Model:
        """Identified model of the design; raises `BadRequest` if it has no records."""
        refuse_picture_without_records(self.origin, self.run_folder)
        assert self.origin is not None
        return self.origin
