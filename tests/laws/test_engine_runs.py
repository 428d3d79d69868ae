"""A run is claimed, done and recorded; a finished one is never touched again; a failure is a
record."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from ssm_study.engine import settings as naming
from ssm_study.engine.provenance import provenance_columns
from ssm_study.engine.records import RECORD, parse_record, read_record, write_record
from ssm_study.engine.runs import Run, execute_run, record_with_status
from ssm_study.engine.store import read_intact_manifest
from ssm_study.engine.task import run_folder
from ssm_study.refusal import BadRequest
from ssm_study.study.stages.files import write_json
from ssm_study.study.stages.model import replace_nonfinite_by_none


def good(run: Run) -> dict[str, object]:
    model_path = run.path / "model.json"
    model_path.write_text("{}")
    fit_test_percent = np.float64(91.5)
    return {
        "fit_test_percent": fit_test_percent,
        "mismatch_gain": float("inf"),
        "rmse_test": float("nan"),
    }


def unreachable(_: Run) -> None:
    raise AssertionError("a finished run was done again")


def snapshot(folder: Path) -> dict[str, bytes]:
    paths = folder.rglob("*")
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths if p.is_file()}


def test_a_finished_run_is_recorded_and_never_touched_again(tmp_path: Path) -> None:
    folder = tmp_path / "study" / "run"
    configuration = {"config.yaml": "seed: 3\n", "overrides.yaml": "[]\n"}
    outcome = execute_run(folder, {"seed": 3}, good, configuration=configuration)
    assert outcome.status == "ok"
    assert outcome.did == "ran"
    before = snapshot(folder)
    assert before[".hydra/config.yaml"] == b"seed: 3\n"
    for retry in (False, True):
        did = execute_run(folder, {"seed": 4}, unreachable, retry_failed=retry).did
        assert did == "found"
    assert snapshot(folder) == before
    assert read_intact_manifest(folder) is not None


def test_the_record_is_flat_strict_json_with_provenance(tmp_path: Path) -> None:
    about = provenance_columns(("torch", "no-such-library"), Path(__file__))
    run_path = tmp_path / "study" / "run"
    execute_run(run_path, {"seed": 3}, good, provenance=about)
    text = (run_path / RECORD).read_text()
    record = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    signals = record.values()
    assert all(value is None or isinstance(value, (bool, int, float, str)) for value in signals)
    assert record["study"] == "study"
    assert record["run"] == "run"
    assert record["status"] == "ok"
    assert record["seed"] == 3
    assert record["rmse_test"] is None
    assert record["mismatch_gain"] == "inf"
    assert record["fit_test_percent"] == 91.5
    assert record["version_torch"]
    assert "version_no_such_library" not in record
    assert record["machine_cores"] >= 1
    assert {"git_commit", "git_dirty", "seconds", "started_utc", "host"} <= record.keys()


def test_a_failure_is_a_record_with_its_traceback_and_waits_for_retry(tmp_path: Path) -> None:
    folder = tmp_path / "study" / "run"

    def bad(run: Run) -> None:
        run.add_columns(fit_test_percent=50.0)
        raise RuntimeError("the solver\ngave up")

    status = execute_run(folder, {"seed": 1}, bad).status
    assert status == "failed"
    record = read_record(folder)
    assert record is not None
    assert record["status"] == "failed"
    assert record["error_message"] == "the solver gave up"
    assert record["error_type"] == "RuntimeError"
    assert record["fit_test_percent"] == 50.0
    text = (folder / "traceback.txt").read_text()
    assert "in bad" in text
    did = execute_run(folder, {}, unreachable).did
    assert did == "left"
    status = execute_run(folder, {"seed": 1}, good, retry_failed=True).status
    assert status == "ok"
    again = read_record(folder)
    assert again is not None
    assert again["attempt"] == 2
    assert not (folder / "traceback.txt").exists()
    traceback_path = folder / "attempts" / "1" / "traceback.txt"
    text = traceback_path.read_text()
    assert "gave up" in text


def test_retrying_failures_starts_nothing_new(tmp_path: Path) -> None:
    run_path = tmp_path / "study" / "run"
    outcome = execute_run(run_path, {}, unreachable, retry_failed=True)
    assert outcome.status == "absent"
    assert outcome.did == "left"


@pytest.mark.parametrize(
    ("error", "transient"),
    [
        (OSError(28, "no space"), True),
        (MemoryError(), True),
        (FileNotFoundError("x"), False),
        (ValueError(), False),
    ],
)
def test_what_the_machine_did_is_tried_again_by_the_same_command(
    tmp_path: Path, error: Exception, transient: bool
) -> None:
    def bad(_: Run) -> None:
        raise error

    r_path = tmp_path / "s" / "r"
    execute_run(r_path, {}, bad)
    did = execute_run(r_path, {}, good).did
    assert did == ("ran" if transient else "left")


def test_a_run_that_is_stopped_is_lost_and_then_done(tmp_path: Path) -> None:
    folder = tmp_path / "study" / "run"

    def stopped(run: Run) -> None:
        half_path = run.path / "half.json"
        half_path.write_text("{")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute_run(folder, {"seed": 1}, stopped)
    record = read_record(folder)
    assert record is not None
    assert record["status"] == "lost"
    status = execute_run(folder, {"seed": 1}, good).status
    assert status == "ok"
    assert not (folder / "half.json").exists()


LIVING = """
import sys, time
from pathlib import Path
from ssm_study.engine.runs import execute
def work(run):
    print("working", flush=True)
    time.sleep(600)
