"""Arguments of the wrong kind are refused in one sentence: each argument of the Python functions
that need no training, given values of every kind."""

import re
from datetime import timedelta
from pathlib import Path
from typing import Any

import control
import numpy as np
import pandas as pd
import pytest
import torch
from scipy import signal

import ssm_study as st
from ssm_study.api.linearisation import tabulate_frequency_response

A = [[0.9, 0.1], [0.0, 0.8]]
B = [[0.0], [1.0]]
C = [[1.0, 0.0]]
D = [[0.0]]
SYSTEM = (A, B, C, D, 0.1)
GAINS = {"K": [[-0.1, -0.2]], "L": [[-0.4], [-0.1]]}
BOUNDS = {"slopes": (0.8, 1.2), "output_slopes": (0.9, 1.1)}
CERTIFIED = {"A": A, "B": B, "C": C, **GAINS, **BOUNDS}
CONTROLLED: dict[str, Any] = {"model": SYSTEM, "rate": 0.5}
CONTROLLED["slopes"] = (0.8, 1.2)
CONTROLLED["observer_rate"] = 0.5
CONTROLLED["method"] = "riccati"
CONTROLLED["output_slopes"] = (1.0, 1.0)
CONTROLLED["input_limits"] = (None, None)
TIME = np.arange(200.0)
FITTED: dict[str, Any] = {"u": np.sin(TIME), "y": np.cos(TIME)}
FITTED["step_s"] = 0.1
FITTED["model"] = "nonsense"  # refused before any work
ARGUMENTS = {"certify": CERTIFIED, "control": CONTROLLED, "fit": FITTED}
THIRD_IS_MASKED = np.arange(200) == 3
MASKED = np.ma.masked_array(np.ones(200), mask=THIRD_IS_MASKED)
TEXTS = {"a": ["x"] * 200}
DENOMINATOR = [1, 0.5]
IMPROPER_NUMERATOR = [1, 2, 3]
FREQUENCIES = [1, 2]
RESPONSES = [1, 2]
COMPLEX_TRANSFER_FUNCTION = signal.TransferFunction([1j], DENOMINATOR, dt=0.1)
IMPROPER_TRANSFER_FUNCTION = control.tf(IMPROPER_NUMERATOR, DENOMINATOR, 0.1)
ZEROS_AND_POLES = signal.ZerosPolesGain([], [0.5], 1, dt=0.1)
NUMBERS = {
    "a number": 0.5,
    "a complex number": 1 + 2j,
    "NaN": float("nan"),
    "infinity": float("inf"),
    "a number beyond floats": 10**400,
    "a time difference": timedelta(days=-1),
}
COLLECTIONS = {
    "three numbers": (1.0, 2.0, 3.0),
    "a falling pair": (2.0, 1.0),
    "a complex pair": (1j, 2.0),
    "an empty list": [],
    "a ragged list": [[1.0, 2.0], [3.0]],
    "a mapping": {"a": 1},
    "a set": {1, 2},
}
OBJECTS = {
    "a text": "text",
    "an object": object(),
    "a function": len,
    "a path": Path("/nonexistent/x"),
}
ARRAYS = {
    "a tensor with gradients": torch.ones(2, requires_grad=True),
    "three dimensions": np.ones((4, 2, 2)),
    "masked": MASKED,
    "complex numbers": np.ones(200) * 1j,
    "a frame of texts": pd.DataFrame(TEXTS),
}
SYSTEMS = {
    "a complex transfer function": COMPLEX_TRANSFER_FUNCTION,
    "a transfer function in continuous time": control.tf([1], DENOMINATOR),
    "an improper transfer function": IMPROPER_TRANSFER_FUNCTION,
    "a measured response": control.frd(FREQUENCIES, RESPONSES),
    "SciPy's zeros and poles": ZEROS_AND_POLES,
}
KINDS: dict[str, Any] = {**NUMBERS, **COLLECTIONS, **OBJECTS, **ARRAYS, **SYSTEMS}


def cases() -> list[Any]:
    """Every argument of each function with every kind."""
    parameters = []
    for function, arguments in ARGUMENTS.items():
        for argument in arguments:
            case = pytest.param(function, argument, id=f"{function}({argument})")
            parameters.append(case)
    return parameters


