"""The benchmark records: official splits, and our scoring reproduces published rows by ordinary
least squares."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.errors import InstantiationException
from plants_cases import from_yaml
from scipy.io import loadmat, savemat

from ssm_study.data.metrics import benchmark_rmse, position_rmse_mm
from ssm_study.data.readers.text import TextReader as CsvReader
from ssm_study.data.recording import Recording
from ssm_study.evidence.feedback import EARLIER, PRESENT, feedback_error_reduction
from ssm_study.refusal import BadRequest
from ssm_study.signals import DataSet, Trajectory

pytestmark = pytest.mark.data


@pytest.fixture
def built(benchmark_data: Path, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    monkeypatch.setenv("SSM_STUDY_DATA", str(benchmark_data))

    def build_benchmark(name: str, *overrides: str) -> DataSet:
        spec = from_yaml("data", name, *overrides)
        return spec.build(0)

    return build_benchmark


def arx(records: tuple[Trajectory, ...], input_lags: range, constant: bool) -> np.ndarray:
    """`y[k] = a1 y[k-1] + a2 y[k-2] + sum_j b_j u[k-j] (+ c)` by ordinary least squares."""
    rows: list[np.ndarray] = []
    for record in records:
        u = record.u[:, 0]
        y = record.y[:, 0]
        for k in range(2, len(record)):
            row = regressors(u, y, k, input_lags, constant)
            rows.append(row)
    later_outputs = [record.y[2:, 0] for record in records]
    targets = np.concatenate(later_outputs)
    matrix = np.array(rows)
    least_squares = np.linalg.lstsq(matrix, targets, rcond=None)
    return least_squares[0]


def regressors(
    u: np.ndarray, y: np.ndarray, k: int, input_lags: range, constant: bool
) -> np.ndarray:
    past_outputs = [y[k - 1], y[k - 2]]
    past_inputs = [u[k - lag] for lag in input_lags]
    row = [*past_outputs, *past_inputs]
    if constant:
        row.append(1.0)
    return np.array(row)


def free_run(
    theta: np.ndarray, record: Trajectory, start: int, input_lags: range, constant: bool
) -> np.ndarray:
    y = record.y[:, 0].copy()
    u = record.u[:, 0]
    for k in range(start, len(y)):
        row = regressors(u, y, k, input_lags, constant)
        y[k] = row @ theta
    return y[:, None]


def test_the_tanks_row_of_arx_is_reproduced(built) -> None:  # type: ignore[no-untyped-def]
    """Champneys et al. 2024 publish 0.685 V for ARX; their lags are not stated, these are of second
    order."""
    data = built("cascaded_tanks")
    lags = range(3)
    theta = arx(data.training, lags, constant=True)
    start = data.start_up_samples
    y_hat = free_run(theta, data.test[0], start, lags, constant=True)
    rmse = benchmark_rmse(data, (y_hat,))[0]
    assert rmse == pytest.approx(0.685, abs=0.0015)


def test_the_drives_row_of_arx_is_reproduced(built) -> None:  # type: ignore[no-untyped-def]
    """Champneys et al. 2024 publish 0.291 / 0.331 ticks/s: one model per record, second order, no
    constant."""
    data = built("ced")
    lags = range(2)
    start = data.start_up_samples
    y_hat = []
    for train, test in zip(data.training, data.test, strict=True):
        theta = arx((train,), lags, constant=False)
        run = free_run(theta, test, start, lags, constant=False)
        y_hat.append(run)
    actual = benchmark_rmse(data, tuple(y_hat))
    expected = [0.291, 0.331]
    np.testing.assert_allclose(actual, expected, atol=0.0025)


def lengths_of(records: tuple[Trajectory, ...]) -> list[int]:
    return [len(record) for record in records]


def test_official_splits(built) -> None:  # type: ignore[no-untyped-def]
    tanks = built("cascaded_tanks")
    drives = built("ced")
    servo = built("emps")
    assert lengths_of(tanks.training) == [1024]
    assert lengths_of(tanks.test) == [1024]
    assert lengths_of(drives.training) == [400, 400]
    assert lengths_of(drives.test) == [100, 100]
    assert servo.step_s == pytest.approx(0.01)
    expected = 24841 // 10 - 1
    servo_test = servo.test[0]
    assert len(servo_test) == expected
    assert tanks.start_up_samples == 5
    assert drives.start_up_samples == 10
    assert servo.start_up_samples == 2


def test_the_silverbox_is_cut_where_its_loader_cuts_it(built, benchmark_data: Path) -> None:  # type: ignore[no-untyped-def]
    """Multisine: 86,750 samples, three quarters of them before the test; the arrow's first 32,000
    stay in range."""
    data = built("silverbox")
    path = benchmark_data / "silverbox" / "SNLS80mV.mat"
    variables = loadmat(path)
    raw = variables["V2"][0]
    multisine = raw[40650:127400]
    cut = round(0.75 * 86750)
    records = (*data.training, *data.validation)
    outputs = [record.y[:, 0] for record in records]
    trained = np.concatenate(outputs)
    np.testing.assert_array_equal(trained, multisine[:cut])
    test_outputs = [record.y[:, 0] for record in data.test]
    multisine_output, arrow_output, arrow_in_range = test_outputs
    np.testing.assert_array_equal(multisine_output, multisine[cut:])
    actual = arrow_output[:32000]
    np.testing.assert_array_equal(actual, arrow_in_range)
    y_hat = tuple(record.y + 1e-3 for record in data.test)
    rmse = benchmark_rmse(data, y_hat)
    expected = (1.0, 1.0, 1.0)
    assert rmse == pytest.approx(expected)


def test_the_servo_velocity_integrates_to_the_measured_position(
    built, benchmark_data: Path
) -> None:  # type: ignore[no-untyped-def]
    record = built("emps").test[0]
    path = benchmark_data / "emps" / "DATA_EMPS_PULSES.mat"
    variables = loadmat(path)
    qm = variables["qm"][:, 0]
    position = qm[:24840:10]
    velocity = record.y[:, 0]
    running_sum = np.cumsum(velocity)
    actual = position[0] + running_sum * record.step_s
    expected = position[1:]
    np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_the_position_score_is_that_of_the_position_itself(built) -> None:  # type: ignore[no-untyped-def]
    """Route two: integrate both, compare positions; a constant velocity error v drifts by v t."""
    record = built("emps").test[0]
    wrong = record.y + 1e-3
    position = np.cumsum(record.y[2:, 0]) * record.step_s
    position_hat = np.cumsum(wrong[2:, 0]) * record.step_s
    squared_error = (position - position_hat) ** 2
    mean = np.mean(squared_error)
    expected = 1000 * np.sqrt(mean)
    rmse_mm = position_rmse_mm(record, wrong, 2)
    assert rmse_mm == pytest.approx(expected, rel=1e-9)
    drift_mm = 24.8 / np.sqrt(3)
    assert expected == pytest.approx(drift_mm, rel=0.01)


def test_decimation_keeps_what_a_hold_would_have_applied(benchmark_data: Path) -> None:
    path = str(benchmark_data / "emps" / "DATA_EMPS_PULSES.mat")
    signals = {"path": path, "input": "vir", "output": "qm"}
    fine = Recording(**signals, step_s=0.001, decimate=1).read_experiment()
    coarse = Recording(**signals, step_s=0.001, decimate=10).read_experiment()
    expected = fine.y[:24840:10]
    np.testing.assert_array_equal(coarse.y, expected)
    actual = coarse.u[:, 0]
    blocks = fine.u[:24840, 0].reshape(-1, 10)
    expected = blocks.mean(axis=1)
    np.testing.assert_allclose(actual, expected)


def test_scales_and_equilibria_of_records(built) -> None:  # type: ignore[no-untyped-def]
    tanks = built("cascaded_tanks")
    servo = built("emps")
    actual = tanks.scale.output_equilibrium
    training_y = tanks.training[0].y
    expected = training_y.mean(axis=0)
    np.testing.assert_allclose(actual, expected)
    input_equilibrium = servo.scale.input_equilibrium
    np.testing.assert_array_equal(input_equilibrium, [-0.0923])
    output_equilibrium = servo.scale.output_equilibrium
    np.testing.assert_array_equal(output_equilibrium, [0.0])


def test_several_experiments_of_different_lengths(built) -> None:  # type: ignore[no-untyped-def]
    training = built("ced", "training.0.last=250").training
    assert lengths_of(training) == [250, 400]


NO_RECORDS = r"data\.folder = None: the ced records are neither .*benchmarks\]"


class TestWhereRecordsLie:
    def test_nowhere(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.delenv("SSM_STUDY_DATA", raising=False)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", None)
        with pytest.raises(BadRequest, match=NO_RECORDS):
            from_yaml("data", "ced").build(0)

    def test_downloaded_as_mat(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, benchmark_data: Path
    ) -> None:
        """The official package keeps MAT files; the yaml names the CSV twin."""
        names = ["u11", "u12", "z11", "z12"]
        path = benchmark_data / "ced" / "DATAUNIF.csv"
        target = tmp_path / "DATAUNIF.MAT"
        mat_of_csv(path, names, target)
        monkeypatch.delenv("SSM_STUDY_DATA", raising=False)
        monkeypatch.chdir(tmp_path)
        package = SimpleNamespace(CED=lambda data_file_locations: str(target))  # noqa: ARG005
        monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", package)
        data = from_yaml("data", "ced").build(0)
        test_y = data.test[0].y
        actual = test_y[:, 0]
        columns = CsvReader().read_columns(path, names).columns
        expected = columns["z11"][400:]
        np.testing.assert_array_equal(actual, expected)

    def test_a_download_that_fails(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        def fails(data_file_locations: bool) -> None:  # noqa: ARG001
            raise OSError("no network")

        monkeypatch.delenv("SSM_STUDY_DATA", raising=False)
        monkeypatch.chdir(tmp_path)
        package = SimpleNamespace(CED=fails)
        monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", package)
        with pytest.raises(BadRequest, match="no network"):
            from_yaml("data", "ced").build(0)


def test_the_two_scores_of_the_servo_agree(built) -> None:  # type: ignore[no-untyped-def]
    """A position error of 1 mm everywhere, once as a position and once as the velocity that
    integrates to it."""
    position = built("emps_position")
    velocity = built("emps")
    test_y = position.test[0].y
    y_hat = (test_y + 1e-3,)
    position_rmse = benchmark_rmse(position, y_hat)[0]
    assert position_rmse == pytest.approx(1.0)
    test_y = velocity.test[0].y
    kicked = test_y.copy()
    start = velocity.start_up_samples
    kicked[start] += 1e-3 / velocity.step_s
    velocity_rmse = benchmark_rmse(velocity, (kicked,))[0]
    assert velocity_rmse == pytest.approx(1.0)


def build_folds(name: str) -> list[DataSet]:
    """The four folds of a benchmark whose test file is nowhere."""
    no_test_file = ("test.0.path=nowhere.csv", "start_up_samples=0")
    folds = []
    for k in range(4):
        spec = from_yaml("data", name, f"fold={k}", *no_test_file)
        folds.append(spec.build(0))
    return folds


def count_samples(records: tuple[Trajectory, ...]) -> int:
    lengths = lengths_of(records)
    return sum(lengths)


@pytest.mark.parametrize("name", ["ced", "cascaded_tanks", "emps_position"])
def test_a_fold_opens_no_test_file_and_scores_what_it_held_out(built, name: str) -> None:  # type: ignore[no-untyped-def]
    """The pieces of all folds are the training records, each once; what a fold keeps and holds out
    do not overlap."""
    whole = built(name, "start_up_samples=0")
    folds = build_folds(name)
    for i, record in enumerate(whole.training):
        pieces = [fold.test[i].y for fold in folds]
        actual = np.concatenate(pieces)
        np.testing.assert_array_equal(actual, record.y)
    expected = count_samples(whole.training)
    for fold in folds:
        parts = (*fold.training, *fold.test)
        assert count_samples(parts) == expected
        for validated, trained in zip(fold.validation, fold.training, strict=True):
            assert validated.y is trained.y


def test_a_fold_that_is_none() -> None:
    for wrong in ("fold=4", "fold=-1", "folds=1"):
        with pytest.raises(InstantiationException, match=r"data\.fold"):
            from_yaml("data", "ced", wrong)


START_UP = {"EMPS": (20, 0), "CED": (10, 10), "Cascaded_Tanks": (50, 5)}
OUR_NAMES = {"EMPS": "emps_position", "CED": "ced", "Cascaded_Tanks": "cascaded_tanks"}


def assert_equal_parts(theirs, records: tuple[Trajectory, ...]) -> None:  # type: ignore[no-untyped-def]
    """Their records, taken at our step, are ours."""
    for their_record, record in zip(theirs, records, strict=True):
        sampling_time = float(their_record.sampling_time)
        every = round(record.step_s / sampling_time)
        actual = record.y[:, 0]
        end = every * len(record)
        expected = np.ravel(their_record.y)[:end:every]
        np.testing.assert_array_equal(actual, expected)


def test_the_official_package_splits_and_scores_as_we_do(
    built, benchmark_data: Path, monkeypatch, tmp_path: Path
) -> None:  # type: ignore[no-untyped-def]
    """Its own loaders on the same files: equal samples in both parts. Start-up as it says, but for
    the tanks (50)."""
    official = pytest.importorskip("nonlinear_benchmarks", reason="extra benchmarks")
    source = benchmark_data / "ced" / "DATAUNIF.csv"
    target = tmp_path / "DATAUNIF.MAT"
    names = ["u11", "u12", "z11", "z12"]
    mat_of_csv(source, names, target)
    tanks = tmp_path / "CascadedTanksFiles" / "dataBenchmark.mat"
    names = ["uEst", "uVal", "yEst", "yVal"]
    source = benchmark_data / "cascaded_tanks" / "dataBenchmark.csv"
    mat_of_csv(source, names, tanks, Ts=4.0)
    emps_path = str(benchmark_data / "emps")
    folder = str(tmp_path)
    places = {"EMPS": emps_path, "CED": folder, "Cascaded_Tanks": folder}
    download = "nonlinear_benchmarks.benchmarks.cashed_download"
    monkeypatch.setattr(download, lambda _, name, **__: places[name])
    for name, ours in OUR_NAMES.items():
        data = built(ours)
        load = getattr(official, name)
        training, test = as_tuples(load())
        assert_equal_parts(training, data.training)
        assert_equal_parts(test, data.test)
        window = test[0].state_initialization_window_length
        assert (window, data.start_up_samples) == START_UP[name]


def as_tuples(parts):  # type: ignore[no-untyped-def]
    """Training and test, each a tuple of records, whether the package gives one record or
    several."""
    return [part if isinstance(part, tuple) else (part,) for part in parts]


def mat_of_csv(source: Path, names: list[str], target: Path, **more: float) -> None:
    """The MAT twin of a record that is at hand as CSV."""
    table = CsvReader().read_columns(source, names)
    columns = {name: values[:, None] for name, values in table.columns.items()}
    target.parent.mkdir(exist_ok=True)
    savemat(target, columns | more, appendmat=False)


OPEN_LOOP = ("ced", "cascaded_tanks", "silverbox")
CLOSED_LOOP = ("emps", "emps_position")
IN_OPEN_LOOP = [(name, False) for name in OPEN_LOOP]
IN_CLOSED_LOOP = [(name, True) for name in CLOSED_LOOP]


@pytest.mark.parametrize(("name", "closed"), [*IN_CLOSED_LOOP, *IN_OPEN_LOOP])
def test_of_the_benchmarks_only_the_servo_was_recorded_in_a_closed_loop(
    built, name, closed
) -> None:  # type: ignore[no-untyped-def]
    data = built(name)
    with_earlier = feedback_error_reduction(data, 1) > EARLIER
    assert (with_earlier or feedback_error_reduction(data, 0) > PRESENT) == closed
