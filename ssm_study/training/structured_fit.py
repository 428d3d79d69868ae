"""The Lightning module of a structured model: its first epoch makes the starting point, each further one is a step."""

from dataclasses import replace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float
from scipy import linalg

from ssm_study.models.contracting import Core, in_metric, parameters, projected
from ssm_study.models.spec import arx, impulse_response, realise, scaled
from ssm_study.models.structured import StructuredSSM, slopes
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet, fit_of_error
from ssm_study.training.metrics import mean_fit
from ssm_study.training.structured_problem import CORE, FREE_CORE, Batch, Descent, Residuals, Theta, loss, step

SETTLED = 1e-4  # relative gain of a step below which a starting phase ends
IDLE = 1e-3  # relative change of the output below which a neuron does nothing
ARX_LAGS = 10
SLOWEST = 0.998  # a starting pole outside is pulled inside this radius
SMALL = 0.05  # of E: the neurons start as a perturbation of the linear fit
RESTS_WITHIN = 1.0  # of the bias of a neuron whose argument has unit size
UNWEIGHTED = ("x0", "x_e", "x_g", "a")  # what the ridge leaves alone: coordinates, and starts


class StructuredFit(pl.LightningModule):
    """Levenberg-Marquardt on the simulation error; the parameters, the damping and the loss are buffers.

    So a checkpoint is the whole state, and a training that was killed goes on where it was. There is nothing for an
    optimiser of torch to do: the Jacobian is written out (`Residuals.linearised`).
    """

    damping: torch.Tensor
    loss: torch.Tensor

    def __init__(self, spec: StructuredSpec, data: DataSet, seed: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.spec, self.data, self.seed = spec, data, seed
        lift, read = spec.maps((data.scale.inputs, data.scale.outputs))
        told: dict[str, Any] = {"neurons": spec.each, "rate": spec.rate, "integrated": spec.integrated}
        self.problem = Residuals(records=Batch.padded(scaled(data)), lift=lift, read=read, **told)
        self.estimates = data.start_up_samples > 0
        buffers = {"damping": np.zeros(()), "loss": np.full((), np.nan)}
        for name, value in (buffers | {name: np.zeros(shape) for name, shape in self._shapes().items()}).items():
            self.register_buffer(name, torch.from_numpy(value))

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        n, q, (u, y, _) = int(self.spec.order), self.spec.neurons, self.problem.records
        count, m, p = len(u), u.shape[-1], y.shape[-1]
        free = {"x_e": (n, q), "x_g": (n + q, n), "log_d": (q,)}
        core = free if self.spec.rate else {"a": (n, n), "e": (n, q), "f": (q, n)}
        shapes = core | {"b": (n, m), "g": (q, m), "bias": (q,), "c": (p, n), "d": (p, m), "h": (p, q)}
        maps = {"scaffold_in": (len(self.problem.lift.owners),), "scaffold_out": (len(self.problem.read.owners),)}
        return shapes | maps | {"x0": (count, n + p * self.spec.integrated)}

    @property
    def theta(self) -> Theta:
        """The parameters, as NumPy sees them."""
        return {name: getattr(self, name).detach().cpu().numpy() for name in self._shapes()}

    def advance(self, steps: int) -> None:
        """The starting point and so many steps, without what Lightning does around each."""
        for _ in range(1 + steps):
            before = float(self.loss)
            self.training_step(None, 0)
            if before - float(self.loss) < SETTLED * before:
                break

    def training_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002 - the records are in the problem
        """The starting point, then one accepted step (or none) an epoch."""
        free = self._free(CORE if self.spec.rate is None else FREE_CORE, self.spec.input_path != "none")
        ridge = self._ridge(free)
        if torch.isnan(self.loss):
            theta = self._started()
            at = Descent(theta=theta, loss=loss(self.problem, theta, ridge))
        else:
            at = Descent(theta=self.theta, loss=float(self.loss), damping=float(self.damping))
            at = step(self.problem, at, free, ridge)
        for name in self._shapes():
            getattr(self, name).copy_(torch.as_tensor(at.theta[name]))
        self.loss.fill_(at.loss)
        self.damping.fill_(at.damping)

    def _started(self) -> Theta:
        """Linear fit, S_u, free model, and the nearest contracting one: each phase from the end of the one before."""
        spec, rng = self.spec, np.random.default_rng(self.seed)
        steps, linear = spec.start_steps, replace(self.problem, neurons=(), rate=None)
        theta = linear_start(linear, int(spec.order), spec.feedthrough, rng)
        matrices = ("a", "b", "c", *(("d",) if spec.feedthrough else ()), *(("x0",) if self.estimates else ()))
        theta = self._descended(linear, theta, matrices, steps[0])  # phase 1: the linear fit
        if spec.knots or spec.output_knots:
            theta = self._descended(linear, theta, (*matrices, "scaffold_in", "scaffold_out"), steps[1])
        free = replace(self.problem, rate=None)
        theta = with_neurons(free, theta, spec.neurons, rng)
        theta = self._descended(free, theta, self._free(CORE, spec.input_path == "free"), steps[2])
        return theta if spec.rate is None else contracting_start(free, theta, spec.rate)

    def _descended(self, problem: Residuals, theta: Theta, free: tuple[str, ...], most: int) -> Theta:
        ridge = self._ridge(free)
        at = Descent(theta=theta, loss=loss(problem, theta, ridge))
        for _ in range(most):
            before, at = at.loss, step(problem, at, free, ridge)
            if not at.loss < before * (1.0 - SETTLED):
                break
        return at.theta

    def _free(self, core: tuple[str, ...], input_path: bool) -> tuple[str, ...]:  # The blocks that a phase moves
        spec = self.spec
        paths = {"g": input_path, "h": spec.output_path == "free", "d": spec.feedthrough, "x0": self.estimates}
        opened = (name for name, is_open in paths.items() if is_open)
        return (*core, "b", "c", "bias", "scaffold_in", "scaffold_out", *opened)

    def _ridge(self, free: tuple[str, ...]) -> dict[str, float]:
        return {name: self.spec.ridge for name in free if name not in UNWEIGHTED}

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        """Fits in percent: of training from the states that were fitted, of validation as a score has them."""
        r = self.problem.residual(self.theta)
        self.log("fit_training_percent", fit_of_error(np.sqrt(r @ r)))
        self.log("fit_validation_percent", mean_fit(self.stored(), self.data.validation, self.data))

    def configure_optimizers(self) -> None:
        """None: a step needs the Jacobian, not a gradient."""

    def stored(self) -> StructuredSSM:
        """The explicit numbers; with `integrated` the running sum is one more state per output."""
        theta, spec = self.theta, self.spec
        k = self.problem.matrices(theta)
        told = {"neurons": spec.each, "scale": self.data.scale, "step_s": self.data.step_s}
        parts: dict[str, Any] = k._asdict() | told
        del parts["kinds"]
        if spec.integrated:
            n, p = len(k.a), len(k.c)
            parts["a"] = np.block([[k.a, np.zeros((n, p))], [k.c, np.eye(p)]])
            parts["b"], parts["e"] = np.vstack([k.b, k.d]), np.vstack([k.e, k.h])
            parts["f"] = np.hstack([k.f, np.zeros((len(k.f), p))])
            parts["c"], parts["d"], parts["h"] = np.eye(p, n + p, n), np.zeros_like(k.d), np.zeros_like(k.h)
        for name, each in {"scaffold_in": self.problem.lift, "scaffold_out": self.problem.read}.items():
            parts[name] = each.freeze(theta[name])
        return StructuredSSM(**parts)

    def concluded(self) -> tuple[StructuredSSM, str]:
        """The model without the neurons that do nothing on the training inputs, and how many those were."""
        model = pruned(self.stored(), [record.u for record in self.data.training])
        idle = len(self.spec.each) - len(model.neurons)
        return model, f"; neurons removed because they did nothing: {idle}" if idle else ""


def pruned(model: StructuredSSM, inputs: list[Float[np.ndarray, "_ m"]]) -> StructuredSSM:
    """Without neurons whose replacement by `w_i = s_i z_i`, s_i the mean slope, moves no output by `IDLE` (relative).

    A metric in which the model contracts is one of the pruned model too: `w_i = s_i z_i` satisfies the sector
    condition that the analysis LMI is about. A neuron between input and output is left where D is zero.
    """
    for i in reversed(range(len(model.neurons))):
        through = np.any(model.h[:, i] != 0) and np.any(model.g[i] != 0)
        candidate = _without(model, i, inputs)
        was, moved = (np.concatenate([one.simulate(u) for u in inputs]) for one in (model, candidate))
        if not through and np.linalg.norm(moved - was) / np.linalg.norm(was - was.mean(axis=0)) < IDLE:
            model = candidate
    return model


def _without(model: StructuredSSM, i: int, inputs: list[Float[np.ndarray, "_ m"]]) -> StructuredSSM:
    lifted = [model.lift(u) for u in inputs]
    z = [model.run(v)[1][:-1] @ model.f.T + v @ model.g.T + model.bias for v in lifted]
    s = float(np.concatenate([slopes(model.neurons, one)[:, i] for one in z]).mean())
    e, f, g, h = model.e[:, [i]], model.f[[i]], model.g[[i]], model.h[:, [i]]
    parts = {"a": model.a + s * e @ f, "b": model.b + s * e @ g, "c": model.c + s * h @ f, "d": model.d + s * h @ g}
    for name, axis in {"e": 1, "f": 0, "g": 0, "h": 1, "bias": 0}.items():
        parts[name] = np.delete(getattr(model, name), i, axis)
    return replace(model, **parts, neurons=model.neurons[:i] + model.neurons[i + 1 :])


def linear_start(problem: Residuals, order: int, feedthrough: bool, rng: np.random.Generator) -> Theta:
    """ARX by least squares, a balanced realisation of its impulse response, its poles inside the unit circle; q = 0."""
    u, y, _ = problem.records
    pairs = [(a[there], b[there]) for a, b, there in zip(u, y, problem.records.scored, strict=True)]
    samples = [np.concatenate(side) for side in zip(*pairs, strict=True)]
    if problem.integrated:
        pairs = [(u[:-1], np.diff(y, axis=0)) for u, y in pairs]
    lags = min(ARX_LAGS, min(len(u) for u, _ in pairs) // 4)
    system = realise(impulse_response(*arx(pairs, lags, feedthrough)), order, rng)
    radius = max(float(np.abs(np.linalg.eigvals(system.a)).max()), 1e-9)
    (n, m), p = system.b.shape, len(system.c)
    shapes = {"e": (n, 0), "f": (0, n), "g": (0, m), "h": (p, 0), "bias": (0,)}  # no neurons yet
    shapes |= {"x0": (len(u), n + p * problem.integrated)}
    return {name: np.zeros(shape) for name, shape in shapes.items()} | {
        "a": system.a * min(1.0, SLOWEST / radius),
        "b": system.b,
        "c": system.c,
        "d": system.d if feedthrough else np.zeros((p, m)),
        "scaffold_in": problem.lift.start(samples[0]),
        "scaffold_out": problem.read.start(samples[1]),
    }


def with_neurons(problem: Residuals, theta: Theta, count: int, rng: np.random.Generator) -> Theta:
    """States of unit size, then F and the bias random, so that neurons bend within the data, E small, G and H zero."""
    states = problem.simulated(theta)[2][:, :-1][problem.records.scored]
    size = np.sqrt(np.mean(states**2, axis=0)) + 1e-9  # root mean square of each state
    n, m, p = len(size), theta["b"].shape[1], len(theta["c"])
    x0, b = theta["x0"].copy(), theta["b"] / size[:, None]
    x0[:, :n] /= size
    f = rng.normal(size=(count, n))
    f *= rng.uniform(0.7, 3.0, (count, 1)) / np.linalg.norm(f, axis=1, keepdims=True)
    e, bias = SMALL * rng.normal(size=(n, count)) * np.linalg.norm(b), RESTS_WITHIN * rng.uniform(-1.0, 1.0, count)
    turned = {"a": theta["a"] * size / size[:, None], "b": b, "c": theta["c"] * size, "x0": x0}
    return theta | turned | {"e": e, "f": f, "g": np.zeros((count, m)), "h": np.zeros((p, count)), "bias": bias}


def contracting_start(problem: Residuals, theta: Theta, rate: float) -> Theta:
    """The nearest model on the path of `contracting.projected`, in its metric's coordinates and free parameters."""
    (v, _, states), scored = problem.simulated(theta), problem.records.scored
    z = states[:, :-1][scored] @ theta["f"].T + v[scored] @ theta["g"].T + theta["bias"]
    found = projected(Core(*(theta[name] for name in CORE)), slopes(problem.neurons, z).mean(axis=0), rate)
    free, n = parameters(in_metric(found), rate), len(theta["a"])
    x0 = theta["x0"].copy()
    x0[:, :n] = x0[:, :n] @ found.t.T
    moved = {"b": found.t @ theta["b"], "c": linalg.solve(found.t.T, theta["c"].T).T, "x0": x0}
    return theta | moved | free._asdict() | {"log_d": np.log(found.d)}