@pytest.mark.parametrize(("function", "argument"), cases())
def test_a_wrong_kind_is_refused_in_a_sentence(function: str, argument: str) -> None:
    """Whatever is not refused is taken: it answers. Nothing else is raised."""
    arguments = ARGUMENTS[function]
    sentences = []
    for kind in KINDS.values():
        try:
            changed_arguments = arguments | {argument: kind}
            getattr(st, function)(**changed_arguments)
        except st.BadRequest as refusal:
            sentences.append(str(refusal))
    half_of_the_kinds = len(KINDS) / 2
    assert len(sentences) > half_of_the_kinds, "most of these fit nowhere"
    sentences_of_several_lines = [sentence for sentence in sentences if "\n" in sentence]
    assert not sentences_of_several_lines


NOT_REALISED = [
    (COMPLEX_TRANSFER_FUNCTION, "has complex coefficients; give real ones"),
    (IMPROPER_TRANSFER_FUNCTION, "has no realisation"),
    (ZEROS_AND_POLES, "is no model and no linear system"),
]


@pytest.mark.parametrize(("system", "words"), NOT_REALISED)
def test_a_system_that_cannot_be_realised_says_why(system: object, words: str) -> None:
    with pytest.raises(st.BadRequest, match=words):
        st.control(system, rate=0.5)


def test_a_transfer_function_of_scipy_is_that_of_python_control() -> None:
    denominator = [1.0, -0.5]
    ours = control.tf([1.0], denominator, 0.1)
    theirs = signal.TransferFunction([1.0], denominator, dt=0.1)
    our_design = st.control(ours, rate=0.5)
    their_design = st.control(theirs, rate=0.5)
    our_gain = our_design.certificate.gain_pair.k
    their_gain = their_design.certificate.gain_pair.k
    assert np.array_equal(our_gain, their_gain)


def test_slopes_of_a_fit_are_two_numbers() -> None:
    u = FITTED["u"]
    y = FITTED["y"]
    with pytest.raises(st.BadRequest, match=r"slopes = 0\.5: are no two numbers; give \(lowest"):
        st.fit(u, y, 0.1, model="ssm", slopes=0.5)


def test_a_keyword_is_refused_by_its_own_name() -> None:
    """A setting given as a text keeps the name that the user wrote."""
    u = FITTED["u"]
    y = FITTED["y"]
    with pytest.raises(st.BadRequest, match=r"^foo = 3: .* has no such field; its fields are rate"):
        st.control(SYSTEM, rate=0.5, foo=3)
    with pytest.raises(st.BadRequest, match=r"^synthesis\.foo = 3"):
        st.control(SYSTEM, "synthesis.foo=3", rate=0.5)
    with pytest.raises(st.BadRequest, match=r"^neurons = 4: .*belong to model='structured'"):
        st.fit(u, y, 0.1, model="ssm", neurons=4)
    falling_slopes = (1.2, 0.8)
    with pytest.raises(st.BadRequest, match=r"^slopes = \(1\.2, 0\.8\): the lower slope must"):
        st.fit(u, y, 0.1, model="ssm", slopes=falling_slopes)


NO_MODELS = [3, "text", [], [SYSTEM], {"a": 1}]


@pytest.mark.parametrize("models", NO_MODELS)
def test_only_models_are_compared(models: object) -> None:
    signal_of_ones = np.ones(10)
    with pytest.raises(st.BadRequest, match=r"give a list of models, as st\.fit returns them"):
        st.compare(models, signal_of_ones, signal_of_ones)


NO_PLANTS = [3, "text", None, [1.0]]


@pytest.mark.parametrize("kind", NO_PLANTS)
def test_only_models_and_designs_are_simulated_and_only_on_plants(kind: object) -> None:
    input_signal = np.ones(10)
    with pytest.raises(st.BadRequest, match="is no model and no design"):
        st.simulate(kind, input_signal)
    if kind is not None:
        design = st.control(SYSTEM, rate=0.5)
        with pytest.raises(st.BadRequest, match="is no plant"):
            st.simulate(design, [1.0], plant=kind)
        with pytest.raises(st.BadRequest, match="is no plant"):
            design.plot(plant=kind)


