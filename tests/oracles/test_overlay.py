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
    seeds = (0, 0, 1)
    seeds_and_folders = zip(seeds, folders, strict=True)
    for seed, folder in seeds_and_folders:
        run = random_run(folder, kind="mlp", channels=1, seed=1)
        write_recordings(run, seed=seed)
        (folder / "record.json").write_text("{}")
    return folders


def test_the_table_has_the_fit_of_each_runs_own_recording(runs: list[Path]) -> None:
    comparison = compare_free_runs(runs[:2])
    run_folder = RunFolder(path=runs[0])
    test = run_folder.test
    assert test is not None
    measured = test["measured"][0]
    simulated = test["simulated"][0]
    own_fit = fit_percent(measured, simulated)
    expected = [own_fit, own_fit]
    column = comparison.table["fit_percent"]
    fits = column.tolist()
    expected_fits = pytest.approx(expected)
    assert fits == expected_fits
    index = comparison.table.index
    expected = {"order4-aa", "order8-bb"}
    assert set(index) == expected
    figure = comparison.plot()
    assert isinstance(figure, Figure)


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
    first_run = str(runs[0])
    second_run = str(runs[1])
    arguments = ["overlay", first_run, second_run, "--picture", str(picture)]
    status = main(arguments)
    assert status == 0
    printed = capsys.readouterr().out
    assert "fit_percent" in printed
    assert "order8-bb" in printed
    content = picture.read_bytes()
    assert content.startswith(b"\x89PNG")
    first_run = str(runs[0])
    third_run = str(runs[2])
    other_arguments = ["overlay", first_run, third_run]
    status_of_different = main(other_arguments)
    assert status_of_different == 2


def test_runs_of_two_studies_are_named_with_them_and_their_baseline_stands_below(
    runs: list[Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Models with and without a measured load are told apart in the table."""
    study = runs[0].parent
    loaded = study / "loaded" / runs[1].name
    shutil.copytree(runs[1], loaded)
    record_of_first = {"fit_baseline_percent": 91.25, "baseline": "an ARX model"}
    write_record(runs[0], record_of_first)
    record_of_loaded = {"fit_baseline_percent": 95.04, "baseline": "NARX", "disturbances": "load"}
    write_record(loaded, record_of_loaded)
    picture = tmp_path / "both.png"
    first_run = str(runs[0])
    arguments = ["overlay", first_run, str(loaded), "--picture", str(picture)]
    status = main(arguments)
    assert status == 0
    printed = capsys.readouterr().out
    assert "loaded/order8-bb" in printed
    assert f"{runs[0].parent.name}/order4-aa" in printed
    assert "measured disturbances" in printed
    assert "best baseline on this record: 95.0 %, NARX (not drawn)" in printed


def test_names_of_runs_in_two_studies_that_are_alike_say_their_study(runs: list[Path]) -> None:
    other_path = runs[0].parent / "other"
    other = other_path / runs[0].name
    shutil.copytree(runs[0], other)
    both_runs = [runs[0], other]
    names = distinguishing_run_names(both_runs)
    paths = (runs[0], other)
    expected = [f"{path.parent.name}/{path.name}" for path in paths]
    assert names == expected


def test_several_records_are_scored_together_and_the_longest_is_drawn() -> None:
    rng = np.random.default_rng(0)
    lengths = (50, 80)
    measured = [rng.standard_normal((n, 1)) for n in lengths]
    good = [0.9 * y for y in measured]
    bad = [0.1 * y for y in measured]
    simulated = {"good": good, "bad": bad}
    states = {"good": 2, "bad": None}
    comparison = compare_simulations(
        measured, simulated, output_names=["y"], step_s=0.1, states=states, start_up_samples=10
    )
    index = list(comparison.table.index)
    assert index == ["good", "bad"]
    scored = [y[10:] for y in measured]
    whole = np.concatenate(scored)
    expected = fit_percent(whole, 0.9 * whole)
    scores = comparison.table.loc
    fit_of_good = scores["good", "fit_percent"]
    expected_fit = pytest.approx(expected)
    assert fit_of_good == expected_fit
    expected = len(comparison.time_s)
    assert len(comparison.measured) == expected == 80
