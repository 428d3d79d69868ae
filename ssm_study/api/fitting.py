"""Identify a model from arrays."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ssm_study.api.arguments import Signals, Slopes
from ssm_study.api.model import Model
from ssm_study.api.parts import StudyParts
from ssm_study.api.scratch import make_scratch_folder
from ssm_study.api.steps import identify_model
from ssm_study.api.systems import read_path, read_slope_range
from ssm_study.data.arrays import index_period_s, write_log_files
from ssm_study.refusal import NO_NUMBERS, BadRequest, require, require_positive
from ssm_study.signals import DataSet

CHOICES = {
    "data": "recorded",
    "model": "log",
    "training": "default",
    "reduction": "balanced",
    "synthesis": "auto",
    "loop": "regulation",
}


def fit(
    u: Signals,
    y: Signals,
    step_s: float | None = None,
    *overrides: str,
    disturbance: Signals | None = None,
    model: str = "log",
    order: int | str | None = None,
    neurons: int | None = None,
    slopes: Slopes | None = None,
    feedthrough: bool | str | None = None,
    seed: int | None = None,
    progress: bool = True,
    keep_on_interrupt: bool = False,
    results_dir: str | Path | None = None,
    **settings: Any,
) -> Model:
    """Identify a structured state-space model from inputs and outputs.

    `u[k]` is held over `[k, k+1) step_s` and `y[k]` is sampled at `k step_s`, in seconds; frames
    with an index of times need no `step_s`. Shapes
    `u (T, m)` or `(T,)`, `y (T, p)` or `(T,)`: arrays, series or frames (whose columns name the
    channels), or lists of them, one per experiment. The last 40 % of each record validate and test
    the model, or blocks of it where its end is unlike its beginning. `disturbance`, of the same
    lengths, holds what is measured and not commanded (a load, a temperature outside): it drives
    model and observer by a path of its own, and the controller does not compensate it.

    `model` is one of these (`conf/model`), with settings of its own in brackets:

    * "log", the default: "structured", whose sizes and paths are chosen by comparing a dozen or
      more models on folds of the records. It takes one to three minutes for 1000 samples;
    * "structured" [order, neurons, slopes, feedthrough, dead_time]: neurons inside the recurrence,
      5 states and 5 neurons unless you say so;
    * "ssm" [order, slopes, feedthrough, hidden_width]: the paper's, a static input map before a
      linear recurrence. It takes seconds;
    * "delayed" [as "ssm", dead_time]: "ssm" behind a dead time; "linear" [order, feedthrough]:
      "ssm" without the map; "n4sid" [order]: linear, by subspaces, which needs
      `pip install "ssm-study[baselines]"`;
    * "bilinear" [order, nodes]: products of input and state, for one input (a heater in a flow, a
      generator's field). It takes seconds; of its loops is proved that they come to rest;
    * baselines, which are scored and compared, not controlled: "arx" [lags, delay], "output_error"
      [order, delay], "narx" [lags, degree, terms, delay], "gru", "lstm" [hidden].

    Every result answers `predict`, `score`, `simulation_errors`, `plot`, `residuals`, `facts`,
    `save`, and takes part in `st.compare`. All but the baselines are taken by `st.control`, and all
    of these but "bilinear" answer `eigenvalues`, `poles`, `frequency_response`, `bode`,
    `to_control`, `to_continuous`, `evidence`, `mismatch` and, with one input, `input_map`.

    `slopes` are the bounds of the input map's slopes, and `settings` further fields of the model; a
    field left at None has the value of its yaml file. `overrides` are settings as the command takes
    them, such as `"training.max_epochs=10"` or `"data.test_fraction=0.3"`. `results_dir` keeps the
    log that the arrays become. With `keep_on_interrupt` Ctrl-C ends the training and the best model
    so far is returned; `model.result_columns["training_ended"]` says so. Before the first epoch has
    ended there is none, and `KeyboardInterrupt` is raised as without it.

    Raises `BadRequest`, before any long work, for whatever `ssm-study run data=recorded` refuses.

    >>> import numpy as np, ssm_study as st
    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.uniform(-3, 3, 100), 8)
    >>> y = np.zeros(801)
    >>> for k in range(800): y[k + 1] = 0.9 * y[k] + 0.2 * u[k]
    >>> model = st.fit(u, y[:800], 0.1, order=2, slopes=(0.5, 1.0), progress=False)
    >>> model.score(u, y[:800]) > 95
    True
    """
    step_s = find_sampling_time_s(step_s, u)
    choices = CHOICES | {"model": model}
    parts = StudyParts(choices, overrides)
    parts.change_settings(
        "model", order=order, neurons=neurons, feedthrough=feedthrough, **settings
    )
    if slopes is not None:
        slope_lower, slope_upper = read_slope_range("slopes", slopes)
        parts.change_settings("model", slope_lower=slope_lower, slope_upper=slope_upper)
    if seed is not None:
        parts.set_seed("seed", seed)
    spec = parts.build("model")
    training = parts.build("training")
    reduction = parts.build("reduction")

    folder = make_scratch_folder() if results_dir is None else read_path("results_dir", results_dir)
    data = build_data_set(parts, u, y, step_s, disturbance, folder)

    seed = parts.numbers["seed"]
    trained, identification = identify_model(
        spec,
        training,
        data,
        seed,
        progress=progress,
        workplace=folder,
        keep_on_interrupt=keep_on_interrupt,
    )
    simulator = reduction.reduce_model(trained) if spec.gives_ssm else trained
    used_overrides = parts.command_overrides()
    later_words = parts.overrides_for_parts("synthesis", "loop", "loop_seed")
    return Model(
        simulator=simulator,
        data=data,
        identification=identification,
        seed=seed,
        overrides=used_overrides,
        later_words=later_words,
    )


def build_data_set(
    parts: StudyParts,
    u: Signals,
    y: Signals,
    step_s: float,
    disturbance: Signals | None,
    folder: Path,
) -> DataSet:
    """Build a data set from signals in arrays, which are written to log files and read again.
    `ssm-study run` reads a log in the same way."""
    seconds = float(step_s)
    log = write_log_files(u, y, folder, seconds, disturbance)
    parts.change_settings(
        "data", path=log.paths, input=log.inputs, output=log.outputs, step_s=step_s
    )
    parts.change_settings("data", disturbance=log.disturbances or None)
    data_settings = parts.build("data")
    seed = parts.numbers["seed"]
    data: DataSet = data_settings.build(seed)
    return data


def find_sampling_time_s(step_s: Any, u: Any) -> float:
    """Find the sampling time in seconds, from the given value or else from the time index of the
    inputs. Raises `BadRequest` where neither gives one."""
    if step_s is None:
        step_s = index_period_s(u)
    remedy = "give it in seconds, as in st.fit(u, y, 0.1)"
    problem = "is not given, and u has no index of times"
    has_period = step_s is not None
    require(has_period, "step_s", step_s, problem, remedy)
    return convert_to_seconds(step_s)


def convert_to_seconds(step_s: Any) -> float:
    """Convert a sampling time, given as a number or a time difference, to seconds. Raises
    `BadRequest` for anything else."""
    remedy = "give it in seconds"
    is_truth_value = isinstance(step_s, bool)
    require(not is_truth_value, "step_s", step_s, "is no sampling time", remedy)
    if isinstance(step_s, timedelta | np.timedelta64):
        step_s = pd.Timedelta(step_s).total_seconds()
    try:
        is_complex = np.iscomplexobj(step_s)
        require(not is_complex, "step_s", step_s, "is no sampling time", remedy)
        seconds = float(step_s)
    except BadRequest:
        raise
    except NO_NUMBERS as error:
        raise BadRequest("step_s", step_s, "is no sampling time", remedy) from error
    require_positive("step_s", seconds, remedy)
    return seconds
