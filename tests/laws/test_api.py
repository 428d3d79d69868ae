"""`import ssm_study as st`: the same runs, numbers and refusals as the command, from arrays."""

import doctest
import json
from importlib import import_module
from inspect import isfunction, signature
from pathlib import Path
from typing import Any

import control
import docs_commands
import numpy as np
import pandas as pd
import pytest
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from verify_lies import check_seal_of_saved_model

import ssm_study as st
from ssm_study.api import parts
from ssm_study.api.design import Design
from ssm_study.api.model import Model
from ssm_study.api.summaries import choice_summary, chosen_sizes, size_text, summarise_prediction
from ssm_study.cli.main import main
from ssm_study.refusal import BadRequest
from ssm_study.study.verify import verify

STEP_S = 0.1
QUICK = (
    "model.order=2",
    "model.slope_lower=0.5",
    "model=ssm",
    "model.hidden_width=4",
    "training.max_epochs=3",
)
GIVEN = ("synthesis=riccati", "synthesis.rate_controller=0.3", "synthesis.rate_observer=0.5")


@pytest.fixture(scope="module")
def log() -> pd.DataFrame:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-3, 3, 60), 8)
    y = np.zeros_like(u)
    for k in range(len(u) - 1):
        y[k + 1] = 0.9 * y[k] + 0.2 * np.tanh(u[k])
    return pd.DataFrame({"valve's voltage": u, "air, temperature": y})


