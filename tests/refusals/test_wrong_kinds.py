"""Arguments of the wrong kind are refused in one sentence: each argument of the Python functions
that need no training, given values of every kind."""

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
CERTIFIED = {
    "A": A,
    "B": B,
    "C": C,
    "K": [[-0.1, -0.2]],
    "L": [[-0.4], [-0.1]],
    "slopes": (0.8, 1.2),
    "output_slopes": (0.9, 1.1),
}
CONTROLLED: dict[str, Any] = {"model": SYSTEM, "rate": 0.5, "slopes": (0.8, 1.2)}
LATER = {"observer_rate": 0.5, "method": "riccati", "output_slopes": (1.0, 1.0)}
LATER["input_limits"] = (None, None)
CONTROLLED |= LATER
FITTED: dict[str, Any] = {"u": np.sin(np.arange(200.0)), "y": np.cos(np.arange(200.0))}
FITTED |= {"step_s": 0.1, "model": "nonsense"}  # refused before any work
KINDS = {
    "a text": "text",
    "a number": 0.5,
    "a complex number": 1 + 2j,
    "NaN": float("nan"),
    "infinity": float("inf"),
    "a number beyond floats": 10**400,
    "three numbers": (1.0, 2.0, 3.0),
    "a falling pair": (2.0, 1.0),
    "a complex pair": (1j, 2.0),
    "an empty list": [],
    "a tensor with gradients": torch.ones(2, requires_grad=True),
    "a ragged list": [[1.0, 2.0], [3.0]],
    "a mapping": {"a": 1},
    "a set": {1, 2},
    "an object": object(),
    "a function": len,
    "a path": Path("/nonexistent/x"),
    "three dimensions": np.ones((4, 2, 2)),
    "masked": np.ma.masked_array(np.ones(200), mask=np.arange(200) == 3),
    "complex numbers": np.ones(200) * 1j,
    "a frame of texts": pd.DataFrame({"a": ["x"] * 200}),
    "a time difference": timedelta(days=-1),
    "a complex transfer function": signal.TransferFunction([1j], [1, 0.5], dt=0.1),
    "a transfer function in continuous time": control.tf([1], [1, 0.5]),
    "an improper transfer function": control.tf([1, 2, 3], [1, 0.5], 0.1),
    "a measured response": control.frd([1, 2], [1, 2]),
    "SciPy's zeros and poles": signal.ZerosPolesGain([], [0.5], 1, dt=0.1),
}


def cases() -> list[Any]:
    """Every argument of each function with every kind."""
    functions = {"certify": CERTIFIED, "control": CONTROLLED, "fit": FITTED}
    return [
        pytest.param(function, argument, id=f"{function}({argument})")
        for function, arguments in functions.items()
        for argument in arguments
    ]


@pytest.mark.parametrize(("function", "argument"), cases())
def test_a_wrong_kind_is_refused_in_a_sentence(function: str, argument: str) -> None:
    """Whatever is not refused is taken: it answers. Nothing else is raised."""
    arguments = {"certify": CERTIFIED, "control": CONTROLLED, "fit": FITTED}[function]
    sentences = []
    for kind in KINDS.values():
        try:
            getattr(st, function)(**arguments | {argument: kind})
        except st.BadRequest as refusal:
            sentences.append(str(refusal))
    assert len(sentences) > len(KINDS) / 2, "most of these fit nowhere"
    assert not [sentence for sentence in sentences if "\n" in sentence]


@pytest.mark.parametrize(
    ("system", "words"),
    [
        (KINDS["a complex transfer function"], "has complex coefficients; give real ones"),
        (KINDS["an improper transfer function"], "has no realisation"),
        (KINDS["SciPy's zeros and poles"], "is no model and no linear system"),
    ],
)
def test_a_system_that_cannot_be_realised_says_why(system: object, words: str) -> None:
    with pytest.raises(st.BadRequest, match=words):
        st.control(system, rate=0.5)


def test_a_transfer_function_of_scipy_is_that_of_python_control() -> None:
    ours = control.tf([1.0], [1.0, -0.5], 0.1)
    theirs = signal.TransferFunction([1.0], [1.0, -0.5], dt=0.1)
    gains = [st.control(system, rate=0.5).certificate.pair for system in (ours, theirs)]
    assert np.array_equal(gains[0].k, gains[1].k)


def test_slopes_of_a_fit_are_two_numbers() -> None:
    with pytest.raises(st.BadRequest, match=r"slopes = 0\.5: are no two numbers; give \(lowest"):
        st.fit(FITTED["u"], FITTED["y"], 0.1, model="ssm", slopes=0.5)


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
    with pytest.raises(st.BadRequest, match=r"^slopes = \(1\.2, 0\.8\): the lower slope must"):
        st.fit(u, y, 0.1, model="ssm", slopes=(1.2, 0.8))


@pytest.mark.parametrize("models", [3, "text", [], [SYSTEM], {"a": 1}])
def test_only_models_are_compared(models: object) -> None:
    with pytest.raises(st.BadRequest, match=r"give a list of models, as st\.fit returns them"):
        st.compare(models, np.ones(10), np.ones(10))


@pytest.mark.parametrize("kind", [3, "text", None, [1.0]])
def test_only_models_and_designs_are_simulated_and_only_on_plants(kind: object) -> None:
    with pytest.raises(st.BadRequest, match="is no model and no design"):
        st.simulate(kind, np.ones(10))
    if kind is not None:
        design = st.control(SYSTEM, rate=0.5)
        for run in (
            lambda: st.simulate(design, [1.0], plant=kind),
            lambda: design.plot(plant=kind),
        ):
            with pytest.raises(st.BadRequest, match="is no plant"):
                run()


@pytest.mark.parametrize(
    ("path", "settings", "words"),
    [
        (3, {}, "is no path"),
        ("log.csv", {"step_s": "fast"}, "is no sampling time"),
        ("log.csv", {"settings": {"separator": ","}}, "are no TextSettings"),
    ],
)
def test_a_log_is_looked_at_with_the_right_kinds(
    path: object, settings: dict[str, Any], words: str
) -> None:
    with pytest.raises(st.BadRequest, match=words):
        st.look(path, **settings)


@pytest.mark.parametrize("settings", [3, "hidden_width", [1, 2], {1: 2}])
def test_settings_of_an_estimator_are_named(settings: object) -> None:
    estimator = st.Estimator(step_s=0.1, settings=settings)
    with pytest.raises(st.BadRequest, match="are no settings by name"):
        estimator.fit(FITTED["u"], FITTED["y"])


@pytest.mark.parametrize("points", [0.5, "many", True, 0])
def test_a_frequency_response_has_a_number_of_points(points: object) -> None:
    system = control.StateSpace(A, B, C, D, 0.1)
    with pytest.raises(st.BadRequest, match="is no number of frequencies"):
        tabulate_frequency_response(system, ["u"], ["y"], points)


@pytest.mark.parametrize("value", [[], "text", np.inf, [1.0, 2.0], np.ones((2, 2))])
def test_limits_and_steps_of_a_design_are_finite_numbers(value: object) -> None:
    design = st.control(SYSTEM, rate=0.5)
    for call in (lambda: design.within_limits(value, 3.0), lambda: design.step(value)):
        with pytest.raises(st.BadRequest, match="number"):
            call()
