"""Damaged files of a run are claims that do not hold, in sentences of ours."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from verify_lies import edited

from ssm_study.study.verify import verify

pytestmark = pytest.mark.usefixtures("made_once")

DAMAGES: dict[str, Callable[[Path], object]] = {
    "a part is null": lambda run: edited(
        run / "certificate.json", lambda c: c.update(observer=None)
    ),
    "a part is a list": lambda run: edited(
        run / "certificate.json", lambda c: c.update(state_feedback=[1])
    ),
    "a number of 400 digits": lambda run: edited(
        run / "certificate.json", lambda c: c["observer"].update(eta=10**400)
    ),
    "a matrix of such": lambda run: edited(run / "model.json", lambda m: m.update(a=[[10**400]])),
    "the model is a list": lambda run: (run / "model.json").write_text("[]"),
    "the model is no json": lambda run: (run / "model.json").write_text("{"),
    "broken yaml": lambda run: (run / ".hydra" / "config.yaml").write_text("a: [b"),
    "yaml of another kind": lambda run: (run / ".hydra" / "config.yaml").write_text("- 1"),
    "a recording cut": lambda run: (run / "test.mcap").write_bytes(
        (run / "test.mcap").read_bytes()[:-500]
    ),
    "an empty manifest": lambda run: (run / "manifest.json").write_text(""),
    "a list as manifest": lambda run: (run / "manifest.json").write_text("[]"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_file_is_a_claim_that_does_not_hold(what: str, copied_run: Path) -> None:
    DAMAGES[what](copied_run)
    assert not verify(copied_run).holds


def shorter(run: Path, part: str, *names: str) -> None:
    """These matrices without their last row, those that are square without their last column,
    too."""

    def change(content: dict[str, Any]) -> None:
        for name in names:
            rows = content[part][name]
            content[part][name] = [row[:-1] if len(row) == len(rows) else row for row in rows[:-1]]

    edited(run / "certificate.json", change)


def finding(run: Path, entry: dict[str, Any]) -> None:
    text = json.dumps([entry])
    (run / "evidence.json").write_text(text)


PLAIN: dict[str, tuple[Callable[[Path], object], str]] = {
    "a shape": (
        lambda run: shorter(run, "observer", "l"),
        "certificate.observer.l (shape) = (3, 1): is to be n by p, and n is 4 in a; "
        "synthesise again.",
    ),
    "a part": (
        lambda run: shorter(run, "state_feedback_unlimited", "a", "b", "p", "starts"),
        "certificate.state_feedback_unlimited.k (shape) = (1, 4): is to be m by n, and n is "
        "3 in a; synthesise again.",
    ),
    "a weight": (
        lambda run: shorter(run, "tolerance", "p"),
        "tolerance: the matrices do not fit the model",
    ),
    "a part is a text": (
        lambda run: edited(run / "certificate.json", lambda c: c.update(observer="x")),
        "certificate.observer = x: is no object; synthesise again.",
    ),
    "a word": (
        lambda run: finding(run, {"level": "grave", "sentence": "The log is short."}),
        "evidence.json [0].level = grave: unknown; use note, doubt or cannot judge.",
    ),
    "a key": (
        lambda run: finding(run, {"levl": "note"}),
        "evidence.json [0] = {'levl': 'note'}: is no finding; run the study again.",
    ),
}


@pytest.mark.parametrize("what", PLAIN)
def test_a_wrong_shape_or_word_is_told_in_a_sentence_of_ours(what: str, copied_run: Path) -> None:
    """Not in NumPy's or Python's words."""
    damage, sentence = PLAIN[what]
    damage(copied_run)
    found = [one.found for one in verify(copied_run) if not one.holds]
    assert any(one.endswith(sentence) for one in found), found
    assert not any(
        word in one
        for one in found
        for word in ("operand", "dimension", "tuple", "attribute", "argument")
    )
