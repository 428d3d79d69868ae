"""Training of structured models: the parametrisation is exact both ways, every derivative is that
of differences."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants_cases import from_yaml
from structured_adjoint import stepped_gradient

from ssm_study.bounds.metrics import bound_facts
from ssm_study.models.contracting import (
    Core,
    Free,
    _balancing,
    explicit,
    in_metric,
    metric,
    parameters,
    projected,
)
from ssm_study.models.scaffolds.linear import LinearScaffold
from ssm_study.models.spec import scaled
from ssm_study.models.structured import StructuredSSM
from ssm_study.models.structured_spec import Pieces, StructuredSpec
from ssm_study.refusal import BadRequest
from ssm_study.signals import Channel, DataSet, Scale, Trajectory
from ssm_study.training.levenberg import DAMPING_RANGE
from ssm_study.training.optimisers import Lbfgs
from ssm_study.training.structured_fit import StructuredFit, pruned
from ssm_study.training.structured_problem import (
    CORE,
    FREE_CORE,
    Batch,
    Descent,
    Residuals,
    Theta,
    ended,
    loss,
    minimise,
    pack,
    step,
    unpack,
)
from ssm_study.training.structured_start import LONGEST, linear_start, random_poles, screened_poles
from ssm_study.training.training import Training

SIZES = {
    "seed": st.integers(0, 2**31),
    "n": st.integers(1, 5),
    "q": st.integers(0, 4),
    "rate": st.floats(0.3, 1.0),
}


def free_core(seed: int, n: int, q: int) -> Free:
    rng = np.random.default_rng(seed)
    return Free(rng.normal(size=(n, q)), rng.normal(size=(n + q, n)), 0.5 * rng.normal(size=q))


def analysis_gap(core: Core, multipliers: np.ndarray, rate: float) -> float:
    """The smallest eigenvalue of the open-loop inequality of docs/theory.md with `M = I`, as it
    stands there."""
    n = len(core.a)
    lam = np.diag(multipliers)
    sector = np.block([[rate**2 * np.eye(n), -core.f.T @ lam], [-lam @ core.f, 2.0 * lam]])
    moved = np.hstack([core.a, core.e])
    return float(np.linalg.eigvalsh(sector - moved.T @ moved)[0])


@settings(max_examples=60, deadline=None)
@given(**SIZES)
def test_whatever_the_parameters_the_lmi_holds_and_they_are_found_again(
    seed: int, n: int, q: int, rate: float
) -> None:
    free = free_core(seed, n, q)
    core = explicit(free, rate)
    assert analysis_gap(core, np.exp(-2.0 * free.log_d), rate) > 0
    d = np.exp(free.log_d)
    back = parameters(Core(core.a, core.e * d, core.f / d[:, None]), rate)
    np.testing.assert_allclose(back.x_e, free.x_e, atol=1e-7, rtol=1e-7)
    np.testing.assert_allclose(back.x_g, free.x_g, atol=1e-7, rtol=1e-7)


def test_a_model_that_does_not_contract_has_no_parameters() -> None:
    core = explicit(free_core(0, 3, 2), 0.9)
    with pytest.raises(np.linalg.LinAlgError):
        parameters(replace_a(core, 1.2 / np.linalg.norm(core.a, 2)), 0.9)


def replace_a(core: Core, factor: float) -> Core:
    return Core(factor * core.a, core.e, core.f)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 4), q=st.integers(1, 4))
def test_the_projection_contracts_whatever_it_is_given(seed: int, n: int, q: int) -> None:
    rng = np.random.default_rng(seed)
    core = Core(rng.normal(size=(n, n)), rng.normal(size=(n, q)), rng.normal(size=(q, n)))
    found = projected(core, rng.uniform(0, 1, q), 0.95)
    assert analysis_gap(in_metric(found), np.ones(q), 0.95) > 0


def test_the_projection_ends_at_what_the_neurons_did_on_average() -> None:
    """A hardly contracting pair: as the neurons' share shrinks, `A + E diag(slope) F` stays what it
    was."""
    rng = np.random.default_rng(3)
    core = Core(0.5 * np.eye(2), 4 * rng.normal(size=(2, 2)), 4 * rng.normal(size=(2, 2)))
    slope = np.array([0.2, 0.3])
    scaled = core._replace(
        e=core.e * 0.6 / np.abs(np.linalg.eigvals(core.a + (core.e * slope) @ core.f)).max()
    )
    found = projected(scaled, slope, 0.9).core
    assert np.abs(found.e).max() < np.abs(scaled.e).max()
    average = scaled.a + scaled.e @ np.diag(slope) @ scaled.f
    average *= min(1.0, 0.99 * 0.9 / np.abs(np.linalg.eigvals(average)).max())
    np.testing.assert_allclose(found.a + found.e @ np.diag(slope) @ found.f, average, atol=1e-12)


def test_a_model_that_contracts_already_is_left_as_it_is() -> None:
    free = free_core(1, 3, 2)
    core = explicit(free._replace(x_e=0.2 * free.x_e, x_g=0.3 * free.x_g), 0.9)
    assert metric(core, 0.9) is not None
    np.testing.assert_allclose(projected(core, np.full(2, 0.5), 0.9).core.f, core.f)
    assert metric(core._replace(f=0.0 * core.f), 0.9) is not None  # neurons that see nothing
    assert metric(Core(core.a, core.e[:, :0], core.f[:0]), 0.9) is not None  # no neurons
    assert metric(replace_a(core, 1.5 / np.abs(np.linalg.eigvals(core.a)).max()), 0.9) is None


KINDS = ("tanh", "softplus", "clipped_cubic")  # smooth: a difference across a kink is no derivative


def problem(
    seed: int, rate: float | None, integrating_output: bool = False
) -> tuple[Residuals, Theta]:
    rng = np.random.default_rng(seed)
    n = 3
    m = 2
    p = 2
    q = 3
    pairs = [(rng.normal(size=(t, m)), rng.normal(size=(t, p))) for t in (30, 22)]
    lift = Pieces(m, 4, 0.1, 1.5)
    read = Pieces(p, 0 if integrating_output else 3, 0.3, 1.0)
    shapes = {"b": (n, m), "c": (p, n), "d": (p, m), "g": (q, m), "h": (p, q), "bias": (q,)}
    theta = {name: 0.5 * rng.normal(size=shape) for name, shape in shapes.items()}
    theta |= (
        free_core(seed, n, q)._asdict() if rate else explicit(free_core(seed, n, q), 0.9)._asdict()
    )
    theta |= {
        "scaffold_in": 0.6 * rng.normal(size=len(lift.owners)),
        "scaffold_out": 0.6 * rng.normal(size=len(read.owners)),
    }
    theta["x0"] = rng.normal(size=(2, n + p * integrating_output))
    one = Residuals(
        records=Batch.padded(pairs),
        neurons=KINDS,
        lift=lift,
        read=read,
        rate=rate,
        integrating_output=integrating_output,
    )
    return one, theta


@pytest.mark.parametrize("rate", [None, 0.95])
@pytest.mark.parametrize("integrating_output", [False, True])
def test_the_jacobian_is_that_of_differences(rate: float | None, integrating_output: bool) -> None:
    """The Jacobian is checked for all blocks at once: the core through its parametrisation, both
    scaffoldings, unequal records, their starts."""
    one, theta = problem(3, rate, integrating_output)
    free = (*(FREE_CORE if rate else CORE), *"bcdgh", "bias", "scaffold_in", "scaffold_out", "x0")
    flat = pack(theta, free)
    r, j, turn = one.linearised(theta, free)
    np.testing.assert_allclose(r, one.residual(theta), atol=1e-13)
    steps = 1e-6 * np.eye(len(flat))
    ahead, behind = (
        [one.residual(theta | unpack(flat + s * h, theta, free)) for h in steps] for s in (1, -1)
    )
    differences = (np.stack(ahead) - np.stack(behind)).T / 2e-6
    np.testing.assert_allclose(j @ turn, differences, atol=2e-7)


def test_the_gradient_is_that_of_the_adjoint() -> None:
    one, theta = problem(5, None)
    one = replace(one, lift=Pieces(2, 0, 0.1, 1.0), read=Pieces(2, 0, 0.1, 1.0))
    theta |= {"scaffold_in": np.zeros(0), "scaffold_out": np.zeros(0)}
    free = (*CORE, *"bcdgh", "bias")
    r, j, _ = one.linearised(theta, free)
    by_adjoint = stepped_gradient(one, theta)
    np.testing.assert_allclose(
        2 * j.T @ r, np.concatenate([by_adjoint[name].ravel() for name in free]), rtol=1e-9
    )


def test_the_ridge_weighs_the_squares_of_the_parameters_that_are_moved() -> None:
    one, theta = problem(0, None)
    free = ("a", "b", "bias", "x0")
    bare = loss(one, theta, ())
    squares = float(
        np.square(theta["b"]).sum() + np.square(theta["bias"]).sum()
    )  # coordinates and starts are free
    weighed = replace(one, ridge=0.3)
    assert loss(one, theta, free) == pytest.approx(bare)
    assert loss(weighed, theta, free) == pytest.approx(bare + 0.3 * squares)
    at = Descent(theta=theta, loss=loss(weighed, theta, free), damping=1e-2)
    after = step(weighed, at, free)
    assert after.loss == pytest.approx(loss(weighed, after.theta, free))
    assert after.loss < at.loss


def test_a_step_whose_damped_matrix_overflows_has_failed_and_ends_nothing() -> None:
    """An unstable draw: the loss and the normal matrix are finite, not so the matrix times a
    damping."""
    maps = {"lift": Pieces(1, 0, 0.1, 1.0), "read": Pieces(1, 0, 0.1, 1.0)}
    one = Residuals(
        records=Batch.padded([(np.ones((900, 1)), np.arange(900.0)[:, None])]), neurons=(), **maps
    )  # type: ignore[arg-type]
    begun = linear_start(one, 1, False, np.random.default_rng(0)) | {"a": np.array([[1.48]])}
    at = Descent(theta=begun, loss=loss(one, begun, ()), damping=1e6)
    normal = np.square(one.linearised(begun, ("a",))[1]).sum()
    assert np.isfinite(at.loss)
    assert np.isfinite(normal)
    with np.errstate(over="ignore"):
        assert not np.isfinite(normal * at.damping)
    after = step(one, at, ("a",))
    assert after.theta is begun
    assert after.loss == at.loss


def test_a_refused_step_does_not_end_the_linear_fit_of_a_start() -> None:
    """Records of the motor: a step that suits the largest balanced state overturns one of a six
    hundredth."""
    made = from_yaml("data", "simulated", "validation_samples=20", "test_samples=20")
    data = made.build(from_yaml("plant", "dc_motor"), from_yaml("excitation", "aprbs"), 8)
    maps = {"lift": Pieces(1, 16, 0.1, 1.0), "read": Pieces(1, 0, 0.1, 1.0)}
    one = Residuals(records=Batch.padded(scaled(data)).cut(2000), neurons=(), **maps)  # type: ignore[arg-type]
    begun = linear_start(one, 5, False, np.random.default_rng(8))
    assert loss(one, begun, ()) > 0.05
    assert minimise(one, begun, ("a", "b", "c"), 15).loss < 0.0055
    assert not ended(1.0, 1.0, 1.0)
    assert ended(1.0, 1.0, DAMPING_RANGE[1])


def test_slow_modes_are_found_where_the_next_sample_hardly_depends_on_the_input() -> None:
    """Time constants of 40 and 25 samples, noise as large as a sample's change, a start far from
    rest."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(600, 1))
    x = np.array([20.0, 10.0])
    y = []
    for v in u:
        y.append([x[0] + rng.normal()])
        x = np.array([0.975 * x[0] + 0.05 * x[1], 0.96 * x[1] + v[0]])
    y = np.array(y) / np.std(y)
    maps = {"lift": Pieces(1, 0, 0.1, 1.0), "read": Pieces(1, 0, 0.1, 1.0)}
    one = Residuals(records=Batch.padded([(u, y)]), neurons=(), **maps)  # type: ignore[arg-type]
    begun = linear_start(one, 2, False, rng)
    found = screened_poles(one, begun, True, rng)
    assert loss(one, begun, ()) > 0.5
    assert loss(one, found, ()) < 0.1
    for mode, true in zip(
        sorted(np.abs(np.linalg.eigvals(found["a"]))), (0.96, 0.975), strict=True
    ):
        assert mode == pytest.approx(true, abs=0.03)


