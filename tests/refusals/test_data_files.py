"""Files the readers must refuse, each in one sentence that names file, line or field; and their good twins."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from plants_cases import from_yaml
from scipy.io import savemat

from ssm_study.data.mcap import SignalGroup, write_mcap
from ssm_study.data.recorded import RecordedData
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel

T = 200
RNG = np.random.default_rng(0)
GOOD = {"t": np.arange(T) * 0.01, "u": RNG.standard_normal(T), "y": RNG.standard_normal(T)}


def data(log: Path, **changes: object) -> RecordedData:
    fields: dict[str, object] = {"path": str(log), "input": "u", "output": "y", "step_s": 0.01}
    return RecordedData(**(fields | changes))  # type: ignore[arg-type]


def csv(folder: Path, text: str | None = None, **columns: np.ndarray) -> Path:
    path = folder / "log.csv"
    if text is None:
        pd.DataFrame(GOOD | columns).to_csv(path, index=False)
    else:
        path.write_text(text)
    return path


def lines() -> list[str]:
    return pd.DataFrame(GOOD).to_csv(index=False).splitlines()


@pytest.mark.parametrize("suffix", [".csv", ".mat", ".parquet", ".mcap"])
def test_all_formats_give_the_same_numbers(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    if suffix == ".csv":
        pd.DataFrame(GOOD).to_csv(path, index=False)
    elif suffix == ".parquet":
        pd.DataFrame(GOOD).to_parquet(path)
    elif suffix == ".mat":
        savemat(path, GOOD)
    else:
        channels = (Channel(name="u", unit="V"), Channel(name="y", unit="rad/s"))
        values = np.stack([GOOD["u"], GOOD["y"]], axis=1)
        write_mcap(path, (SignalGroup(topic="/log", time_s=GOOD["t"], channels=channels, values=values),), {})
    built = data(path).build(0)
    y = np.concatenate([built.training[0].y, built.validation[0].y, built.test[0].y])
    np.testing.assert_array_equal(y[:, 0], GOOD["y"])
    assert [len(built.training[0]), len(built.validation[0]), len(built.test[0])] == [120, 40, 40]
    assert built.step_s == 0.01


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda rows: [*rows[:50], rows[50].replace(",", ",x", 1), *rows[51:]], r"column u, line 51 = x.*: no number"),
        (lambda rows: rows[1:], r"log.csv \(column\) = u: the header has 0.0, .*; write the names"),
        (lambda rows: [*rows[:50], rows[50] + ",1.0", *rows[51:]], r"Row #51: Expected 3 columns, got 4"),
        (lambda rows: [*rows[:50], rows[50].rsplit(",", 1)[0], *rows[51:]], r"Row #51: Expected 3 columns, got 2"),
        (lambda rows: [rows[0]] + [row + ",7" for row in rows[1:]], r"Expected 3 columns, got 4"),
        (lambda rows: [row.replace(",", ";") for row in rows], r"semicolons"),
        (lambda rows: ["t,u,speed", *rows[1:]], r"log.csv \(column\) = y: the header has t, u, speed"),
        (lambda rows: ["y,u,y", *rows[1:]], r"2 times"),
        (lambda rows: [*rows[:50], "0.49,,1.0", *rows[51:]], r"column u, line 51 = \(empty\).*interpolate"),
        (lambda rows: [*rows[:50], "0.49,nan,1.0", *rows[51:]], r"column u, line 51 = nan"),
        (lambda rows: [*rows[:50], "0.49,1.0,inf", *rows[51:]], r"column y, line 51 = inf"),
        (lambda rows: rows[:1], r"log.csv = .*Empty CSV"),
        (lambda _: [], r"no header"),
        (lambda rows: [rows[0], "\0\0", *rows[1:]], r"NUL"),
    ],
    ids=["text", "no names", "long row", "short row", "shifted", "semicolons", "missing column", "duplicate",
         "empty cell", "nan", "inf", "no rows", "empty file", "nul"],
)  # fmt: skip
def test_malformed_csv(tmp_path: Path, edit, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadRequest, match=says) as refusal:
        data(csv(tmp_path, "\n".join(edit(lines())))).build(0)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"path": "nowhere.csv"}, r"data.path = nowhere.csv: no such file"),
        ({"step_s": None}, r"data.step_s = None: the sampling time is unknown"),
        ({"step_s": 0.0}, r"data.step_s = 0.0: must be positive"),
        ({"step_s": 10.0, "time": "t"}, r"data.step_s = 10.0: the times of log.csv show 0.01 s"),
        ({"output": "u"}, r"is an input too"),
        ({"validation_fraction": 0.6, "test_fraction": 0.6}, r"nothing is left"),
        ({"test_fraction": 0.0}, r"not inside"),
        ({"equilibrium": "median"}, r"none of zero, mean"),
        ({"decimate": 0}, r"at least 1"),
    ],
)
def test_wrong_requests(tmp_path: Path, changes: dict[str, object], says: str) -> None:
    with pytest.raises(BadRequest, match=says):
        data(csv(tmp_path), **changes).build(0)


def test_irregular_sampling_is_refused_and_resampling_offered(tmp_path: Path) -> None:
    t = GOOD["t"].copy()
    t[100:] += 0.003
    path = csv(tmp_path, t=t, y=np.sin(t), u=np.cos(t))
    with pytest.raises(BadRequest, match=r"periods off a uniform clock.*data\.resample=true"):
        data(path, time="t", step_s=None).build(0)
    built = data(path, time="t", step_s=0.01, resample=True).build(0)
    y = np.concatenate([r.y for r in (*built.training, *built.validation, *built.test)])[:, 0]
    np.testing.assert_allclose(y, np.sin(0.01 * np.arange(len(y))), atol=1e-4)


@pytest.mark.parametrize("constant", ["u", "y"])
def test_a_constant_channel(tmp_path: Path, constant: str) -> None:
    with pytest.raises(BadRequest, match=f"{constant} = 2.0: constant over the training records"):
        data(csv(tmp_path, **{constant: np.full(T, 2.0)})).build(0)


def test_mat_of_unequal_lengths(tmp_path: Path) -> None:
    savemat(tmp_path / "log.mat", GOOD | {"y": GOOD["y"][:-1]})
    with pytest.raises(BadRequest, match="columns differ in length"):
        data(tmp_path / "log.mat").build(0)


@pytest.mark.parametrize("value", [np.ones((10, 2)), np.array(["a"]), np.ones(3) + 1j, {"a": 1}])
def test_mat_of_the_wrong_kind(tmp_path: Path, value: object) -> None:
    savemat(tmp_path / "log.mat", GOOD | {"y": value})
    with pytest.raises(BadRequest, match=r"log.mat \(variable\) = y"):
        data(tmp_path / "log.mat").build(0)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("trajectories=0", "data.trajectories = 0"),
        ("samples=5", "data.samples = 5"),
        ("noise_variance=-0.02", "data.noise_variance = -0.02: a variance is never negative"),
        ("start_up_samples=-1", "data.start_up_samples = -1"),
    ],
)
def test_simulated_values(override: str, says: str) -> None:
    with pytest.raises(Exception, match=says):  # hydra wraps what a constructor raises
        from_yaml("data", "simulated", override)


@pytest.mark.parametrize(
    ("choice", "override", "says"),
    [
        ("prbs", "amplitude=-1.0", "excitation.amplitude = -1.0"),
        ("prbs", "register_bits=1", "excitation.register_bits = 1"),
        ("aprbs", "clock_s=0.0", "excitation.clock_s = 0.0"),
        ("aprbs", "longest_hold_clocks=0", "excitation.longest_hold_clocks = 0"),
    ],
)
def test_excitation_values(choice: str, override: str, says: str) -> None:
    with pytest.raises(Exception, match=says):
        from_yaml("excitation", choice, override)


def test_a_clock_shorter_than_the_sampling_time() -> None:
    plant, simulated = from_yaml("plant", "dc_motor"), from_yaml("data", "simulated")
    with pytest.raises(BadRequest, match="shorter than half the sampling time"):
        simulated.build(plant, from_yaml("excitation", "aprbs", "clock_s=0.001"), 0)


def test_an_unknown_suffix(tmp_path: Path) -> None:
    (tmp_path / "log.xlsx").write_bytes(b"PK")
    with pytest.raises(BadRequest, match=r"the suffix is none of \.csv, \.mat, \.parquet, \.mcap"):
        data(tmp_path / "log.xlsx").build(0)
