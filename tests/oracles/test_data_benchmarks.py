"""The benchmark records: official splits, and our scoring reproduces published rows by ordinary
least squares."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.errors import InstantiationException
from plants_cases import from_yaml
from scipy import signal
from scipy.io import loadmat, savemat

from ssm_study.data.metrics import benchmark_rmse, position_rmse_mm
from ssm_study.data.readers.text import TextReader as CsvReader
from ssm_study.data.recording import Recording
from ssm_study.evidence.feedback import EARLIER, PRESENT, feedback_error_reduction
from ssm_study.refusal import BadRequest
from ssm_study.signals import Trajectory

pytestmark = pytest.mark.data


@pytest.fixture
def built(benchmark_data: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    monkeypatch.setenv("SSM_STUDY_DATA", str(benchmark_data))
    return lambda name, *overrides: from_yaml("data", name, *overrides).build(0)


def arx(records: tuple[Trajectory, ...], input_lags: range, constant: bool) -> np.ndarray:
    """`y[k] = a1 y[k-1] + a2 y[k-2] + sum_j b_j u[k-j] (+ c)` by ordinary least squares."""
    rows = [
        regressors(r.u[:, 0], r.y[:, 0], k, input_lags, constant)
        for r in records
        for k in range(2, len(r))
    ]
    targets = np.concatenate([r.y[2:, 0] for r in records])
    least_squares = np.linalg.lstsq(np.array(rows), targets, rcond=None)
    return least_squares[0]


def regressors(
    u: np.ndarray, y: np.ndarray, k: int, input_lags: range, constant: bool
) -> np.ndarray:
    return np.array(
        [y[k - 1], y[k - 2], *(u[k - j] for j in input_lags), *([1.0] if constant else [])]
    )


def free_run(
    theta: np.ndarray, record: Trajectory, start: int, input_lags: range, constant: bool
) -> np.ndarray:
    y = record.y[:, 0].copy()
    for k in range(start, len(y)):
        u = record.u[:, 0]
        y[k] = regressors(u, y, k, input_lags, constant) @ theta
    return y[:, None]


def test_the_tanks_row_of_arx_is_reproduced(built) -> None:  # type: ignore[no-untyped-def]
    """Champneys et al. 2024 publish 0.685 V for ARX; their lags are not stated, these are of second
    order."""
    data = built("cascaded_tanks")
    lags = range(3)
    theta = arx(data.training, lags, constant=True)
    y_hat = free_run(theta, data.test[0], data.start_up_samples, lags, constant=True)
    assert benchmark_rmse(data, (y_hat,))[0] == pytest.approx(0.685, abs=0.0015)


def test_the_drives_row_of_arx_is_reproduced(built) -> None:  # type: ignore[no-untyped-def]
    """Champneys et al. 2024 publish 0.291 / 0.331 ticks/s: one model per record, second order, no
    constant."""
    data = built("ced")
    lags = range(2)
    y_hat = tuple(
        free_run(
            arx((train,), lags, constant=False), test, data.start_up_samples, lags, constant=False
        )
        for train, test in zip(data.training, data.test, strict=True)
    )
    actual = benchmark_rmse(data, y_hat)
    expected = [0.291, 0.331]
    np.testing.assert_allclose(actual, expected, atol=0.0025)


def test_official_splits(built) -> None:  # type: ignore[no-untyped-def]
    tanks = built("cascaded_tanks")
    drives = built("ced")
    servo = built("emps")
    assert [len(r) for r in tanks.training] == [1024]
    assert [len(r) for r in tanks.test] == [1024]
    expected = [400, 400]
    assert [len(r) for r in drives.training] == expected
    expected = [100, 100]
    assert [len(r) for r in drives.test] == expected
    assert servo.step_s == pytest.approx(0.01)
    expected = 24841 // 10 - 1
    assert len(servo.test[0]) == expected
    assert tanks.start_up_samples == 5
    assert drives.start_up_samples == 10
    assert servo.start_up_samples == 2


def test_the_silverbox_is_cut_where_its_loader_cuts_it(built, benchmark_data: Path) -> None:  # type: ignore[no-untyped-def]
    """Multisine: 86,750 samples, three quarters of them before the test; the arrow's first 32,000
    stay in range."""
    data = built("silverbox")
    snls80mv_path = benchmark_data / "silverbox" / "SNLS80mV.mat"
    raw = loadmat(snls80mv_path)["V2"][0]
    records = (*data.training, *data.validation)
    trained = np.concatenate([record.y[:, 0] for record in records])
    expected = raw[40650:127400][: round(0.75 * 86750)]
    np.testing.assert_array_equal(trained, expected)
    tests = [record.y[:, 0] for record in data.test]
    expected = raw[40650:127400][round(0.75 * 86750) :]
    np.testing.assert_array_equal(tests[0], expected)
    actual = tests[1][:32000]
    np.testing.assert_array_equal(actual, tests[2])
    y_hat = tuple(record.y + 1e-3 for record in data.test)
    expected = (1.0, 1.0, 1.0)
    assert benchmark_rmse(data, y_hat) == pytest.approx(expected)


def test_the_servo_velocity_integrates_to_the_measured_position(
    built, benchmark_data: Path
) -> None:  # type: ignore[no-untyped-def]
    record = built("emps").test[0]
    data_emps_pulses_path = benchmark_data / "emps" / "DATA_EMPS_PULSES.mat"
    qm = loadmat(data_emps_pulses_path)["qm"]
    position = qm[:, 0][:24840:10]
    running_sum = np.cumsum(record.y[:, 0])
    actual = position[0] + running_sum * record.step_s
    expected = position[1:]
    np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_the_position_score_is_that_of_the_position_itself(built) -> None:  # type: ignore[no-untyped-def]
    """Route two: integrate both, compare positions; a constant velocity error v drifts by v t."""
    record = built("emps").test[0]
    wrong = record.y + 1e-3
    position, position_hat = (np.cumsum(v[2:, 0]) * record.step_s for v in (record.y, wrong))
    mean = np.mean((position - position_hat) ** 2)
    expected = 1000 * np.sqrt(mean)
    assert position_rmse_mm(record, wrong, 2) == pytest.approx(expected, rel=1e-9)
    assert expected == pytest.approx(24.8 / np.sqrt(3), rel=0.01)


def test_decimation_keeps_what_a_hold_would_have_applied(benchmark_data: Path) -> None:
    path = str(benchmark_data / "emps" / "DATA_EMPS_PULSES.mat")
    everies = (1, 10)
    fine, coarse = (
        Recording(path=path, input="vir", output="qm", step_s=0.001, decimate=every).read()
        for every in everies
    )
    expected = fine.y[:24840:10]
    np.testing.assert_array_equal(coarse.y, expected)
    actual = coarse.u[:, 0]
    expected = fine.u[:24840, 0].reshape(-1, 10).mean(axis=1)
    np.testing.assert_allclose(actual, expected)


def test_scales_and_equilibria_of_records(built) -> None:  # type: ignore[no-untyped-def]
    tanks = built("cascaded_tanks")
    servo = built("emps")
    actual = tanks.scale.output_equilibrium
    training_y = tanks.training[0].y
    expected = training_y.mean(axis=0)
    np.testing.assert_allclose(actual, expected)
    actual = servo.scale.input_equilibrium
    np.testing.assert_array_equal(actual, [-0.0923])
    actual = servo.scale.output_equilibrium
    np.testing.assert_array_equal(actual, [0.0])


def test_several_experiments_of_different_lengths(built) -> None:  # type: ignore[no-untyped-def]
    training = built("ced", "training.0.last=250").training
    expected = [250, 400]
    assert [len(r) for r in training] == expected


class TestWhereRecordsLie:
    def test_nowhere(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.delenv("SSM_STUDY_DATA", raising=False)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", None)
        with pytest.raises(
            BadRequest, match=r"data\.folder = None: the ced records are neither .*benchmarks\]"
        ):
            from_yaml("data", "ced").build(0)

    def test_downloaded_as_mat(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, benchmark_data: Path
    ) -> None:
        """The official package keeps MAT files; the yaml names the CSV twin."""
        names = ["u11", "u12", "z11", "z12"]
        dataunif_path = benchmark_data / "ced" / "DATAUNIF.csv"
        table = CsvReader().read(dataunif_path, names)
        savemat(
            tmp_path / "DATAUNIF.MAT",
            {n: table.columns[n][:, None] for n in names},
            appendmat=False,
        )
        monkeypatch.delenv("SSM_STUDY_DATA", raising=False)
        monkeypatch.chdir(tmp_path)
        package = SimpleNamespace(CED=lambda data_file_locations: str(tmp_path / "DATAUNIF.MAT"))  # noqa: ARG005
        monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", package)
        data = from_yaml("data", "ced").build(0)
        test_y = data.test[0].y
        actual = test_y[:, 0]
        z11 = table.columns["z11"]
        expected = z11[400:]
        np.testing.assert_array_equal(actual, expected)

    def test_a_download_that_fails(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        def fails(data_file_locations: bool) -> None:  # noqa: ARG001
            raise OSError("no network")

        monkeypatch.delenv("SSM_STUDY_DATA", raising=False)
        monkeypatch.chdir(tmp_path)
        simple_namespace = SimpleNamespace(CED=fails)
        monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", simple_namespace)
        with pytest.raises(BadRequest, match="no network"):
            from_yaml("data", "ced").build(0)


def test_the_two_scores_of_the_servo_agree(built) -> None:  # type: ignore[no-untyped-def]
    """A position error of 1 mm everywhere, once as a position and once as the velocity that
    integrates to it."""
    position = built("emps_position")
    velocity = built("emps")
    test_y = position.test[0].y
    y_hat = (test_y + 1e-3,)
    assert benchmark_rmse(position, y_hat)[0] == pytest.approx(1.0)
    test_y = velocity.test[0].y
    kicked = test_y.copy()
    kicked[velocity.start_up_samples] += 1e-3 / velocity.step_s
    assert benchmark_rmse(velocity, (kicked,))[0] == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["ced", "cascaded_tanks", "emps_position"])
def test_a_fold_opens_no_test_file_and_scores_what_it_held_out(built, name: str) -> None:  # type: ignore[no-untyped-def]
    """The pieces of all folds are the training records, each once; what a fold keeps and holds out
    do not overlap."""
    whole = built(name, "start_up_samples=0")
    folds = [
        from_yaml("data", name, f"fold={k}", "test.0.path=nowhere.csv", "start_up_samples=0").build(
            0
        )
        for k in range(4)
    ]
    for i, record in enumerate(whole.training):
        actual = np.concatenate([fold.test[i].y for fold in folds])
        np.testing.assert_array_equal(actual, record.y)
    for fold in folds:
        assert sum(map(len, (*fold.training, *fold.test))) == sum(map(len, whole.training))
        assert all(a.y is b.y for a, b in zip(fold.validation, fold.training, strict=True))


def test_a_fold_that_is_none() -> None:
    for wrong in ("fold=4", "fold=-1", "folds=1"):
        with pytest.raises(InstantiationException, match=r"data\.fold"):
            from_yaml("data", "ced", wrong)


def test_the_official_package_splits_and_scores_as_we_do(
    built, benchmark_data: Path, monkeypatch, tmp_path: Path
) -> None:  # type: ignore[no-untyped-def]
    """Its own loaders on the same files: equal samples in both parts. Start-up as it says, but for
    the tanks (50)."""
    official = pytest.importorskip("nonlinear_benchmarks", reason="extra benchmarks")
    source = benchmark_data / "ced" / "DATAUNIF.csv"
    mat_of_csv(source, ["u11", "u12", "z11", "z12"], tmp_path / "DATAUNIF.MAT")
    tanks = tmp_path / "CascadedTanksFiles" / "dataBenchmark.mat"
    names = ["uEst", "uVal", "yEst", "yVal"]
    source = benchmark_data / "cascaded_tanks" / "dataBenchmark.csv"
    mat_of_csv(source, names, tanks, Ts=4.0)
    emps_path = str(benchmark_data / "emps")
    places = {"EMPS": emps_path, "CED": str(tmp_path), "Cascaded_Tanks": str(tmp_path)}
    monkeypatch.setattr(
        "nonlinear_benchmarks.benchmarks.cashed_download", lambda _, name, **__: places[name]
    )
    for name, ours in (
        ("EMPS", "emps_position"),
        ("CED", "ced"),
        ("Cascaded_Tanks", "cascaded_tanks"),
    ):
        data = built(ours)
        parts = getattr(official, name)()
        for theirs, records in zip(as_tuples(parts), (data.training, data.test), strict=True):
            for one, record in zip(theirs, records, strict=True):
                sampling_time = float(one.sampling_time)
                every = round(record.step_s / sampling_time)
                actual = record.y[:, 0]
                expected = np.ravel(one.y)[: every * len(record) : every]
                np.testing.assert_array_equal(actual, expected)
        window = theirs[0].state_initialization_window_length
        expected = {"EMPS": (20, 0), "CED": (10, 10), "Cascaded_Tanks": (50, 5)}[name]
        assert (window, data.start_up_samples) == expected


def test_our_models_stand_in_other_people_s_tables_by_the_lines_of_the_page() -> None:
    """A lag as a record of the package's own type, and as a sequence of the other's."""
    official = pytest.importorskip("nonlinear_benchmarks.utilities", reason="extra benchmarks")
    parents = Path(__file__).parents
    docs_path = parents[2] / "docs"
    data_path = docs_path / "data.md"
    page = data_path.read_text()
    names: dict = {}
    for block in re.findall(r'^```python title="\w+\.py"\n(.*?)^```', page, re.M | re.S):
        exec(block, names)
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 100).repeat(8)
    y = signal.lfilter([0, 0.1], [1, -0.9], u)
    parts = (slice(500), slice(0, 800))
    train, test = (official.Input_output_data(u[part], y[part], 0.1) for part in parts)
    overrides = (
        "model=ssm",
        "model.order=1",
        "model.hidden_width=4",
        "training.max_epochs=20",
        "data.equilibrium=zero",
    )
    upper_limit = 0.05 * y.std()
    assert names["entry"](train, test, *overrides) < upper_limit
    attrs = {"fs": 10.0}
    simple_namespace = SimpleNamespace(u=u[:500, None], y=y[:500, None], attrs=attrs)
    sequences = [simple_namespace]
    told = {"hyperparameters": {"overrides": overrides}}
    context = SimpleNamespace(get_train_sequences=lambda: iter(sequences), **told)
    predicted = names["build_model"](context)(u[:, None], None, {})
    assert predicted.shape == (800, 1)
    difference = np.abs(predicted[:, 0] - y)
    largest_difference = difference.max()
    assert largest_difference < 0.1


def as_tuples(parts):  # type: ignore[no-untyped-def]
    """Training and test, each a tuple of records, whether the package gives one record or
    several."""
    return [part if isinstance(part, tuple) else (part,) for part in parts]


def mat_of_csv(source: Path, names: list[str], target: Path, **more: float) -> None:
    """The MAT twin of a record that is at hand as CSV."""
    columns = {
        name: values[:, None] for name, values in CsvReader().read(source, names).columns.items()
    }
    target.parent.mkdir(exist_ok=True)
    savemat(target, columns | more, appendmat=False)


@pytest.mark.parametrize(
    ("name", "closed"),
    [
        ("emps", True),
        ("emps_position", True),
        ("ced", False),
        ("cascaded_tanks", False),
        ("silverbox", False),
    ],
)
def test_of_the_benchmarks_only_the_servo_was_recorded_in_a_closed_loop(
    built, name, closed
) -> None:  # type: ignore[no-untyped-def]
    data = built(name)
    assert (
        feedback_error_reduction(data, 1) > EARLIER or feedback_error_reduction(data, 0) > PRESENT
    ) == closed
