"""Trained together, every member is what it is alone: same numbers, same end, whatever the others do."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from models_cases import data_set

from ssm_study.models.baseline_recurrent import RecurrentSpec
from ssm_study.models.scaffold_specs import Linear, Mlp, Monotone, Residual, ScaffoldSpec
from ssm_study.models.spec import SSMSpec
from ssm_study.training.identification import Identification
from ssm_study.training.loggers import Csv
from ssm_study.training.optimisers import Adam, Lbfgs, trainable
from ssm_study.training.together import Member, Program, may_train_together, records_gain, train_together
from ssm_study.training.training import Training
from ssm_study.training.windows import Windows

EQUAL_PERCENT = 1e-9  # fits of a member and of the same training alone, percent points; bit by bit where tried
MLP = Mlp(depth=1, train_slopes=True, certified=True)


def spec(scaffold_in: ScaffoldSpec = MLP, scaffold_out: ScaffoldSpec | None = None, **changes: Any) -> SSMSpec:
    settings = {"order": 2, "hidden_width": 7, "slope_lower": 0.05, "slope_upper": 1.0, "feedthrough": False}
    settings |= {"start": "ring", "real_modes": 0}  # the same number of real modes for every seed
    return SSMSpec(scaffold_in=scaffold_in, scaffold_out=scaffold_out or Linear(), **{**settings, **changes})


def training(**changes: Any) -> Training:
    settings = {"max_epochs": 8, "patience": 2, "min_gain_percent": 0.05, "validation_tolerance_percent": 0.2}
    settings |= {"optimiser": Lbfgs(steps_per_epoch=4, history=10), "roughness_weight": 1e-3}
    return Training(**{**settings, **changes})


def member(of: SSMSpec, seed: int, settings: Training | None = None, samples: int = 190) -> Member:
    data = data_set(noise=0.05, samples=samples, hold=5, seed=seed, records=2)
    return Member(spec=of, data=data, seed=seed, training=settings or training())


def trained(members: list[Member], folder: Path) -> list[Identification]:
    """Each as it came out of the program, in the order given."""
    found: dict[Member, Identification] = {}

    def keep(one: Member, number: int) -> None:
        found[one] = one.conclude(folder / f"{len(found)}", number)

    assert train_together(members, keep) == []
    return [found[one] for one in members]


def alone(one: Member, folder: Path) -> Identification:
    return one.training.identify(one.spec, one.data, one.seed, folder)


def assert_equal(found: Identification, expected: Identification) -> None:
    assert (found.ended, len(found.curve)) == (expected.ended, len(expected.curve))
    for name in ("fit_training_percent", "fit_validation_percent"):
        curves = [[row[name] for row in one.curve] for one in (found, expected)]
        np.testing.assert_allclose(*curves, rtol=0, atol=EQUAL_PERCENT)
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=EQUAL_PERCENT)


@pytest.mark.parametrize(
    ("scaffold_in", "scaffold_out"),
    [(MLP, Linear()), (Monotone(), MLP), (Mlp(depth=2, train_slopes=True, certified=True), Monotone())],
)
def test_members_equal_each_alone(scaffold_in: ScaffoldSpec, scaffold_out: ScaffoldSpec, tmp_path: Path) -> None:
    """Seeds, slope bounds and lengths of training differ: who has ended leaves, the others go on unmoved."""
    bounds = [(0.05, 1.0), (0.2, 1.5), (0.05, 1.0)]
    specs = [spec(scaffold_in, scaffold_out, slope_lower=low, slope_upper=high) for low, high in bounds]
    members = [member(one, seed) for seed, one in enumerate(specs)]
    found = trained(members, tmp_path)
    if scaffold_in == MLP:
        assert len({len(one.curve) for one in found}) > 1, "the case must have members that end at different times"
    assert [one.trained_together for one in found] == [3, 3, 3]
    for seed, (one, result) in enumerate(zip(members, found, strict=True)):
        assert_equal(result, alone(one, tmp_path / f"alone_{seed}"))
        assert (tmp_path / f"{seed}" / "best.ckpt").is_file()


@pytest.mark.parametrize("samples", [190, 203])
@pytest.mark.parametrize("outer", [Linear(), Monotone()])
def test_numbers_do_not_depend_on_how_many_share(samples: int, outer: ScaffoldSpec) -> None:
    """Bit by bit: loss and gradient of one evaluation, at random points; this is why whole trainings agree."""
    members = [member(spec(scaffold_out=outer, order=5, real_modes=1), seed, samples=samples) for seed in range(3)]
    generator = torch.Generator().manual_seed(0)
    program = Program(members, lambda *_: None)
    program._stack()
    for _ in range(5):
        for one in members:
            for parameter in trainable(one.fit):
                parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        values = [value.item() for value in program._evaluate()]
        joint = [one.vector.values.grad for one in members]
        for one, value, gradient in zip(members, values, joint, strict=True):
            one.fit.zero_grad()
            loss = one.fit.loss()
            loss.backward()
            own = [p.grad.flatten() for p in one.fit.parameters() if p.grad is not None]
            assert loss.item() == value
            assert gradient is not None
            assert torch.equal(torch.cat(own), gradient)


def test_a_member_whose_loss_is_not_finite_leaves_the_others_alone(tmp_path: Path) -> None:
    members = [member(spec(), seed) for seed in range(3)]
    with torch.no_grad():
        members[1].fit.model.get_parameter("lru.c_real").fill_(1e200)  # its square is infinite
    found: dict[int, Identification] = {}
    ended = lambda one, number: found.setdefault(one.seed, one.conclude(tmp_path / f"{one.seed}", number))  # noqa: E731
    train_together([members[0], members[2]], ended)
    undisturbed, found = found, {}
    again = [member(spec(), 0), members[1], member(spec(), 2)]
    stopped: list[str] = []
    train_together(again, lambda one, n: stopped.append(one.keeper.ended) if one is members[1] else ended(one, n))
    assert len(stopped) == 1
    assert "not finite" in stopped[0]
    for seed in (0, 2):
        assert_equal(found[seed], undisturbed[seed])


def test_members_of_another_architecture_share_with_their_own_kind() -> None:
    narrow, wide = [member(spec(), s) for s in range(2)], [member(spec(hidden_width=9), s) for s in range(2)]
    lonely = member(spec(order=4), 0)
    unable = [member(spec(Residual(depth=1)), s) for s in range(2)]
    shared: list[tuple[Member, int]] = []
    left = train_together([narrow[0], wide[0], lonely, narrow[1], wide[1], *unable], lambda *one: shared.append(one))
    assert {id(one) for one in left} == {id(one) for one in unable}
    assert sorted(number for _, number in shared) == [1, 2, 2, 2, 2]
    assert (lonely, 1) in shared
    assert narrow[0].kind() == narrow[1].kind() != wide[0].kind()
    assert member(spec(), 0, training(patience=3)).kind() != narrow[0].kind()


def test_what_cannot_share_a_program_is_told_from_its_settings() -> None:
    assert may_train_together(training(), spec())
    others = [
        training(optimiser=Adam(learning_rate=0.01, steps_per_epoch=5, final_fraction=0.1)),
        training(precision=32),
        training(starts=2),
        training(hankel_weight=0.1),
        training(windows=Windows(samples=50)),
        training(logger=Csv()),
        training(initial_state="estimated"),
        training(accelerator="gpu"),
    ]
    assert not any(may_train_together(other, spec()) for other in others)
    assert not may_train_together(training(), RecurrentSpec(cell="gru", hidden=4))
    assert records_gain(1000, 0)
    assert not records_gain(5000, 0)
    assert not records_gain(1000, 20)
    assert member(spec(), 0).kind() is not None
    moving = replace(member(spec(), 0).data, start_up_samples=20)
    assert Member(spec=spec(), data=moving, seed=0, training=training()).kind() is None
