"""A member of a family answers every question of its family, or is refused."""

import inspect
from abc import ABC
from typing import Any

import pytest

from ssm_study.data import readers
from ssm_study.data.excitations.excitation import Excitation
from ssm_study.data.readers.reader import Reader
from ssm_study.family import Family
from ssm_study.loop import peers
from ssm_study.loop.controller import Controller
from ssm_study.loop.peers.peer import ComparisonMethod
from ssm_study.models import baselines, bilinear, scaffolds
from ssm_study.models.identified import Simulator
from ssm_study.models.scaffolds.scaffold import Scaffold
from ssm_study.models.scaffolds.trainable import Trainable
from ssm_study.models.spec import ModelSpec
from ssm_study.plants.plant import Plant
from ssm_study.synthesis.design import Synthesis

FOUND_BY_NAME: list[Any] = [Scaffold, Simulator, Reader, ComparisonMethod]
NAMED_IN_YAML: list[Any] = [Plant, Excitation, Trainable, ModelSpec, Controller, Synthesis]


@pytest.mark.parametrize("base", FOUND_BY_NAME)
def test_an_incomplete_member_is_refused_where_it_is_defined(base: Any) -> None:
    """For every question: a member that answers all others is refused, and the question is
    named."""
    questions = sorted(base.__abstractmethods__)
    assert questions
    for left_open in questions:
        answers = {name: lambda _: None for name in questions if name != left_open}
        with pytest.raises(TypeError, match=f"Incomplete does not answer {left_open}$"):
            type("Incomplete", (base,), answers, names=("incomplete",))
    assert "incomplete" not in base.known
    complete = type(
        "Complete", (base,), dict.fromkeys(questions, lambda _: None), names=("complete",)
    )
    assert base.known.pop("complete") is complete


@pytest.mark.parametrize("base", NAMED_IN_YAML)
def test_an_incomplete_member_cannot_be_made(base: Any) -> None:
    assert issubclass(base, ABC)
    assert inspect.isabstract(base)
    for left_open in sorted(base.__abstractmethods__):
        answers = {name: lambda _: None for name in base.__abstractmethods__ if name != left_open}
        with pytest.raises(TypeError, match=left_open):
            type("Incomplete", (base,), answers)()


def test_members_are_those_of_the_room() -> None:
    scaffold = Scaffold.members(scaffolds)
    expected = {"linear", "mlp", "monotone", "residual"}
    assert set(scaffold) == expected
    simulator = Simulator.members(baselines)
    expected = {"bilinear", "gru", "lstm", "narx"}
    assert set(simulator) == expected
    assert simulator["bilinear"] is bilinear.Bilinear
    reader = Reader.members(readers)
    assert {"", ".csv", ".txt", ".mat", ".mcap", ".parquet", ".xlsx"} < set(reader)
    peer = ComparisonMethod.members(peers)
    assert {"uncontrolled", "pi", "lqg", "auto"} < set(peer)


def test_families_do_not_share_their_members() -> None:
    class One(Family): ...

    class Other(Family): ...

    class Member(One, names=("x",)): ...

    assert One.known == {"x": Member}
    assert Other.known == {}
