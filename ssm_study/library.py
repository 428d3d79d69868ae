"""From arrays to a controller in five lines: the steps of `ssm-study run`, called from Python.

    model = st.fit(u, y, step_s)
    design = st.control(model)
    design.to_c("controller.h")

Further arguments are the overrides of the command, as texts (`"model.order=4"`), with the command's
refusals. Arrays
are stored as a log under `results_dir`, and every stage is kept there: what is known is not
computed again, and
`ssm-study run` with `design.overrides` makes the same run. By default `results_dir` is deleted when
the program ends.
"""

import atexit
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from omegaconf import DictConfig

from ssm_study.bounds.slopes import certified_balls
from ssm_study.certificates import certificate
from ssm_study.cli import run as command
from ssm_study.cli.hydra_errors import advised
from ssm_study.cli.request import quoted
from ssm_study.data.arrays import logged, signal
from ssm_study.engine.records import FAILED, read_record
from ssm_study.engine.settings import plain
from ssm_study.engine.task import store_of
from ssm_study.export import targets
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.regulation import IdentifiedPlant
from ssm_study.models.identified import SSM, Simulator
from ssm_study.models.structured import StructuredSSM, at_rest
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest, positive, require
from ssm_study.signals import DataSet, fit_percent
from ssm_study.study import line
from ssm_study.study.specification import Specification
from ssm_study.study.stages import ModelRun, write_json
from ssm_study.synthesis.deployed import WithinLimits, within_limits
from ssm_study.systems import StateSpace
from ssm_study.table.gather import gather

if TYPE_CHECKING:
    import control as python_control

Values = Float[np.ndarray, "..."] | pd.Series | pd.DataFrame | Sequence[float]
Signals = Values | Sequence[Values]
OF_THE_MODEL = (
    "data",
    "model",
    "training",
    "reduction",
    "seed",
)  # what a request for a controller may not change


@dataclass(frozen=True, kw_only=True)
class Model:
    """`y = simulate(u)`, identified from records; physical units, and what is known of how well it
    predicts.

    `facts` are the columns of a run up to the model (`fit_test_percent`, `input_slope_lower`, ...);
    `simulator` is the
    model as explicit numbers: a `StructuredSSM`, an `SSM`, or a baseline. `overrides` give the same
    to the command.
    """

    simulator: Simulator
    data: DataSet
    facts: dict[str, Any]
    overrides: tuple[str, ...]

    def predict(self, u: Values) -> Values:
        """Free run from rest at the equilibrium: `u (T, m)` or `(T,)` to `y (T, p)`, a frame if `u`
        is one."""
        y = self.simulator.simulate(signal(u, "u", len(self.data.inputs))[1])
        if not isinstance(u, pd.DataFrame | pd.Series):
            return y
        return pd.DataFrame(
            y, index=u.index, columns=[channel.name for channel in self.data.outputs]
        )

    def score(self, u: Values, y: Values) -> float:
        """`100 (1 - ||y - y_hat|| / ||y - mean(y)||)` of a free run from rest, percent. Refuses
        other shapes."""
        measured, predicted = signal(y, "y")[1], signal(self.predict(u), "y")[1]
        problem = f"the model answers with {predicted.shape}"
        require(
            measured.shape == predicted.shape,
            "y",
            measured.shape,
            problem,
            "give the outputs of this input",
        )
        moves = bool(np.ptp(measured, axis=0).any())
        problem = "is constant, and the score compares the error with its deviation from the mean"
        require(moves, "y", "one value", problem, "score a record in which it moves")
        return fit_percent(measured, predicted)

    @property
    def ssm(self) -> SSM | StructuredSSM:
        """The simulator, if it is a structured state-space model; refuses every other."""
        if isinstance(self.simulator, SSM | StructuredSSM):
            return self.simulator
        kind, problem = (
            type(self.simulator).__name__,
            "a baseline is scored only, nothing is certified of it",
        )
        raise BadRequest("model", kind, problem, "fit model=structured or ssm")

    def to_control(self) -> "python_control.StateSpace":
        """The model linearised at its equilibrium, deviations in physical units: all of it where
        everything is linear.

        `x+ = A x + B J_u u/s_u,  y = s_y J_y (C x + D J_u u/s_u)`, neurons by their slopes at rest
        within A, B, C, D.
        Refuses a baseline, which has no state space.
        """
        try:
            import control as python_control
        except ImportError as error:
            remedy = "pip install 'ssm-study[export]'"
            raise BadRequest("to_control", "control", "is not installed", remedy) from error

        model, linear = self.ssm, at_rest(self.ssm)
        inward, outward = (
            one.jacobian(np.zeros(one.inputs)) for one in (model.scaffold_in, model.scaffold_out)
        )
        inward, outward = (
            inward / model.scale.input_scale,
            model.scale.output_scale[:, None] * outward,
        )
        matrices = linear.a, linear.b @ inward, outward @ linear.c, outward @ linear.d @ inward
        return python_control.StateSpace(*matrices, model.step_s)