@pytest.fixture(scope="module")
def design(log: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Design:
    folder = tmp_path_factory.mktemp("library") / "res'ults"
    u = log[["valve's voltage"]]
    model = st.fit(u, log["air, temperature"], STEP_S, *QUICK, results_dir=folder)
    return st.control(model, *GIVEN)


MODULES = ("certifying", "comparing", "controlling", "fitting")
SHORT = ("training.max_epochs=10", "model.starts=1", "model.draws=1")
# A log decides them by training on its folds: tests/laws/test_training_choice.py.
SIZES = tuple(f"{name}={value}" for name, value in docs_commands.SIZES.items())


@pytest.fixture(autouse=True)
def _no_figures_after_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssm_study.cli.summary.RUN_FIGURES", ())


@pytest.mark.parametrize("name", MODULES)
def test_docstrings_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The examples hold as they stand; the trainings in them are shortened."""
    whole = parts.StudyParts.__init__

    def shortened(
        self: parts.StudyParts, choices: dict[str, str], words: tuple[str, ...] = ()
    ) -> None:
        short = (*SHORT, *SIZES) if choices.get("model") == "log" else ()
        whole(self, choices, (*short, *words))

    monkeypatch.setattr(parts.StudyParts, "__init__", shortened)
    result = doctest.testmod(import_module(f"ssm_study.api.{name}"))
    assert result.failed == 0
    assert result.attempted > 0


LONGEST_SIGNATURE = 440  # characters: `fit` has fourteen arguments with their types


def test_help_prints_short_signatures_and_nothing_foreign() -> None:
    public = [getattr(st, name) for name in dir(st)]
    functions = [value for value in public if isfunction(value)]
    assert {function.__name__ for function in functions} >= {"fit", "control", "certify", "look"}
    for function in functions:
        printed = str(signature(function))
        assert len(printed) <= LONGEST_SIGNATURE, printed
        assert "jaxtyping" not in printed
    classes_and_functions = [value for value in public if value is not st.study]
    assert all(value.__module__.startswith("ssm_study.") for value in classes_and_functions)


def test_a_saved_design_is_the_run_of_the_command(design: Design, tmp_path: Path) -> None:
    """The words of a design make the same run by the command: same model, same gains."""
    saved = design.save(tmp_path / "saved")
    assert main(["run", *design.overrides, f"results_dir={tmp_path}", "study=again"]) == 0
    paths = (tmp_path / "again").glob("*/record.json")
    (again,) = (path.parent for path in paths)
    for name in ("model.json", "certificate.json"):
        folders = (saved, again)
        ours, theirs = (json.loads((folder / name).read_text()) for folder in folders)
        for content in (ours, theirs):
            for part in content.values():
                if isinstance(part, dict):
                    for timing in ("seconds", "digest"):
                        part.pop(timing, None)
        assert ours == theirs


def test_a_saved_design_verifies_and_loads(design: Design, tmp_path: Path) -> None:
    saved = design.save(tmp_path / "mine")
    assert [finding for finding in verify(saved) if not finding.holds] == []
    assert st.load(saved).certificate.certified
    text = design.to_c(tmp_path / "controller.h").read_text()
    assert "controller_step" in text
    with pytest.raises(BadRequest, match="exists; name a new folder"):
        design.save(tmp_path / "mine")


def test_python_control_takes_model_and_controller(design: Design, log: pd.DataFrame) -> None:
    """The linearised pair in python-control's hands settles as fast as `simulate` says of small
    deviations."""
    model = design.origin
    assert model is not None
    inner = model.to_control()
    controller = design.to_control()
    assert inner.dt == controller.dt == STEP_S
    input_equilibrium = design.model.scale.input_equilibrium
    from_rest = log[["valve's voltage"]] * 0 + input_equilibrium[0] + 1e-6
    output_equilibrium = design.model.scale.output_equilibrium
    difference = model.predict(from_rest).to_numpy() - output_equilibrium
    output = difference[:100]
    inputs = np.full((1, 100), 1e-6)
    outputs = control.forced_response(inner, inputs=inputs).outputs
    linear = outputs[:, None]
    difference = np.abs(output - linear)
    largest_difference = difference.max()
    largest = np.abs(linear).max()
    upper_limit = 1e-6 * largest + 1e-15
    assert largest_difference < upper_limit
    loop = st.simulate(design, [0.0, 0.2], "loop.horizon_s=6")
    expected = {"case", "time_s", "valve_s_voltage", "air_temperature"}
    assert set(loop) == expected
    air_temperature = loop.groupby("case")["air_temperature"]
    ends = air_temperature.last() - output_equilibrium[0]
    largest = np.abs(ends).max()
    assert largest < 1e-3


def test_frames_keep_names_and_index(log: pd.DataFrame) -> None:
    range_index = pd.RangeIndex(5, 5 + len(log))
    later = log.set_index(range_index)
    model = st.fit(log[["valve's voltage"]], log[["air, temperature"]], STEP_S, *QUICK)
    predicted = model.predict(later[["valve's voltage"]])
    assert list(predicted) == ["air_temperature"]
    assert predicted.index[0] == 5
    score = model.score(log["valve's voltage"], log["air, temperature"])
    assert 60 < score < 100
    half = len(log) // 2
    parts = [log.iloc[:half], log.iloc[half:]]
    u, y = ([part[name] for part in parts] for name in log)
    assert len(st.fit(u, y, STEP_S, *QUICK).data.training) == 2


def test_other_channels_than_were_fitted_are_refused(design: Design) -> None:
    model = design.origin
    assert model is not None
    u = np.zeros((50, 1))
    y = np.zeros((50, 1))
    for refused, said in (
        (
            lambda: model.predict(np.zeros((50, 2))),
            r"u = \(50, 2\): needs 1 column, one per channel",
        ),
        (
            lambda: model.score(u, np.zeros((50, 2))),
            r"y = \(50, 2\): the model gives outputs \(50, 1\)",
        ),
        (lambda: model.score(u, y[1:]), r"y = \(49, 1\): the model gives outputs \(50, 1\)"),
        (lambda: st.simulate(model, np.zeros((50, 2))), r"u = \(50, 2\): needs 1 column"),
        (
            lambda: st.simulate(design, np.zeros((3, 2))),
            r"y0 = \(3, 2\): needs 1 column, one per channel",
        ),
    ):
        with pytest.raises(BadRequest, match=said):
            refused()


def test_study_gives_its_table(tmp_path: Path, smoke_store: Path) -> None:
    (tmp_path / ".store").symlink_to(smoke_store)  # its model is there already
    words = ("experiment=smoke", f"results_dir={tmp_path}", "study=mine", "progress=false")
    table = st.study(*words)
    status = list(table["status"])
    assert status == ["ok"]
    assert not HydraConfig.initialized()  # the next run here would keep these words as its own
    with pytest.raises(BadRequest, match="a contraction rate lies in"):
        st.study(*words, "synthesis=riccati", "synthesis.rate_controller=2")


@pytest.mark.parametrize(
    ("u", "y", "words", "said"),
    [
        (np.ones(100), np.ones(99), (), "differ in length; cut both"),
        ([np.ones(100)], [np.ones(100)] * 2, (), "not as many experiments"),
        (np.ones((5, 2, 2)), np.ones(5), (), "not a signal"),
        (pd.DataFrame({"u": ["a"]}), np.ones(1), (), "not a table of numbers"),
        (np.ones(100), np.full(100, np.nan), (), "NaN|no number"),
        (np.ones(200), np.arange(200.0), (), "constant over the training records"),
        (np.arange(100.0), np.arange(100.0), ("model.ordr=3",), "ordr"),
        (np.arange(100.0), np.arange(100.0), ("model.order=0",), "at least 1"),
    ],
)
def test_fit_refuses_as_the_command_does(
    u: object, y: object, words: tuple[str, ...], said: str
) -> None:
    with pytest.raises(BadRequest, match=said):
        st.fit(u, y, 0.1, *words)


def test_control_refuses(log: pd.DataFrame) -> None:
    u, y = log.to_numpy().T
    with pytest.raises(BadRequest, match="must be positive"):
        st.fit(u, y, 0.0)
    model = st.fit(u, y, STEP_S, *QUICK)
    with pytest.raises(BadRequest, match="changes model, and with it the model; give it to st"):
        st.control(model, "model.order=3")
    infeasible = st.control(model, *GIVEN[:1], "synthesis.rate_controller=0.999", GIVEN[2])
    with pytest.raises(
        BadRequest, match=r"rate 0\.999 is infeasible: the slopes allow only rates below"
    ):
        infeasible.to_c("never.h")
    with pytest.raises(BadRequest, match="is a baseline: it can be scored, but"):
        st.control(st.fit(u, y, STEP_S, "model=gru", "training.max_epochs=1"))
    one = [[1.0]]
    zero = [[0.0]]
    plant = control.StateSpace([[0.9]], one, one, zero, STEP_S)
    with pytest.raises(BadRequest, match="needs a validation record to choose by, and there is"):
        st.control(plant, method="auto")
    state_space = control.StateSpace([[-0.9]], one, one, zero)
    with pytest.raises(BadRequest, match="not a sampling time"):
        st.control(state_space, *GIVEN)


def test_a_design_that_helps_nobody_says_so() -> None:
    facts = {"predicted_stable": True, "evidence": "doubt", "predicted_faster": False}
    line = summarise_prediction(facts | {"resolved_margin": 1.24})["predicted for the plant"]
    expected = "stays stable, no faster than without control, with doubts (stability margin 1.24)"
    assert line == expected


def test_models_and_designs_say_what_they_are(design: Design) -> None:
    """Ten lines or so with numbers and units, in a notebook a table; pictures are figures."""
    model = design.origin
    assert model is not None
    for subject in (model, design):
        lines = repr(subject).splitlines()
        assert 3 <= len(lines) <= 16
        assert "<table>" in subject._repr_html_()
    assert "fit on the test records" in repr(model)
    figures = [model.plot(), model.bode(), model.residuals(), model.poles(), model.input_map()]
    figures += [design.plot(), design.poles(), design.nyquist(), design.step()]
    figures += [design.margin_plot(), design.coverage_plot()]
    for figure in figures:
        assert isinstance(figure, Figure)
        assert figure._repr_png_()[0].startswith(b"\x89PNG"), "a notebook shows it"


def test_the_continuous_model_is_what_was_sampled(design: Design) -> None:
    """Sampling the continuous system with a hold gives the linearised model back."""
    model = design.origin
    assert model is not None
    discrete = model.to_control()
    again = control.c2d(model.to_continuous(), STEP_S)
    for name in "ABCD":
        actual = getattr(again, name)
        expected = getattr(discrete, name)
        np.testing.assert_allclose(actual, expected, atol=1e-9)


def test_the_frequency_response_is_python_controls(design: Design) -> None:
    model = design.origin
    assert model is not None
    response = model.frequency_response(20)
    values = model.to_control()(np.exp(1j * response.frequency_rad_s.to_numpy() * STEP_S))
    expected = np.abs(values)
    np.testing.assert_allclose(response.magnitude, expected, rtol=1e-9)


def test_certify_proves_what_sampled_slopes_do() -> None:
    """Sampled contraction never beats the proved rate; a gain too large is refused."""
    rng = np.random.default_rng(3)
    a = np.array([[0.9, 0.2], [0.0, 0.7]])
    b = np.array([[0.3], [1.0]])
    k = np.array([[-0.1, -0.2]])
    slopes = (0.6, 1.4)
    proof = st.certify(a, b, K=k, slopes=slopes)
    assert proof.certified
    controller = proof.controller
    assert controller is not None
    certificate_p = controller.certificate.p
    metric = np.linalg.inv(certificate_p)
    factor = np.linalg.cholesky(metric).T
    inverse = np.linalg.inv(factor)
    worst = 0.0
    for slope in rng.uniform(0.6, 1.4, 200):
        step = factor @ (a + slope * b @ k) @ inverse
        norm = np.linalg.norm(step, 2)
        worst = max(worst, norm)
    upper_limit = np.sqrt(1 - controller.rate) + 1e-12
    assert worst <= upper_limit
    slopes = (0.6, 1.4)
    refused = st.certify(a, b, K=20 * k, slopes=slopes)
    assert not refused.certified
    assert "not stable at the mean slope" in refused.controller.reason


def test_certify_agrees_with_the_deployed_rate(design: Design) -> None:
    """Two routes to one number: the design's own largest rate, and gains given from outside."""
    feedback, observer = design.certificate.controller_and_observer()
    lower = feedback.alpha - feedback.beta
    upper = feedback.alpha + feedback.beta
    slopes = (lower, upper)
    proof = st.certify(
        feedback.a, feedback.b, observer.c, K=feedback.k, L=observer.l, slopes=slopes
    )
    rate = proof.controller.rate
    rates = (rate, proof.observer.rate)
    sides = ("state_feedback", "observer")
    stored = [design.certificate.certified_rate(side) for side in sides]
    np.testing.assert_allclose(rates, stored, rtol=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"A": np.eye(2), "B": np.ones((2, 1))}, "no gain is given"),
        ({"A": np.eye(2), "K": np.ones((1, 2))}, "a state feedback needs it"),
        ({"A": np.ones((2, 3)), "K": np.ones((1, 2)), "B": np.ones((2, 1))}, "must have 2 rows"),
        ({"A": np.eye(2), "B": np.ones((2, 1)), "K": np.ones((1, 3))}, "must have 1 row"),
        ({"A": np.eye(2) * np.nan, "B": np.ones((2, 1)), "K": np.ones((1, 2))}, "is not finite"),
        ({"A": np.eye(1), "B": np.eye(1), "K": -np.eye(1), "slopes": (-1.0, 1.0)}, "hold zero"),
    ],
)
def test_certify_refuses(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(BadRequest, match=message):
        st.certify(**arguments)


def test_compare_ranks_models_on_one_record(log: pd.DataFrame) -> None:
    u = log[["valve's voltage"]]
    y = log["air, temperature"]
    good = st.fit(u, y, STEP_S, *QUICK)
    poor = st.fit(u, y, STEP_S, "model=linear", "model.order=1", "training.max_epochs=1")
    models = {"poor": poor, "good": good}
    comparison = st.compare(models, u, y)
    index = list(comparison.table.index)
    assert index == ["good", "poor"]
    expected = good.score(u, y)
    assert comparison.table.loc["good", "fit_percent"] == pytest.approx(expected)
    assert isinstance(comparison.plot(), Figure)
    with pytest.raises(BadRequest, match="nothing to compare"):
        st.compare([], u, y)


def test_a_saved_model_loads_and_simulates_to_the_last_digit(
    design: Design, log: pd.DataFrame, tmp_path: Path
) -> None:
    model = design.origin
    assert model is not None
    saved = model.save(tmp_path / "model")
    loaded = st.load(saved)
    assert isinstance(loaded, Model)
    u = log[["valve's voltage"]]
    pd.testing.assert_frame_equal(st.simulate(loaded, u), st.simulate(model, u), check_exact=True)
    assert str(loaded) == str(model)
    check_seal_of_saved_model(saved)
    assert st.control(loaded, *GIVEN).record["resolved_margin"] == design.record["resolved_margin"]
    (saved / "records.npz").write_bytes(b"damaged")
    with pytest.raises(BadRequest, match=r"cannot be read .*; save the model again"):
        st.load(saved)
    with pytest.raises(BadRequest, match="holds no saved model; name the folder"):
        Model.load(tmp_path)


def test_the_summary_counts_states_and_neurons_as_the_choice_does() -> None:
    assert chosen_sizes("order 3, neurons 5, knots 16") == {"order": 3, "neurons": 5}
    assert size_text(5, 5) == 5
    assert size_text(5, None) == 5
    assert size_text(4, 5) == "4 (of the 5 chosen, the others were not needed)"
    assert choice_summary("order 3, input path none") == "order 3, input drives the neurons no"