def test_the_projection_leaves_slow_modes_slow() -> None:
    """A model inside the rate already keeps its A; one outside is pulled in by what it must and a
    percent."""
    slow = Core(np.diag([0.985, 0.5]), np.full((2, 1), 1e-4), np.ones((1, 2)))
    np.testing.assert_allclose(projected(slow, np.full(1, 0.5), 0.999).core.a, slow.a, atol=1e-12)
    fast = projected(replace_a(slow, 1.1), np.full(1, 0.5), 0.999)
    assert np.abs(np.linalg.eigvals(fast.core.a)).max() == pytest.approx(0.989, abs=2e-3)


def recorded(model: StructuredSSM, seed: int) -> DataSet:
    rng = np.random.default_rng(seed)
    records = []
    for part in ("training", "validation", "test"):
        u = np.repeat(rng.uniform(-2, 2, (60, 1)), 8, axis=0)
        records.append((Trajectory(u=u, y=model.simulate(u), step_s=0.1, name=part),))
    channel = (Channel(name="a", unit="V"),)
    return DataSet(
        training=records[0],
        validation=records[1],
        test=records[2],
        inputs=channel,
        outputs=channel,
        scale=Scale.identity(1, 1),
    )


@pytest.fixture(scope="module")
def data() -> DataSet:
    blocks = {
        "a": [[0.9, 0.2], [-0.2, 0.8]],
        "b": [[0.1], [0.4]],
        "c": [[1.0, 0.0]],
        "e": [[-0.6], [0.1]],
    }
    blocks |= {"d": [[0.0]], "f": [[1.5, 0.0]], "g": [[0.0]], "h": [[0.0]], "bias": [0.3]}
    true = StructuredSSM(
        **{name: np.array(block) for name, block in blocks.items()},
        neurons=("tanh",),
        scaffold_in=LinearScaffold.identity(1),
        scaffold_out=LinearScaffold.identity(1),
        scale=Scale.identity(1, 1),
        step_s=0.1,
    )
    return recorded(true, 0)


