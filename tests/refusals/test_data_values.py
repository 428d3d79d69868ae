"""Values of data settings, archives and arrays that the readers must refuse."""

import resource
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from plants_cases import from_yaml
from pyarrow import parquet
from scipy.io import savemat

from ssm_study.data.arrays import write_log_files
from ssm_study.data.experiments import RecordedExperiments
from ssm_study.data.mcap import read_mcap
from ssm_study.data.mcap_records import MAGIC
from ssm_study.data.readers.reader import choose_reader, read_table
from ssm_study.data.recording import Recording
from ssm_study.refusal import BadRequest
from ssm_study.signals import Scale

REFUSED_DATA = [
    ("trajectories=0", "data.trajectories = 0"),
    ("samples=19", "data.samples = 19: "),
    ("noise_variance=-0.02", "data.noise_variance = -0.02: must not be negative"),
    ("start_up_samples=-1", "data.start_up_samples = -1"),
]


@pytest.mark.parametrize(("override", "says"), REFUSED_DATA)
def test_simulated_values(override: str, says: str) -> None:
    with pytest.raises(Exception, match=says):  # hydra wraps what a constructor raises
        from_yaml("data", "simulated", override)


REFUSED_CHOICES = [
    ("prbs", "amplitude=-1.0", "excitation.amplitude = -1.0"),
    ("prbs", "register_bits=1", "excitation.register_bits = 1"),
    ("aprbs", "clock_s=0.0", "excitation.clock_s = 0.0"),
    ("aprbs", "longest_hold_clocks=0", "excitation.longest_hold_clocks = 0"),
]


@pytest.mark.parametrize(("choice", "override", "says"), REFUSED_CHOICES)
def test_excitation_values(choice: str, override: str, says: str) -> None:
    with pytest.raises(Exception, match=says):
        from_yaml("excitation", choice, override)


def test_a_clock_shorter_than_the_sampling_time() -> None:
    plant = from_yaml("plant", "dc_motor")
    simulated = from_yaml("data", "simulated")
    with pytest.raises(BadRequest, match="shorter than half the sampling time"):
        simulated.build(plant, from_yaml("excitation", "aprbs", "clock_s=0.001"), 0)


def test_a_small_file_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path: Path) -> None:
    """Zeros pack to nothing. MCAP's test: tests/oracles/test_data_mcap.py."""
    zeros = np.zeros(10_000_000)
    signals = {"u": zeros, "y": zeros}
    savemat(tmp_path / "a.mat", signals, do_compression=True)
    u = zeros[:1_000_000]
    y = zeros[:1_000_000]
    table = pa.table({"u": u, "y": y})
    with parquet.ParquetWriter(tmp_path / "a.parquet", table.schema) as writer:
        for _ in range(40):
            writer.write_table(table)
    usage_before = resource.getrusage(resource.RUSAGE_SELF)
    before = usage_before.ru_maxrss
    cases = (("a.mat", "more than 128 MiB"), ("a.parquet", "40000000 rows are more than 16777216"))
    for name, words in cases:
        file_facts = (tmp_path / name).stat()
        st_size = file_facts.st_size
        assert st_size < 2**20
        columns = {"u": "", "y": ""}
        with pytest.raises(BadRequest, match=words):
            read_table(tmp_path / name, columns)
    usage_after = resource.getrusage(resource.RUSAGE_SELF)
    ru_maxrss = usage_after.ru_maxrss
    difference = ru_maxrss - before
    assert difference < 350_000  # kilobytes


HUGE_LOGS = {
    "a.mcap": (MAGIC, "more than the 256 MiB that are read; split the recording"),
    "a.mat": (b"MATLAB 5.0 MAT-file", "more than the 128 MiB that are read; split it"),
    "a.csv": (b"u,y\n1,2\n", "more than the 1024 MiB that are read; split it, or convert it"),
}


