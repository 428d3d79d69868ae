"""Damaged files of a run are claims that do not hold, in sentences of ours."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from verify_lies import edited

from ssm_study.data.mcap import read_mcap, write_mcap
from ssm_study.durable import file_lock
from ssm_study.engine.records import LOCK, write_record
from ssm_study.refusal import BadRequest
from ssm_study.study.findings import CheckedClaim
from ssm_study.study.verify import finding_lines, verify

pytestmark = pytest.mark.usefixtures("made_once")

Damage = Callable[[Path], object]
HUGE = 10**400
CERTIFICATE = "certificate.json"
CONFIGURATION = ".hydra/config.yaml"


def changing(name: str, change: Callable[[dict[str, Any]], object]) -> Damage:
    """Damage that changes the content of a JSON file."""
    return lambda run: edited(run / name, change)


def writing(name: str, text: str) -> Damage:
    """Damage that puts another text in the place of a file."""
    return lambda run: (run / name).write_text(text)


def cut_recording(run: Path) -> None:
    path = run / "test.mcap"
    content = path.read_bytes()
    path.write_bytes(content[:-500])


DAMAGES: dict[str, Damage] = {}
DAMAGES["a part is null"] = changing(CERTIFICATE, lambda c: c.update(observer=None))
DAMAGES["a part is a list"] = changing(CERTIFICATE, lambda c: c.update(state_feedback=[1]))
DAMAGES["a number of 400 digits"] = changing(CERTIFICATE, lambda c: c["observer"].update(eta=HUGE))
DAMAGES["a matrix of such"] = changing("model.json", lambda m: m.update(a=[[HUGE]]))
DAMAGES["the model is a list"] = writing("model.json", "[]")
DAMAGES["the model is no json"] = writing("model.json", "{")
DAMAGES["broken yaml"] = writing(CONFIGURATION, "a: [b")
DAMAGES["yaml of another kind"] = writing(CONFIGURATION, "- 1")
DAMAGES["a recording cut"] = cut_recording
DAMAGES["an empty manifest"] = writing("manifest.json", "")
DAMAGES["a list as manifest"] = writing("manifest.json", "[]")


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_file_is_a_claim_that_does_not_hold(what: str, copied_run: Path) -> None:
    DAMAGES[what](copied_run)
    assert not verify(copied_run).holds


@pytest.mark.parametrize("value", ["true", "false"])
def test_a_run_with_a_withdrawn_setting_is_refused_in_a_sentence(
    value: str, copied_run: Path
) -> None:
    """Nothing of it can be derived; the value that changed nothing is read past."""
    path = copied_run / CONFIGURATION
    text = path.read_text()
    begin = "\nsynthesis:\n"
    assert begin in text
    path.write_text(text.replace(begin, f"{begin}  invert_input: {value}\n"))
    if value == "true":
        with pytest.raises(BadRequest, match=r"invert_input = True: was withdrawn in 0\.2"):
            verify(copied_run)
    else:
        unfounded = [str(finding) for finding in verify(copied_run) if not finding.holds]
        assert not [line for line in unfounded if "cannot be derived" in line]


def without_last(rows: list[list[float]]) -> list[list[float]]:
    """A matrix without its last row; a square one without its last column, too."""
    fewer = rows[:-1]
    is_square = len(rows[0]) == len(rows)
    return [row[:-1] for row in fewer] if is_square else fewer


def shorter(part: str, *names: str) -> Damage:
    """Damage that shortens these matrices of a part of the certificate."""

    def change(content: dict[str, Any]) -> None:
        for name in names:
            rows = content[part][name]
            content[part][name] = without_last(rows)

    return changing(CERTIFICATE, change)


def finding(entry: dict[str, Any]) -> Damage:
    """Damage that puts one finding in the place of all evidence."""
    text = json.dumps([entry])
    return writing("evidence.json", text)


def without_last_case(run: Path) -> None:
    """Damage that takes the last of four closed loops out of the recording."""
    path = run / "closed_loop.mcap"
    groups, about = read_mcap(path)
    others = tuple(group for group in groups if not group.topic.startswith("/case_3/"))
    assert len(others) < len(groups)
    write_mcap(path, others, about)


PLAIN: dict[str, tuple[Damage, str]] = {}
PLAIN["a shape"] = (
    shorter("observer", "l"),
    "certificate.observer.l (shape) = (3, 1): must be n by p, and n is 4 in a; synthesise again.",
)
PLAIN["a part"] = (
    shorter("state_feedback_unlimited", "a", "b", "p", "starts"),
    "certificate.state_feedback_unlimited.k (shape) = (1, 4): must be m by n, and n is 3 in a; "
    "synthesise again.",
)
PLAIN["a weight"] = (shorter("tolerance", "p"), "tolerance: the matrices do not fit the model")
PLAIN["a part is a text"] = (
    changing(CERTIFICATE, lambda c: c.update(observer="x")),
    "certificate.observer = x: is no object; synthesise again.",
)
PLAIN["a word"] = (
    finding({"level": "grave", "sentence": "The log is short."}),
    "evidence.json [0].level = grave: unknown; use note, doubt or cannot judge.",
)
PLAIN["a key"] = (
    finding({"levl": "note"}),
    "evidence.json [0] = {'levl': 'note'}: is no finding (level and sentence); "
    "run the study again.",
)
PLAIN["a case of the loop"] = (
    without_last_case,
    "closed_loop.mcap: holds 3 of 4 simulations; run the study again.",
)
FOREIGN_WORDS = ("operand", "dimension", "tuple", "attribute", "argument", "boolean")


@pytest.mark.parametrize("what", PLAIN)
def test_a_wrong_shape_or_word_is_told_in_a_sentence_of_ours(what: str, copied_run: Path) -> None:
    """Not in NumPy's or Python's words."""
    damage, sentence = PLAIN[what]
    damage(copied_run)
    failures = [finding.found for finding in verify(copied_run) if not finding.holds]
    assert any(text.endswith(sentence) for text in failures), failures
    text = " ".join(failures)
    assert not any(word in text for word in FOREIGN_WORDS)


def test_failures_of_one_cause_stand_in_one_line() -> None:
    first = CheckedClaim(claim="a", holds=False, found="gone")
    held = CheckedClaim(claim="b", holds=True, found="gone")
    again = CheckedClaim(claim="c", holds=False, found="gone")
    other = CheckedClaim(claim="d", holds=False, found="wrong")
    lines = finding_lines([first, held, again, other])
    together = replace(first, claim="a, c")
    assert lines == [str(together), str(held), str(other)]


UNFINISHED = {
    "failed": "see error_message in",
    "running": "the command that began it runs it again",
}


@pytest.mark.parametrize("status", UNFINISHED)
def test_a_run_that_claims_nothing_is_told_what_to_do(tmp_path: Path, status: str) -> None:
    """Without its lock a running run is lost; with it, it is at work."""
    write_record(tmp_path, {"status": status, "run": "a"})
    with pytest.raises(BadRequest, match=UNFINISHED[status]):
        verify(tmp_path)
    (tmp_path / "traceback.txt").touch()
    with file_lock(tmp_path / LOCK) as is_held:
        assert is_held
        words = "see .*traceback.txt" if status == "failed" else "give a run that is ok"
        with pytest.raises(BadRequest, match=words):
            verify(tmp_path)
