"""`import ssm_study as st`: the same runs, numbers and refusals as the command, from arrays."""

import doctest
import os
import subprocess
import sys
from pathlib import Path

import control
import numpy as np
import pandas as pd
import pytest
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

import ssm_study as st
from ssm_study import library
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
    u = np.repeat(np.random.default_rng(0).uniform(-3, 3, 60), 8)
    y = np.zeros_like(u)
    for k in range(len(u) - 1):
        y[k + 1] = 0.9 * y[k] + 0.2 * np.tanh(u[k])
    return pd.DataFrame({"valve's voltage": u, "air, temperature": y})


@pytest.fixture(scope="module")
def design(log: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> library.Design:
    folder = tmp_path_factory.mktemp("library") / "res'ults"
    model = st.fit(
        log[["valve's voltage"]], log["air, temperature"], STEP_S, *QUICK, results_dir=folder
    )
    return st.control(model, *GIVEN)


def test_importing_the_package_loads_nothing_heavy() -> None:
    told = "import sys, ssm_study; print(sorted({'torch', 'numpy', 'hydra', 'pandas'} & set(sys.modules)))"
    assert (
        subprocess.run(
            [sys.executable, "-c", told], capture_output=True, text=True, check=True
        ).stdout
        == "[]\n"
    )
    with pytest.raises(AttributeError, match="no attribute 'regulate'"):
        _ = st.regulate


def test_what_a_stored_model_needs_loads_no_torch() -> None:
    told = "import sys; from ssm_study.models import structured, structured_spec; "
    told += "from ssm_study.models.baselines import solved; print('torch' in sys.modules)"
    assert (
        subprocess.run(
            [sys.executable, "-c", told], capture_output=True, text=True, check=True
        ).stdout
        == "False\n"
    )


def test_docstrings_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """As they stand, but for the length of the training that one of them shows."""
    whole, short = library.composed, ("training.max_epochs=10", "model.starts=1", "model.draws=1")
    monkeypatch.setattr(
        library,
        "composed",
        lambda said: whole((*said, *short) if "data=recorded" in said else said),
    )
    result = doctest.testmod(library)
    assert result.failed == 0
    assert result.attempted >= 10


def test_the_command_finds_the_same_run(design: library.Design) -> None:
    """Names and numbers: the run of `fit` and `control` is the one that the command makes of the
    same words."""
    before = (design.folder / "record.json").read_bytes()
    assert main(["run", *design.overrides]) == 0
    assert [path.parent for path in design.folder.parent.glob("*/record.json")] == [design.folder]
    assert (design.folder / "record.json").read_bytes() == before


def test_a_saved_design_verifies_and_loads(design: library.Design, tmp_path: Path) -> None:
    saved = design.save(tmp_path / "mine")
    assert [finding for finding in verify(saved) if not finding.holds] == []
    assert st.load(saved).certificate.certified
    assert "controller_step" in design.to_c(tmp_path / "controller.h").read_text()
    with pytest.raises(BadRequest, match="exists; name a new folder"):
        design.save(tmp_path / "mine")


def test_python_control_takes_model_and_controller(
    design: library.Design, log: pd.DataFrame
) -> None:
    """The linearised pair in python-control's hands settles as fast as `simulate` says of small
    deviations."""
    model = st.fit(log[["valve's voltage"]], log["air, temperature"], STEP_S, *QUICK)
    inner, controller = model.to_control(), design.to_control()
    assert inner.dt == controller.dt == STEP_S
    from_rest = log[["valve's voltage"]] * 0 + design.model.scale.input_equilibrium[0] + 1e-6
    output = (model.predict(from_rest).to_numpy() - design.model.scale.output_equilibrium)[:100]
    linear = control.forced_response(inner, inputs=np.full((1, 100), 1e-6)).outputs[:, None]
    assert np.abs(output - linear).max() < 1e-6 * np.abs(linear).max() + 1e-15
    loop = st.simulate(design, [0.0, 0.2], "loop.horizon_s=6")
    assert set(loop) == {"case", "time_s", "u", "y"}
    ends = loop.groupby("case")["y"].last() - design.model.scale.output_equilibrium[0]
    assert np.abs(ends).max() < 1e-3


def test_frames_keep_names_and_index(log: pd.DataFrame) -> None:
    later = log.set_index(pd.RangeIndex(5, 5 + len(log)))
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


def test_other_channels_than_were_fitted_are_refused(
    design: library.Design, log: pd.DataFrame
) -> None:
    model = st.fit(log[["valve's voltage"]], log["air, temperature"], STEP_S, *QUICK)
    u, y = np.zeros((50, 1)), np.zeros((50, 1))
    for refused, said in (
        (
            lambda: model.predict(np.zeros((50, 2))),
            r"u = \(50, 2\): needs one column per channel: 1",
        ),
        (
            lambda: model.score(u, np.zeros((50, 2))),
            r"y = \(50, 2\): the model answers with \(50, 1\)",
        ),
        (lambda: model.score(u, y[1:]), r"y = \(49, 1\): the model answers with \(50, 1\)"),
        (lambda: st.simulate(model, np.zeros((50, 2))), r"u = \(50, 2\): needs one column"),
        (
            lambda: st.simulate(design, np.zeros((3, 2))),
            r"y0 = \(3, 2\): needs one column per channel: 1",
        ),
    ):
        with pytest.raises(BadRequest, match=said):
            refused()


def test_study_gives_its_table(design: library.Design) -> None:
    table = st.study(*design.overrides)
    assert list(table["run"]) == [design.folder.name]
    assert not HydraConfig.initialized()  # the next run here would keep these words as its own
    with pytest.raises(BadRequest, match="a contraction rate lies in"):
        st.study(*design.overrides, "synthesis.rate_controller=2")


def test_a_program_needs_no_environment(tmp_path: Path) -> None:
    told = f"from ssm_study import library; library.study('results_dir={tmp_path}', 'seed=-1')"
    clean = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    said = subprocess.run(
        [sys.executable, "-c", told], env=clean, capture_output=True, text=True
    ).stderr
    assert "KeyError" not in said
    assert "BadRequest: seed = -1" in said


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
    with pytest.raises(BadRequest, match="changes model, and with it the model; give it to fit"):
        st.control(model, "model.order=3")
    infeasible = st.control(model, *GIVEN[:1], "synthesis.rate_controller=0.999", GIVEN[2])
    with pytest.raises(
        BadRequest, match=r"rate 0\.999 is infeasible: the slopes allow only rates below"
    ):
        infeasible.to_c("never.h")
    with pytest.raises(BadRequest, match="a baseline is scored only"):
        st.control(st.fit(u, y, STEP_S, "model=gru", "training.max_epochs=1"))
    plant = control.StateSpace([[0.9]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    with pytest.raises(BadRequest, match="chooses by a validation record, and there is none"):
        st.control(plant)
    with pytest.raises(BadRequest, match="not a sampling time"):
        st.control(control.StateSpace([[-0.9]], [[1.0]], [[1.0]], [[0.0]]), *GIVEN)


def test_a_hydra_program_may_compose_with_us() -> None:
    """Whoever calls this from a program of Hydra's own finds the program's composition as it
    was."""
    folder = str(Path(__file__).parents[2] / "conf")
    with initialize_config_dir(folder, version_base="1.3"):
        theirs = GlobalHydra.instance().hydra
        assert library.composed(["study=library"]).study == "library"
        with pytest.raises(BadRequest, match="modle"):
            library.composed(["modle.order=2"])
        assert GlobalHydra.instance().hydra is theirs