def trained(data: DataSet, folder: Path, epochs: int = 25, **choices: object) -> StructuredSSM:
    spec = StructuredSpec(**({"order": 2, "neurons": 1, "knots": 0, "starts": 1} | choices))  # type: ignore[arg-type]
    no_use = Lbfgs(steps_per_epoch=1, history=1)
    rule = {
        "max_epochs": epochs,
        "patience": 15,
        "min_gain_percent": 0.0,
        "validation_tolerance_percent": 0.2,
    }
    training = Training(optimiser=no_use, **rule)  # type: ignore[arg-type]
    identified = training.identify(spec, data, 0, folder)
    assert isinstance(identified.model, StructuredSSM)
    if epochs > 1:
        assert identified.fit_validation_percent > 99.0
    return identified.model


def test_a_model_of_the_class_is_identified_contracting_and_again_the_same(
    data: DataSet, tmp_path: Path
) -> None:
    first = trained(data, tmp_path / "a")
    second = trained(data, tmp_path / "b")
    assert first.to_json() == second.to_json()
    found = metric(Core(first.a, first.e, first.f), 0.9995)
    assert found is not None


def test_a_neuron_that_does_nothing_is_removed_and_the_metric_stays(
    data: DataSet, tmp_path: Path
) -> None:
    spare = trained(data, tmp_path, neurons=1)
    idle = replace(
        spare,
        e=np.hstack([spare.e, 1e-9 * np.ones((2, 1))]),
        f=np.vstack([spare.f, [[1.0, 0.0]]]),
        g=np.zeros((2, 1)),
        h=np.zeros((1, 2)),
        bias=np.append(spare.bias, 0.0),
        neurons=("tanh", "softplus"),
    )
    left = pruned(idle, data.training[:1])
    assert left.neurons == ("tanh",)
    np.testing.assert_allclose(
        left.simulate(data.test[0].u), spare.simulate(data.test[0].u), atol=1e-5
    )
    through = replace(idle, g=np.array([[0.0], [1.0]]), h=np.array([[0.0, 1e-9]]))
    assert (
        pruned(through, data.training[:1]).neurons == idle.neurons
    )  # its mean slope would be a feedthrough
    for beside in (
        replace(idle, h=np.array([[0.0, 1e-9]])),
        replace(idle, g=np.array([[0.0], [1.0]])),
    ):
        assert pruned(beside, data.training[:1]).neurons == ("tanh",)


