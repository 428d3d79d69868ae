"""Plants, signals, exported code, logs and their judgement are those that were recorded."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_cases import device
from plants_cases import choices, from_yaml
from recorded import assert_as_recorded, is_recorded

from ssm_study.data.excitations.excitation import SignalRequest
from ssm_study.data.look import look
from ssm_study.data.recorded import RecordedData
from ssm_study.evidence.metrics import collect_findings
from ssm_study.export.c import render_c_files
from ssm_study.models.warm_start import simulate_validation_and_test
from ssm_study.plants.disturbance import PeriodicDisturbance, RampDisturbance, RandomDisturbance
from ssm_study.robustness.mismatch import measure_model_error

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from log_kinds import KINDS, LogKind, kind_named

SAMPLED = {"samples": 300, "step_s": 0.01}
REQUEST = SignalRequest(amplitude=(4.0, 0.5), clock_s=0.05, **SAMPLED)
TIME_S = 0.01 * np.arange(300)
SIGNALS = {
    "periodic": PeriodicDisturbance(amplitude=2.0, frequency_hz=1.5),
    "random": RandomDisturbance(amplitude=0.5, hold_s=0.07, seed=3),
    "ramp": RampDisturbance(slope_per_s=2.0, from_s=0.5, until_s=1.5),
}


def test_excitations_and_disturbances_are_the_recorded_ones() -> None:
    signals = {name: kind.signal(TIME_S) for name, kind in SIGNALS.items()}
    for name in choices("excitation"):
        rng = np.random.default_rng(5)
        signals[name] = from_yaml("excitation", name).signal(REQUEST, rng)
    assert_as_recorded("signals", signals)


def plant_run(name: str) -> dict[str, Any]:
    """Equilibrium, starts, and a run under levels of the input and of the disturbance."""
    plant = from_yaml("plant", name)
    rest = plant.equilibrium()
    rng = np.random.default_rng(7)
    levels = rng.uniform(-1, 1, (2, 6, len(plant.inputs))).repeat(10, axis=1)
    u = rest.u + levels * np.array(plant.input_amplitude)
    d = rng.uniform(-1, 1, (2, 3, len(plant.disturbances))).repeat(20, axis=1)
    starts = plant.equilibrium_states(rest.y + np.array([[0.3], [-0.2]]))
    x, y = plant.simulate(u, starts, 0.01 * d)
    return {"rest": rest, "starts": starts, "x": x, "y": y}


RECORDED_PLANTS = [name for name in choices("plant") if is_recorded(f"plant_{name}")]


@pytest.mark.parametrize("name", RECORDED_PLANTS)
def test_a_plant_runs_as_recorded(name: str) -> None:
    assert_as_recorded(f"plant_{name}", plant_run(name))


KINDS_OF_MAPS = ["linear", "mlp", "monotone", "residual"]


@pytest.mark.parametrize("kind", KINDS_OF_MAPS)
@pytest.mark.parametrize("integral", [False, True])
def test_code_and_numbers_of_an_export_are_the_recorded_ones(
    tmp_path: Path, kind: str, integral: bool
) -> None:
    controller = device(tmp_path, kind=kind, integral=integral)
    files = render_c_files(controller, origin_text="test", signal_lines=["a", "b"])
    lines = {name: text.splitlines() for name, text in files.items()}
    name = f"code_{kind}_{integral}"
    assert_as_recorded(name, lines, 1e-4)


def written_log(kind: LogKind, folder: Path) -> Path:
    """A short log of a kind, as a file of a plain name."""
    path = folder / f"{kind.name}.csv"
    kind.log(1, samples=700).to_csv(path, index=False)
    return path


def test_logs_are_looked_at_as_recorded(tmp_path: Path) -> None:
    overviews = {}
    for kind in KINDS:
        text = str(look(written_log(kind, tmp_path)))
        overviews[kind.name] = text.replace(str(tmp_path), "FOLDER").splitlines()
    assert_as_recorded("looks", overviews, 1e-4)


JUDGED = ["dead_time", "position_dead_zone", "same_sample", "saturating"]


@pytest.mark.parametrize("name", JUDGED)
def test_a_log_is_judged_as_recorded(name: str, tmp_path: Path) -> None:
    path = written_log(kind_named(name), tmp_path)
    data = RecordedData(path=str(path), input="u", output="y").build(0)
    spec = from_yaml("model", "linear")
    training = from_yaml("training", "default", "max_epochs=1")
    model = training.identify(spec, data, 0, tmp_path).model
    validation, test = simulate_validation_and_test(model, data)
    mismatch = measure_model_error(model, data.validation, 0, data.mismatch_records)
    findings = collect_findings(data, model, validation, test, mismatch)
    metadata = data.metadata | {"path": path.name}
    data = replace(data, metadata=metadata)
    result = {"data": data, "findings": findings, "error": mismatch}
    assert_as_recorded(f"log_{name}", result, 1e-3)