@pytest.mark.parametrize("name", HUGE_LOGS)
def test_a_huge_file_is_refused_before_it_is_read(name: str, tmp_path: Path) -> None:
    """It has holes in place of content, so it takes no room on the disk."""
    head, words = HUGE_LOGS[name]
    path = tmp_path / name
    with path.open("wb") as file:
        file.write(head)
        file.truncate(2**33)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadRequest, match=rf"^data\.path = .*: has 8192 MiB, {words}"):
        read_table(path, {"u": "", "y": ""})
    with pytest.raises(BadRequest, match=f"has 8192 MiB, {words}"):
        choose_reader(path).read_all_columns(path)
    difference = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert difference < 2**16  # kilobytes


def test_a_file_of_one_byte_too_many_has_more_than_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with path.open("wb") as file:
        file.write(b"MATLAB 5.0 MAT-file")
        file.truncate(2**27 + 1)
    with pytest.raises(BadRequest, match="has 129 MiB, more than the 128 MiB"):
        read_table(path, {"u": ""})


def test_a_huge_recording_of_a_run_is_no_setting_of_the_data(tmp_path: Path) -> None:
    path = tmp_path / "closed_loop.mcap"
    with path.open("wb") as file:
        file.write(MAGIC)
        file.truncate(2**33)
    with pytest.raises(BadRequest, match=r"^path = .*: has 8192 MiB"):
        read_mcap(path)


def test_a_huge_file_that_is_no_recording_is_said_to_be_none(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        file.truncate(2**33)
    with pytest.raises(BadRequest, match="not a complete MCAP recording"):
        read_mcap(path)


NINE_ONES = np.ones(9)
TWO_COLUMNS = np.ones((9, 2))
COLUMN_TWICE = pd.DataFrame(TWO_COLUMNS, columns=["a", "a"])
COLUMN_A = pd.Series(NINE_ONES, name="a")
NO_LOGS = [
    (COLUMN_TWICE, NINE_ONES, r"u, y = \['a', 'a', 'y'\]: .*one name"),
    (COLUMN_A, COLUMN_A, r"u, y = \['a', 'a'\]: .*one name"),
    ([], [], r"u = shape \(0,\): not a signal; give an array \(T, channels\)"),
    ("speed", NINE_ONES, r"u = str: not a table of numbers"),
]


@pytest.mark.parametrize(("u", "y", "says"), NO_LOGS)
def test_arrays_that_are_no_log(tmp_path: Path, u: object, y: object, says: str) -> None:
    with pytest.raises(BadRequest, match=says):
        write_log_files(u, y, tmp_path)


ZERO_SCALE = {"input_scale": [0.0, 1.0]}
NO_EQUILIBRIUM = {"output_equilibrium": [np.nan]}
NO_SCALES = [ZERO_SCALE, NO_EQUILIBRIUM]


@pytest.mark.parametrize("change", NO_SCALES)
def test_scales_that_are_none(change: dict[str, list[float]]) -> None:
    input_scale = [1.0, 1.0]
    input_equilibrium = [0.0, 0.0]
    sides = {
        "input_scale": input_scale,
        "output_scale": [1.0],
        "input_equilibrium": input_equilibrium,
    }
    all_sides = sides | {"output_equilibrium": [0.0]}
    numbers = all_sides | change
    sides_and_values = numbers.items()
    arrays = {name: np.array(values) for name, values in sides_and_values}
    with pytest.raises(
        BadRequest, match="needs positive scales, and one finite equilibrium value for each"
    ):
        Scale(**arrays)


PARTS = ["training", "validation", "test"]


@pytest.mark.parametrize("part", PARTS)
def test_experiments_without_a_recording(part: str) -> None:
    recording = Recording(path="log.csv", input="u", output="y", step_s=0.01)
    recordings = [recording]
    parts = dict.fromkeys(PARTS, recordings)
    RecordedExperiments(benchmark="own", **parts)
    fields = parts | {part: []}
    with pytest.raises(
        BadRequest, match=f"data.{part} = none: no recording is named; name at least one"
    ):
        RecordedExperiments(benchmark="own", **fields)