@dataclass(frozen=True, kw_only=True)
class Design:
    """A controller and its certificate in a run folder; one for a given state space has no
    record."""

    folder: Path
    overrides: tuple[str, ...] = ()

    @cached_property
    def record(self) -> dict[str, Any]:
        """The columns of the run: rates, margins, what the loop did."""
        return read_record(self.folder) or {}

    @cached_property
    def certificate(self) -> certificate.Design:
        """`state_feedback` and `observer`: the gains `k`, `l` and the matrices of the theorems."""
        return certificate.Design.load(self.folder / "certificate.json")

    @cached_property
    def model(self) -> SSM | StructuredSSM:
        """What it is certified for."""
        return ModelRun(self.folder).model

    def save(self, to: str | Path) -> Path:
        """Copy the folder: `ssm-study verify`, `export` and `load` read it. Refuses a place that is
        taken."""
        require(not Path(to).exists(), "to", to, "exists", "name a new folder")
        return Path(shutil.copytree(self.folder, to))

    def within(self, lower: Values, upper: Values) -> WithinLimits:
        """What is certified when the input is limited, in physical units; see
        `synthesis.deployed`."""
        if isinstance(self.model, SSM):
            ends = (np.asarray(limit, dtype=float).reshape(-1) for limit in (lower, upper))
            return within_limits(self.model, self.certificate, *ends)
        problem = "nothing is proved within limits: the theorems on them know no neurons"
        raise BadRequest("model", type(self.model).__name__, problem, "fit model=ssm")

    def to_c(self, path: str | Path, real: str = "double") -> Path:
        """Header `path` and beside it the source and a replay, all named as the header, in "double"
        or "float".

        Raises `BadRequest` with the reason where there is no controller.
        """
        path = Path(path)
        for name, text in targets.c_sources(self.folder, real=real, prefix=path.stem).items():
            (path.parent / name).write_text(text, encoding="utf-8")
        return path

    def to_control(self) -> "python_control.NonlinearIOSystem":
        """The controller as a python-control system from measured outputs to inputs, physical
        units."""
        return targets.python_control_system(self.folder)


def fit(
    u: Signals, y: Signals, step_s: float, *overrides: str, results_dir: str | Path | None = None
) -> Model:
    """`model=structured`, or what `overrides` name, fitted to `u[k]`, held over `step_s` seconds,
    and `y[k]`.

    `u (T, m)` or `(T,)`, `y (T, p)` or `(T,)`: arrays, series or frames (whose columns name the
    channels), or lists of
    them, one per experiment. The last 40 % of each validate and test it, or blocks of it where its
    end is unlike its
    beginning (`data.split`). Raises `BadRequest`, before any long work, for what `data=recorded`
    refuses.

    >>> import numpy as np, ssm_study as st
    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.uniform(-3, 3, 100), 8)
    >>> y = np.zeros(801)
    >>> for k in range(800): y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    >>> model = st.fit(u, y[:800], 0.1, "model.order=2", "model.slope_lower=0.5")
    >>> model.score(u, y[:800]) > 95
    True
    """
    folder = Path(results_dir or _scratch())
    seconds = sampling_time(step_s)
    paths, inputs, outputs = logged(u, y, folder)
    words = ["data=recorded", f"data.path=[{_quoted(*paths)}]", f"data.input=[{_quoted(*inputs)}]"]
    words += [
        f"data.output=[{_quoted(*outputs)}]",
        f"data.step_s={seconds!r}",
        "study=library",
        "progress=false",
    ]
    asked = (*words, f"results_dir={_quoted(str(folder))}", *overrides)
    config = composed(asked)
    data, model, found = line.STUDY.identified(line.STUDY.request(config), store_of(config))
    facts = data.facts | model.facts | found.facts
    return Model(simulator=found.value.model, data=data.value, facts=facts, overrides=asked)


def control(model: "Model | python_control.StateSpace", *overrides: str) -> Design:
    """`u = K xh`, `xh+ = A xh + B S_u(u) + L (yh - y)`, certified for the model as the command
    does; see `Design`.

    By default rates and weights are chosen from the validation record. A discrete-time
    `control.StateSpace` has no
    record to choose by: name a synthesis and its rates. Raises `BadRequest` for what the command
    refuses, for a
    baseline, and for overrides that would make another model; where the request is infeasible the
    design says so.

    >>> import control, ssm_study as st
    >>> plant = control.StateSpace([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]], 0.1)
    >>> design = st.control(plant, "synthesis=riccati", "synthesis.rate_controller=0.5", "synthesis.rate_observer=0.6")
    >>> design.certificate.certified
    True
    """
    if not isinstance(model, Model):
        return _for_state_space(model, overrides)
    _ = model.ssm  # refuses a baseline
    config = composed((*model.overrides, *overrides))
    before, now = (plain(one) for one in (composed(model.overrides), config))
    changed = next((part for part in OF_THE_MODEL if before[part] != now[part]), None)
    told = f"changes {changed}, and with it the model"
    require(changed is None, "overrides", " ".join(overrides), told, "give it to fit")
    outcome = line.STUDY.job(config)
    if outcome.status == FAILED:
        raise RuntimeError(f"{outcome.message} (its traceback is in {outcome.folder})")
    gather(outcome.folder.parent)
    return Design(folder=outcome.folder, overrides=(*model.overrides, *overrides))


