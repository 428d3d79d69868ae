"""Overlay of runs: the same table as each run's own fit and as `st.compare`, and its refusals."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from report_runs import random_run, write_recordings

from ssm_study.api.comparing import compare_simulations
from ssm_study.cli.main import main
from ssm_study.engine.records import write_record
from ssm_study.refusal import BadRequest
from ssm_study.report.overlay import compare_free_runs, distinguishing_run_names
from ssm_study.report.study_folder import RunFolder
from ssm_study.signals import fit_percent


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    """Three runs: two of one record, one of another."""
    names = ("order4-seed0-aa", "order8-seed0-bb", "order4-seed1-cc")
    folders = [tmp_path / name for name in names]
    for seed, folder in zip((0, 0, 1), folders, strict=True):
        run = random_run(folder, kind="mlp", channels=1, seed=1)
        write_recordings(run, seed=seed)
        (folder / "record.json").write_text("{}")
    return folders


def test_the_table_has_the_fit_of_each_runs_own_recording(runs: list[Path]) -> None:
    comparison = compare_free_runs(runs[:2])
    run_folder = RunFolder(path=runs[0])
    test = run_folder.test
    assert test is not None
    own_fit = fit_percent(test["measured"][0], test["simulated"][0])
    expected = [own_fit, own_fit]
    assert comparison.table["fit_percent"].tolist() == pytest.approx(expected)
    index = comparison.table.index
    expected = {"order4-aa", "order8-bb"}
    assert set(index) == expected
    assert isinstance(comparison.plot(), Figure)


def test_runs_of_different_records_are_refused_in_a_sentence(runs: list[Path]) -> None:
    with pytest.raises(BadRequest, match=r"its test record is not that of .*order4-seed0-aa"):
        compare_free_runs(runs)
    with pytest.raises(BadRequest, match="name two different runs or more"):
        compare_free_runs(runs[:1])
    test_path = runs[1] / "test.mcap"
    test_path.unlink()
    with pytest.raises(BadRequest, match="it left no test record"):
        compare_free_runs(runs[:2])


def test_the_command_prints_the_table_and_draws(
    runs: list[Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    picture = tmp_path / "both.png"
    assert main(["overlay", str(runs[0]), str(runs[1]), "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "fit_percent" in printed
    assert "order8-bb" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["overlay", str(runs[0]), str(runs[2])]) == 2


def test_runs_of_two_studies_are_named_with_them_and_their_baseline_stands_below(
    runs: list[Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Models with and without a measured load are told apart in the table."""
    loaded = runs[0].parent / "loaded" / runs[1].name
    shutil.copytree(runs[1], loaded)
    write_record(runs[0], {"fit_baseline_percent": 91.25, "baseline": "an ARX model"})
    write_record(
        loaded, {"fit_baseline_percent": 95.04, "baseline": "NARX", "disturbances": "load"}
    )
    picture = tmp_path / "both.png"
    assert main(["overlay", str(runs[0]), str(loaded), "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "loaded/order8-bb" in printed
    assert f"{runs[0].parent.name}/order4-aa" in printed
    assert "measured disturbances" in printed
    assert "best baseline on this record: 95.0 %, NARX (not drawn)" in printed


def test_names_of_runs_in_two_studies_that_are_alike_say_their_study(runs: list[Path]) -> None:
    other_path = runs[0].parent / "other"
    other = other_path / runs[0].name
    shutil.copytree(runs[0], other)
    names = distinguishing_run_names([runs[0], other])
    paths = (runs[0], other)
    expected = [f"{path.parent.name}/{path.name}" for path in paths]
    assert names == expected


def test_several_records_are_scored_together_and_the_longest_is_drawn() -> None:
    rng = np.random.default_rng(0)
    measured = [rng.standard_normal((n, 1)) for n in (50, 80)]
    good = [0.9 * y for y in measured]
    bad = [0.1 * y for y in measured]
    simulated = {"good": good, "bad": bad}
    states = {"good": 2, "bad": None}
    comparison = compare_simulations(
        measured, simulated, output_names=["y"], step_s=0.1, states=states, start_up_samples=10
    )
    index = list(comparison.table.index)
    assert index == ["good", "bad"]
    whole = np.concatenate([y[10:] for y in measured])
    expected = fit_percent(whole, 0.9 * whole)
    assert comparison.table.loc["good", "fit_percent"] == pytest.approx(expected)
    expected = len(comparison.time_s)
    assert len(comparison.measured) == expected == 80
