"""A small file that stands for a large one is refused before anything is made of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml  # type: ignore[import-untyped]

from ssm_study.engine.settings import yaml_text
from ssm_study.refusal import BadRequest
from ssm_study.stored_yaml import read_stored_yaml
from ssm_study.study.findings import CheckedClaim
from ssm_study.study.verify import UNGIVEN, finding_lines

FIRST_ALIAS = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]"
FIRST_INTERPOLATION = "a0: xxxxxxxx"


def alias_ten_times(i: int) -> str:
    """A list of ten times the list before."""
    aliases = ",".join([f"*a{i - 1}"] * 10)
    return f"a{i}: &a{i} [{aliases}]"


def interpolate_three_times(i: int) -> str:
    """A text of three times the text before."""
    before = f"${{a{i - 1}}}"
    return f"a{i}: {before * 3}"


ALIAS_LINES = [alias_ten_times(i) for i in range(1, 12)]
ALIASES = "\n".join([FIRST_ALIAS, *ALIAS_LINES])
INTERPOLATION_LINES = [interpolate_three_times(i) for i in range(1, 20)]
INTERPOLATIONS = "\n".join([FIRST_INTERPOLATION, *INTERPOLATION_LINES])
TEXTS = {
    "aliases": ALIASES,
    "an alias of itself": "a: &a [*a]",
    "interpolations": INTERPOLATIONS,
    "no YAML": "a: [",
    "two documents": "a: 1\n---\nb: 2\n",
    "depth": "[" * 5000,
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_a_stored_configuration_that_stands_for_more_than_itself_is_refused(
    tmp_path: Path, text: str
) -> None:
    """500 bytes of aliases hung verify, report, export, reproduce and refine."""
    assert len(text) < 6000
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(BadRequest, match=r"config\.yaml"):
        read_stored_yaml(file)


def test_what_the_engine_writes_is_read_although_a_value_stands_in_it_twice(tmp_path: Path) -> None:
    shared = {"order": 4}
    file = tmp_path / "config.yaml"
    few = [1.0e-5, "1e5"]
    file.write_text(yaml_text({"model": shared, "again": shared, "few": few}))
    assert "&" not in file.read_text()
    content = yaml.safe_load(read_stored_yaml(file))
    again = content["again"]
    assert again == shared
    file.write_text("few: &few [1, 2]\nagain: *few\n")  # the control: a few aliases are no bomb
    content = yaml.safe_load(read_stored_yaml(file))
    again = content["again"]
    assert again == [1, 2]


def test_reproduce_answers_at_once(tmp_path: Path) -> None:
    run = tmp_path / "study" / "run"
    (run / ".hydra").mkdir(parents=True)
    config_path = run / ".hydra" / "config.yaml"
    config_path.write_text(ALIASES)
    from ssm_study.engine.records import write_record

    record = {"status": "ok", "study": "study", "run": "run"}
    write_record(run, record)
    command = [sys.executable, "-m", "ssm_study.cli", "reproduce", str(run)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2
    assert "aliases make" in ended.stderr


def test_one_cause_is_one_line() -> None:
    """One unreadable file was told seven times, and eighty columns after it."""
    cause = "cannot be derived: the file is damaged"
    checked = CheckedClaim(claim="files", holds=True, found="as written")
    underived = f"yet {UNGIVEN}"
    data = CheckedClaim(claim="data", holds=False, found=cause)
    order = CheckedClaim(claim="order", holds=False, found=f"stored 4, {underived}")
    model = CheckedClaim(claim="model", holds=False, found=cause)
    seed = CheckedClaim(claim="seed", holds=False, found=f"stored 0, {underived}")
    run = CheckedClaim(claim="run", holds=False, found="derived a, stored b")
    findings = [checked, data, order, model, seed, run]
    expected = [
        "holds  files: as written",
        f"FAILS  data, model: {cause}",
        f"FAILS  order, seed: {UNGIVEN}",
        "FAILS  run: derived a, stored b",
    ]
    assert finding_lines(findings) == expected
    second_line = finding_lines([data, order])[1]
    assert second_line == f"FAILS  order: stored 4, yet {UNGIVEN}"