NO_LOGS = [
    (3, {}, "is no path"),
    ("log.csv", {"step_s": "fast"}, "is no sampling time"),
    ("log.csv", {"settings": {"separator": ","}}, "are no TextSettings"),
]


@pytest.mark.parametrize(("path", "settings", "words"), NO_LOGS)
def test_a_log_is_looked_at_with_the_right_kinds(
    path: object, settings: dict[str, Any], words: str
) -> None:
    with pytest.raises(st.BadRequest, match=words):
        st.look(path, **settings)


def fit_order_one(**settings: Any) -> None:
    """Fit a model of one state, with these keywords."""
    u = FITTED["u"]
    y = FITTED["y"]
    st.fit(u, y, 0.1, model="ssm", order=1, **settings)


NO_SEEDS = [-1, "a", 1.5, True, 2**32]


@pytest.mark.parametrize("seed", NO_SEEDS)
def test_a_seed_of_a_fit_is_a_whole_number(seed: object) -> None:
    words = r"seed = .*: not a whole number from 0 to 2\^32 - 1"
    with pytest.raises(st.BadRequest, match=words):
        fit_order_one(seed=seed)


EPOCHS = ("training.max_epochs", 5, "training.max_epochs=5")
NO_DISTURBANCE = ("data.disturbance", None, "data.disturbance=null")
LOWEST = (np.float64(-1), 2)
LIMITS = ("loop.input_lower", LOWEST, "loop.input_lower=[-1.0,2]")
TEXTS_OF_SETTINGS = [EPOCHS, NO_DISTURBANCE, LIMITS]


@pytest.mark.parametrize(("name", "value", "text"), TEXTS_OF_SETTINGS)
def test_a_setting_of_another_part_is_given_as_a_text(name: str, value: object, text: str) -> None:
    settings: dict[str, Any] = {name: value}
    override = re.escape(text)
    words = f'is no setting of the model; write it as "{override}"'
    of_fit = f"{words} after step_s, not as a keyword"
    of_estimator = f"{words} in overrides, not in settings"
    with pytest.raises(st.BadRequest, match=of_fit):
        fit_order_one(**settings)
    u = FITTED["u"]
    y = FITTED["y"]
    estimator = st.Estimator(step_s=0.1, settings=settings)
    with pytest.raises(st.BadRequest, match=of_estimator):
        estimator.fit(u, y)


def test_a_setting_of_a_loop_is_given_to_control_as_a_text() -> None:
    settings: dict[str, Any] = {"loop.horizon_s": 3}
    words = r'no setting of the synthesis; write it as "loop.horizon_s=3" after the model, not as'
    with pytest.raises(st.BadRequest, match=words):
        st.control(SYSTEM, rate=0.2, **settings)


NO_SETTINGS = [3, "hidden_width", [1, 2], {1: 2}]


@pytest.mark.parametrize("settings", NO_SETTINGS)
def test_settings_of_an_estimator_are_named(settings: object) -> None:
    estimator = st.Estimator(step_s=0.1, settings=settings)
    with pytest.raises(st.BadRequest, match="are no settings by name"):
        estimator.fit(FITTED["u"], FITTED["y"])


NO_NUMBERS_OF_FREQUENCIES = [0.5, "many", True, 0]


@pytest.mark.parametrize("points", NO_NUMBERS_OF_FREQUENCIES)
def test_a_frequency_response_has_a_number_of_points(points: object) -> None:
    system = control.StateSpace(A, B, C, D, 0.1)
    with pytest.raises(st.BadRequest, match="is no number of frequencies"):
        tabulate_frequency_response(system, ["u"], ["y"], points)


TWO_BY_TWO = (2, 2)
NO_NUMBERS = [[], "text", np.inf, [1.0, 2.0], np.ones(TWO_BY_TWO)]


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_limits_and_steps_of_a_design_are_finite_numbers(value: object) -> None:
    design = st.control(SYSTEM, rate=0.5)
    with pytest.raises(st.BadRequest, match="number"):
        design.within_limits(value, 3.0)
    with pytest.raises(st.BadRequest, match="number"):
        design.step(value)