execute(Path(sys.argv[1]), {"seed": 1}, work)
"""


def test_a_living_run_is_left_to_its_process(tmp_path: Path) -> None:
    folder = tmp_path / "study" / "run"
    living = subprocess.Popen(
        [sys.executable, "-c", LIVING, str(folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert living.stdout is not None
        assert living.stdout.readline() == "working\n"
        status = (read_record(folder) or {})["status"]
        assert status == "running"
        did = execute_run(folder, {}, unreachable).did
        assert did == "elsewhere"
    finally:
        living.kill()
        living.communicate(timeout=30)
    status = (read_record(folder) or {})["status"]
    assert status == "lost"


def test_infeasible_is_a_result(tmp_path: Path) -> None:
    r_path = tmp_path / "s" / "r"
    status = execute_run(r_path, {}, lambda _: {"status": "infeasible"}).status
    assert status == "infeasible"
    did = execute_run(r_path, {}, unreachable).did
    assert did == "found"


def test_no_flipped_bit_in_a_record_is_silent(tmp_path: Path) -> None:
    record = {"status": "ok", "fit_test_percent": 91.25, "run": "a", "note": "ü"}
    write_record(tmp_path, record)
    content = (tmp_path / RECORD).read_bytes()
    assert parse_record(content)["fit_test_percent"] == 91.25
    for bit in range(8 * len(content)):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << (bit % 8)
        record = parse_record(bytes(flipped))
        assert record == {"status": "corrupt"}
    for length in range(len(content)):
        record = parse_record(content[:length])
        status = record["status"]
        assert status == "corrupt"


@pytest.mark.parametrize("name", [RECORD, "model.json", "manifest.json"])
def test_a_damaged_run_is_done_again_by_the_same_command(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "study" / "run"
    execute_run(folder, {"seed": 1}, good)
    (folder / name).write_text('{"status": "ok"}')
    status = (record_with_status(folder) or {})["status"]
    assert status == "corrupt"
    did = execute_run(folder, {"seed": 1}, good).did
    assert did == "ran"
    text = (folder / "attempts" / "1" / name).read_text()
    assert text == '{"status": "ok"}'
    did = execute_run(folder, {"seed": 1}, unreachable).did
    assert did == "found"


CONFIG = {
    "seed": 0,
    "study": "a",
    "results_dir": "/x",
    "model": {"order": 8, "hidden_width": 32},
    "copy": "${model.order}",
}


SHOWN = ("order:model.order", "width:model.hidden_width", "seed:seed", "none:no.such.key")


def test_a_run_is_named_by_what_it_computes_alone() -> None:
    def named(**changed: object) -> str:
        config = OmegaConf.create(CONFIG | changed)
        return naming.run_name(config, *SHOWN)

    name = named()
    assert name.startswith("order8-width32-seed0-")
    assert named(study="b", results_dir="/y", retry_failed=True, dry_run=True) == name
    assert named(copy=8.0) == name
    assert named(seed=1) != name
    hydra = {"x": 1}
    resolved = OmegaConf.create(
        CONFIG | {"run": f"${{run_name:{','.join(SHOWN)}}}", "hydra": hydra}
    )
    assert resolved.run == name


def test_a_saved_configuration_reads_back_to_the_same_values() -> None:
    """OmegaConf reads more texts as numbers than YAML does; and `reproduce` goes by the file."""
    words = [
        "1e5",
        "nan",
        "-inf",
        ".5",
        "010",
        "1:30",
        "yes",
        "null",
        "~",
        "",
        "a: b",
        "# c",
        "${x}",
        "é",
        "two\nlines",
    ]
    numbers = [1e5, 1e-9, -3, True, None]
    inner = {"a": {}, "b": [], "1e3": 2}
    values = {"texts": words, "numbers": numbers, "inner": inner}
    omega_conf = OmegaConf.to_container(OmegaConf.create(naming.yaml_text(values)))
    assert omega_conf == values


@pytest.mark.parametrize(
    ("study", "name"),
    [
        ("..", "r"),
        ("a/b", "r"),
        ("s", "../r"),
        ("s", "/etc"),
        ("s", ""),
        ("s", ".hidden"),
        ("s", "x" * 300),
    ],
)
def test_a_run_cannot_leave_the_results_folder(tmp_path: Path, study: str, name: str) -> None:
    settings = {"results_dir": str(tmp_path), "study": study, "run": name}
    with pytest.raises(BadRequest, match=r"no name|plain folder name"):
        run_folder(settings)


def test_a_record_takes_no_nested_values(tmp_path: Path) -> None:
    matrix = [[1, 2]]
    record = {"status": "ok", "matrix": matrix}
    with pytest.raises(BadRequest, match="flat record"):
        write_record(tmp_path, record)


def test_a_fit_that_left_the_finite_is_a_gap_in_the_curve(tmp_path):
    curve = [
        {"epoch": 0.0, "fit_training_percent": -math.inf},
        {"epoch": 1.0, "fit_training_percent": 80.0},
    ]
    write_json(tmp_path / "curve.json", replace_nonfinite_by_none(curve))
    text = (tmp_path / "curve.json").read_text()
    kept = json.loads(text)
    fit_training_percents = [row["fit_training_percent"] for row in kept]
    assert fit_training_percents == [None, 80.0]
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "curve.json", curve)