def load(folder: str | Path) -> Design:
    """A design that was saved, or any run folder. Raises `BadRequest` where there is no
    controller."""
    targets.load(Path(folder))
    return Design(folder=Path(folder))


def simulate(
    what: Model | Design, given: Values, *overrides: str, plant: Plant | None = None
) -> pd.DataFrame:
    """Of a model: the output to the inputs `given (T, m)`, from rest. Of a design: the loop from
    initial outputs.

    The loop runs on the identified model, or on `plant`, from each row of `given (N, p)` or number
    of `given (N,)`,
    without noise, as `loop` in the overrides says (`"loop.horizon_s=3"`,
    `"reference@loop.reference=step"`). One row
    per case and sample: `case, time_s`, inputs and outputs by name. Refuses what the command
    refuses of the loop.
    """
    if isinstance(what, Model):
        predicted = pd.DataFrame(what.predict(pd.DataFrame(signal(given, "u")[1])))
        return predicted.assign(time_s=np.arange(len(predicted)) * what.data.step_s)
    controller, plant = (
        ObserverFeedback.of(what.model, what.certificate),
        plant or IdentifiedPlant.of(what.model),
    )
    y0 = signal(given, "y0", len(plant.outputs))[1]
    loop = Specification.from_config(composed((*what.overrides, *overrides))).loop
    quiet = np.zeros((len(y0), loop.samples(plant.step_s), y0.shape[1]))
    rollouts = loop.simulate(plant, controller, y0, quiet)
    names = [channel.name for channel in (*plant.inputs, *plant.outputs)]
    cases = [
        pd.DataFrame(np.hstack(signals), columns=names)
        for signals in zip(rollouts.u, rollouts.y, strict=True)
    ]
    for i, case in enumerate(cases):
        case.insert(0, "case", i)
        case.insert(1, "time_s", rollouts.time_s)
    return pd.concat(cases, ignore_index=True)


def study(*overrides: str) -> pd.DataFrame:
    """`ssm-study run` with these arguments (`"-m"` too); returns the study's table, one row per
    run.

    Raises `BadRequest` for a wrong request. Runs that failed are rows with status `failed`.
    """
    try:
        command.run(list(overrides))
    except (
        SystemExit
    ) as stop:  # Hydra lets nothing else out of a callback; the refusal is its cause
        raise stop.__cause__ or stop from None
    place = [
        word for word in overrides if word.startswith(("experiment=", "study=", "results_dir="))
    ]
    return gather(line.study_folder(composed(place)))


def _for_state_space(system: "python_control.StateSpace", overrides: tuple[str, ...]) -> Design:
    discrete = (
        isinstance(system.dt, float | int) and not isinstance(system.dt, bool) and system.dt > 0
    )
    require(
        discrete,
        "system.dt",
        system.dt,
        "not a sampling time",
        "sample it: control.c2d(system, step_s)",
    )
    config = composed(("study=library", *overrides))
    synthesis = Specification.from_config(config).synthesis
    problem = "chooses by a validation record, and there is none"
    remedy = "use synthesis=riccati with synthesis.rate_controller and synthesis.rate_observer"
    require(type(synthesis).method != "auto", "synthesis", "auto", problem, remedy)
    matrices = {name: np.array(getattr(system, name.upper()), dtype=float) for name in "abcd"}
    model, folder = (
        SSM.of(StateSpace(**matrices), float(system.dt)),
        Path(tempfile.mkdtemp(dir=_scratch())),
    )
    write_json(folder / "model.json", model.to_json())
    synthesis.design(model, certified_balls(model)).save(folder / "certificate.json")
    return Design(folder=folder, overrides=overrides)


def composed(overrides: Sequence[str]) -> DictConfig:
    """What the command composes from the same words; raises `BadRequest` as it does."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    folder, theirs = command.configuration_folder(), GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()  # the caller may be a Hydra program itself
    try:
        with initialize_config_dir(str(folder.absolute()), version_base="1.3"):
            return compose("study", overrides=quoted(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise advised(error, list(overrides), folder) from error
    finally:
        GlobalHydra.instance().hydra = theirs


@cache
def _scratch() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="ssm-study-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _quoted(*texts: str) -> str:
    """Texts as Hydra reads them back.

    There a backslash stands for itself, except in front of a quote.
    """
    return ",".join(f"'{_escaped(text)}'" for text in texts)


def _escaped(text: str) -> str:
    before_quotes = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return re.sub(r"(\\+)$", r"\1\1", before_quotes)


def sampling_time(step_s: Any) -> float:
    """Seconds of a number or a time difference. Raises `BadRequest` for what is none."""
    remedy = "give it in seconds"
    if isinstance(step_s, timedelta | np.timedelta64):
        step_s = pd.Timedelta(step_s).total_seconds()
    try:
        seconds = float(step_s)
    except (TypeError, ValueError) as error:
        raise BadRequest("step_s", step_s, "is no sampling time", remedy) from error
    positive("step_s", seconds, remedy)
    return seconds
