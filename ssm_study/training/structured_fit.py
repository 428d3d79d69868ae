"""The Lightning module of a structured model: its first epoch makes the starting point, each
further one is a step."""

from dataclasses import replace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from jaxtyping import Float

from ssm_study.models.identified import SSM
from ssm_study.models.spec import scaled
from ssm_study.models.structured import Model, StructuredSSM, phi, shapes
from ssm_study.models.structured_spec import StructuredSpec
from ssm_study.signals import DataSet, fit_of_error
from ssm_study.training.metrics import mean_fit
from ssm_study.training.structured_problem import (
    CORE,
    FREE_CORE,
    Batch,
    Descent,
    Residuals,
    Theta,
    minimise,
    step,
)
from ssm_study.training.structured_start import (
    contracting_start,
    linear_start,
    screened_poles,
    with_neurons,
)

IDLE = 1e-3  # relative change of the output below which a neuron does nothing
START_SAMPLES = 2000  # of which a start is made: the training goes on with all
RACE = 5  # steps of each draw inside the contracting set
TRUSTED = 0.5  # of its loss: a least-squares start is replaced where random poles come below


class StructuredFit(pl.LightningModule):
    """Levenberg-Marquardt on the simulation error; the parameters, the damping and the loss are
    buffers.

    So a checkpoint is the whole state, and a training that was killed goes on where it was. There
    is nothing for an optimiser of torch to do: the Jacobian is written out
    (`Residuals.linearised`).
    """

    damping: torch.Tensor
    loss: torch.Tensor

    def __init__(self, spec: StructuredSpec, data: DataSet, seed: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.spec = spec
        self.data = data
        self.seed = seed
        lift, read = spec.maps((data.scale.inputs, data.scale.outputs))
        told: dict[str, Any] = {
            name: getattr(spec, name) for name in ("rate", "integrating_output", "ridge")
        }
        self.problem = Residuals(
            records=Batch.padded(scaled(data)), neurons=spec.each, lift=lift, read=read, **told
        )
        self.estimates = data.start_up_samples > 0
        self.register_buffer("damping", torch.zeros((), dtype=torch.float64))
        self.register_buffer("loss", torch.full((), torch.nan, dtype=torch.float64))
        n = int(spec.order)
        q = spec.neurons
        p = data.scale.outputs
        sizes: dict[str, tuple[int, ...]] = shapes(n, data.scale.inputs, p, q)
        if spec.rate is not None:
            sizes = {name: shape for name, shape in sizes.items() if name not in CORE}
            sizes |= {"x_e": (n, q), "x_g": (n + q, n), "log_d": (q,)}
        sizes |= {"scaffold_in": lift.owners.shape, "scaffold_out": read.owners.shape}
        for name, shape in (
            sizes | {"x0": (len(data.training), n + p * spec.integrating_output)}
        ).items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    @property
    def theta(self) -> Theta:
        """The parameters, as NumPy sees them."""
        return {
            name: part.cpu().numpy()
            for name, part in self.named_buffers()
            if name not in ("damping", "loss")
        }

    def advance(self, steps: int) -> None:
        """The starting point and at most so many steps, without what Lightning does around each."""
        self._keep(minimise(self.problem, self._started(), self._moved, steps))

    def training_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002 - the records are in the problem
        """The starting point, then one accepted step (or none) an epoch."""
        if torch.isnan(self.loss):
            self.advance(0)
            return
        at = Descent(theta=self.theta, loss=float(self.loss), damping=float(self.damping))
        self._keep(step(self.problem, at, self._moved))

    @property
    def _moved(self) -> tuple[str, ...]:
        return self._free(
            CORE if self.spec.rate is None else FREE_CORE, self.spec.input_path != "none"
        )

    def _keep(self, at: Descent) -> None:
        for name in self.theta:
            getattr(self, name).copy_(torch.as_tensor(at.theta[name]))
        self.loss.fill_(at.loss)
        self.damping.fill_(at.damping)

    def _started(self) -> Theta:
        """On few samples: linear fit, S_u, then neurons drawn at random race and the best draw
        starts the training."""
        spec = self.spec
        rng = np.random.default_rng(self.seed)
        stretch = self.problem.records.moving_stretch(START_SAMPLES)
        short = replace(self.problem, records=stretch)
        linear = replace(short, neurons=(), rate=None)
        matrices = (
            "a",
            "b",
            "c",
            *(("d",) if spec.feedthrough else ()),
            *(("x0",) if self.estimates else ()),
        )

        def settled(theta: Theta) -> Descent:  # phase 1: the linear fit
            return minimise(linear, theta, matrices, spec.start_steps[0])

        begun = linear_start(linear, int(spec.order), bool(spec.feedthrough), rng)
        at = settled(begun)
        if not spec.integrating_output:
            screened = settled(screened_poles(linear, begun, self.estimates, rng))
            at = screened if screened.loss < TRUSTED * at.loss else at
        theta = at.theta
        if spec.knots or spec.output_knots:
            maps = (*matrices, "scaffold_in", "scaffold_out")
            theta = minimise(linear, theta, maps, spec.start_steps[1]).theta
        best = min(
            (self._drawn(short, theta, rng) for _ in range(spec.draws)), key=lambda one: one.loss
        )
        x0 = np.zeros_like(self.theta["x0"])  # records that the start has not seen begin at rest
        if np.shares_memory(stretch.u[:1, :1], self.problem.records.u[:1, :1]):
            x0[: len(best.theta["x0"])] = best.theta["x0"]
        return best.theta | {"x0": x0}

    def _drawn(self, short: Residuals, theta: Theta, rng: np.random.Generator) -> Descent:
        """Random neurons, a few steps without the constraint, the nearest contracting model, a few
        steps as one."""
        spec = self.spec
        free = replace(short, rate=None)
        theta = with_neurons(free, theta, spec.neurons, rng)
        unbound, inside = (
            self._free(core, spec.input_path == "free") for core in (CORE, FREE_CORE)
        )
        at = minimise(free, theta, unbound, spec.start_steps[2])
        if spec.rate is None:
            return at
        theta = contracting_start(free, at.theta, spec.rate)
        return minimise(short, theta, inside, RACE)

    def _free(
        self, core: tuple[str, ...], input_path: bool
    ) -> tuple[str, ...]:  # The blocks that a phase moves
        spec = self.spec
        paths = {
            "g": input_path,
            "h": spec.output_path == "free",
            "d": spec.feedthrough,
            "x0": self.estimates,
        }
        opened = (name for name, is_open in paths.items() if is_open)
        return (*core, "b", "c", "bias", "scaffold_in", "scaffold_out", *opened)

    def validation_step(self, batch: Any, batch_idx: int) -> None:  # noqa: ARG002
        """Fits in percent: of training from the states that were fitted, of validation as a score
        has them."""
        r = self.problem.residual(self.theta)
        self.log("fit_training_percent", fit_of_error(np.sqrt(r @ r)))
        self.log("fit_validation_percent", mean_fit(self.stored(), self.data.validation, self.data))

    def configure_optimizers(self) -> None:
        """Configure no optimiser: a step needs the Jacobian, not a gradient."""

    def stored(self) -> StructuredSSM:
        """The explicit numbers; with `integrating_output` the running sum is one more state per
        output."""
        theta = self.theta
        spec = self.spec
        k = self.problem.matrices(theta)
        told = {"neurons": spec.each, "scale": self.data.scale, "step_s": self.data.step_s}
        parts: dict[str, Any] = k._asdict() | told
        del parts["kinds"]
        if spec.integrating_output:
            n = len(k.a)
            p = len(k.c)
            parts["a"] = np.block([[k.a, np.zeros((n, p))], [k.c, np.eye(p)]])
            parts["b"], parts["e"] = np.vstack([k.b, k.d]), np.vstack([k.e, k.h])
            parts["f"] = np.hstack([k.f, np.zeros((len(k.f), p))])
            parts["c"], parts["d"], parts["h"] = (
                np.eye(p, n + p, n),
                np.zeros_like(k.d),
                np.zeros_like(k.h),
            )
        for name, each in {
            "scaffold_in": self.problem.lift,
            "scaffold_out": self.problem.read,
        }.items():
            parts[name] = each.freeze(theta[name])
        return StructuredSSM(**parts)

    def concluded(self) -> tuple[Model, str]:
        """The model without the neurons that do nothing on the training inputs, and how many those
        were.

        Without any neuron it is the model of one layer, of which more can be proved.
        """
        model = pruned(self.stored(), [record.u for record in self.data.training])
        idle = len(self.spec.each) - len(model.neurons)
        told = f"; neurons removed because they did nothing: {idle}" if idle else ""
        return model if model.neurons else SSM.from_json(model.to_json()), told


def pruned(model: StructuredSSM, inputs: list[Float[np.ndarray, "_ m"]]) -> StructuredSSM:
    """Without neurons whose replacement by `w_i = s_i z_i`, s_i the mean slope, moves no output by
    `IDLE` (relative).

    A metric in which the model contracts is one of the pruned model too: `w_i = s_i z_i` satisfies
    the sector condition that the analysis LMI is about. A neuron between input and output is left
    where D is zero.
    """
    for i in reversed(range(len(model.neurons))):
        if np.any(model.h[:, i] != 0) and np.any(model.g[i] != 0):
            continue
        candidate = _without(model, i, inputs)
        was, moved = (
            np.concatenate([one.simulate(u) for u in inputs]) for one in (model, candidate)
        )
        if np.linalg.norm(moved - was) / np.linalg.norm(was - was.mean(axis=0)) < IDLE:
            model = candidate
    return model


def _without(model: StructuredSSM, i: int, inputs: list[Float[np.ndarray, "_ m"]]) -> StructuredSSM:
    lifted = [model.lift(u) for u in inputs]
    z = [model.run(v)[1][:-1] @ model.f.T + v @ model.g.T + model.bias for v in lifted]
    s = float(np.concatenate([phi(model.neurons, one, "slope")[:, i] for one in z]).mean())
    e = model.e[:, [i]]
    f = model.f[[i]]
    g = model.g[[i]]
    h = model.h[:, [i]]
    parts = {
        "a": model.a + s * e @ f,
        "b": model.b + s * e @ g,
        "c": model.c + s * h @ f,
        "d": model.d + s * h @ g,
    }
    for name, axis in {"e": 1, "f": 0, "g": 0, "h": 1, "bias": 0}.items():
        parts[name] = np.delete(getattr(model, name), i, axis)
    return replace(model, **parts, neurons=model.neurons[:i] + model.neurons[i + 1 :])