@pytest.mark.parametrize(
    ("choice", "word"),
    [
        ({"order": 0}, "model.order"),
        ({"neurons": -1}, "model.neurons"),
        ({"kinds": "sine"}, "unknown neuron"),
        ({"input_path": "late"}, "model.input_path"),
        ({"rate": 1.2}, "model.rate"),
        ({"slope_lower": 0.0}, "model.slope_lower"),
        ({"integrating_output": True, "output_knots": 4}, "model.output_knots"),
        (
            {"integrating_output": True, "neurons": 0},
            "model.neurons = 0: without neurons no integrator",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(choice: dict[str, object], word: str) -> None:
    with pytest.raises(BadRequest, match=word):
        StructuredSpec(**({"order": 2, "neurons": 1} | choice))  # type: ignore[arg-type]


def test_an_integrated_model_is_stored_with_its_integrator(data: DataSet) -> None:
    """The running sum in training, and one more state of the stored model: the same output."""
    fit = StructuredFit(
        StructuredSpec(order=2, neurons=1, knots=0, starts=1, integrating_output=True), data, 0
    )
    fit.training_step(None, 0)
    model = fit.stored()
    assert model.order == 3
    assert np.abs(np.linalg.eigvals(model.a)).max() == pytest.approx(1.0)
    assert "hankel_largest" not in bound_facts(
        model
    )  # no infinite-horizon Gramian: withheld, and no refusal
    y = fit.problem.output(fit.theta)[0]
    np.testing.assert_allclose(
        data.scale.scaled_output(model.simulate(data.training[0].u)), y, atol=1e-9
    )


def test_lambda_is_balanced_whatever_stands_on_the_diagonal() -> None:
    """Osborne: off the diagonal, rows and columns of `diag(1/d) G diag(d)` are equally long."""
    gains = np.random.default_rng(0).uniform(0.1, 10.0, (5, 5)) * np.geomspace(1, 100, 5)[:, None]
    d = _balancing(gains + 50.0 * np.eye(5))
    assert d == pytest.approx(_balancing(gains))
    scaled = gains / d[:, None] * d
    np.fill_diagonal(scaled, 0.0)
    assert np.linalg.norm(scaled, axis=0) == pytest.approx(np.linalg.norm(scaled, axis=1), rel=1e-6)


def testrandom_poles_decay_over_one_to_the_longest_count_of_samples() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        poles = np.linalg.eigvals(random_poles(5, rng))
        samples = -1.0 / np.log(np.abs(poles))
        assert (samples > 1 - 1e-9).all()
        assert (samples < LONGEST * (1 + 1e-9)).all()
        assert (np.abs(np.angle(poles)) <= 0.5 * np.pi).all()
