"""Logs of strangers' plants, fitted by the plain command, and the exported C on the plants
themselves.

    python benchmarks/stranger_loops.py --only vehicle tanks cylinder --work /tmp/strangers
    python benchmarks/stranger_loops.py --work /tmp/strangers

Each plant of `stranger_plants.py` and `stranger_plants_aside.py` is logged into a csv file of its
owner's kind, `ssm-study run data=recorded` identifies a model from it and designs a controller, and
`ssm-study export` writes it as C. The compiled code then runs on the plant, sensor noise included,
from four states of the log, and to three set points where it has set points. One row a plant goes
into `results/reference/loop/stranger_loops.csv`; a run that lies in the work folder is not made
again, one that ended without a controller leaves the columns of the loop empty. Two to four minutes
of processor time a plant, most of it the command's.

Columns of the loop, noise-free outputs of the plant, shares of each output's range in the log: a
start has settled when every output stays within 5 % around the value at which it comes to rest, and
that value lies within 10 % of the model's equilibrium; `offset_percent` is that distance,
`swing_percent` what is left of the motion. Columns with `_open` hold the input at the model's
equilibrium instead. Set points are the quartiles of the log's outputs unless a plant has its own,
`set_point_errors` the mean distances over the last fifth of each step, in the output's unit.
"""

import argparse
import ctypes
import json
import subprocess
from collections.abc import Sequence
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import REFERENCE, keep
from jaxtyping import Float
from log_choice import quote
from stranger_plants import PLANTS, Recording, Signals, State, StrangerPlant, Vector
from stranger_plants_aside import PLANTS_ASIDE

from ssm_study.cli.main import main as ssm_study
from ssm_study.export.targets import load_model
from ssm_study.models.structured import Model

TABLE = REFERENCE / "loop" / "stranger_loops.csv"
BAND = 0.05  # of an output's range in the log
FAR = 0.1  # the same, from which on a value of rest is not the equilibrium
START_QUANTILES = (0.02, 0.2, 0.8, 0.98)  # of the first output, where the log has these states
SET_POINT_QUANTILES = (0.25, 0.75, 0.5)
LAST = 5  # the last fifth of a trial shows where it rests
NOISE_SEED = 1
STATE_BYTES = 8192
COPIED = (  # columns of the run's record
    "fit_test_percent",
    "fit_test_members_percent",
    "baseline",
    "fit_baseline_percent",
    "model_choice",
    "evidence",
    "controller_certified_rate",
    "observer_certified_rate",
    "resolved_margin",
    "coverage",
    "coverage_needed",
    "stable_count",
    "settling_time_mean_s",
    "settling_time_open_loop_s",
    "git_commit",
)
Trial = tuple[Signals, Signals]


class Device:
    """The compiled C of an exported controller."""

    def __init__(self, folder: Path, outputs: int, inputs: int) -> None:
        library = folder / "controller.so"
        flags = ["-shared", "-fPIC", "-O2", "-ffp-contract=off", "-DCONTROLLER_EXTERN"]
        source = str(folder / "controller.c")
        subprocess.run(["gcc", *flags, source, "-lm", "-o", str(library)], check=True)
        header = (folder / "controller.h").read_text()
        self.code = ctypes.CDLL(str(library))
        self.has_set_points = "CONTROLLER_SET_POINTS 1" in header
        self.state = ctypes.create_string_buffer(STATE_BYTES)
        self.y = (ctypes.c_double * outputs)()
        self.r = (ctypes.c_double * outputs)()
        self.u = (ctypes.c_double * inputs)()

    def start(self, y: Vector) -> None:
        """Begin at rest at the first measurement; without set points at the equilibrium."""
        self.y[:] = list(y)
        if self.has_set_points:
            self.code.controller_init(self.state, self.y)
        else:
            self.code.controller_reset(self.state)

    def compute_input(self, y: Vector, set_point: Vector, d: Vector) -> Vector:
        """Input of one sample, within the limits."""
        self.y[:] = list(y)
        self.r[:] = list(set_point)
        loads = [(ctypes.c_double * len(d))(*d)] if len(d) else []
        if self.has_set_points:
            self.code.controller_track(self.state, self.y, self.r, self.u, *loads)
        else:
            self.code.controller_input(self.state, self.u)
            self.code.controller_clamp(self.u)
            self.code.controller_advance(self.state, self.y, self.u, *loads)
        return np.array(self.u)


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A plant with its log, the model of its run, and the controller if the run has one."""

    plant: StrangerPlant
    recording: Recording
    model: Model
    device: Device | None

    @property
    def ranges(self) -> Vector:
        """Range of each output in the log."""
        return np.ptp(self.recording.outputs, axis=0)

    @property
    def load(self) -> Vector:
        """Measured disturbances at their mean, where the model has its equilibrium."""
        return self.recording.disturbances.mean(axis=0)

    def starts(self) -> list[State]:
        """States of the log at which its first output stands at some quantiles."""
        y = self.recording.outputs[:, 0]
        levels = np.quantile(y, START_QUANTILES)
        rows = [int(np.abs(y - level).argmin()) for level in levels]
        return [self.recording.states[row] for row in rows]

    def run_loop(self, x: State, set_points: Signals) -> Trial:
        """Noise-free outputs and applied inputs of the plant under the controller; under the input
        of the model's equilibrium where there is none."""
        rng = np.random.default_rng(NOISE_SEED)
        held = self.model.scale.input_equilibrium
        outputs = []
        inputs = []
        for k, set_point in enumerate(set_points):
            measured = self.plant.measure(x, rng.standard_normal(len(set_point)))
            u = held
            if self.device is not None:
                if k == 0:
                    self.device.start(measured)
                u = self.device.compute_input(measured, set_point, self.load)
            outputs.append(self.plant.output(x))
            inputs.append(u)
            x = self.plant.next_state(x, u, self.load)
        return np.array(outputs), np.array(inputs)

    def settling_columns(self, prefix: str) -> dict[str, object]:
        """Starts that settle, their mean time, and how far from the equilibrium they rest."""
        goal = self.model.scale.output_equilibrium
        set_points = np.tile(goal, (self.plant.trial_samples, 1))
        times = []
        offsets = []
        swings = []
        for x in self.starts():
            y, _ = self.run_loop(x, set_points)
            tail = y[-len(y) // LAST :]
            rest = tail.mean(axis=0)
            offset = float((np.abs(rest - goal) / self.ranges).max())
            time = settling_samples(y - rest, BAND * self.ranges)
            times.append(time if offset <= FAR else None)
            offsets.append(offset)
            swings.append(float((np.ptp(tail, axis=0) / self.ranges).max()))
        settled = [time for time in times if time is not None]
        mean = self.plant.step_s * float(np.mean(settled)) if settled else None
        return {
            f"settled{prefix}": f"{len(settled)} of {len(times)}",
            f"settling{prefix}_s": rounded(mean),
            f"offset{prefix}_percent": rounded(100 * max(offsets)),
            f"swing{prefix}_percent": rounded(100 * max(swings)),
        }

    def set_point_columns(self) -> dict[str, object]:
        """Worst error at the end of a step of the set point and mean time to come within the band
        of it; empty without set points."""
        if self.device is None or not self.device.has_set_points:
            return {}
        measured = self.recording.outputs
        steps = np.quantile(measured, SET_POINT_QUANTILES, axis=0)
        if self.plant.set_points:
            steps = np.array(self.plant.set_points)[:, None]
        samples = self.plant.trial_samples
        y, _ = self.run_loop(self.starts()[1], np.repeat(steps, samples, axis=0))
        errors = []
        times = []
        for piece, step in zip(np.split(y, len(steps)), steps, strict=True):
            errors.append(np.abs(piece - step)[-samples // LAST :].mean(axis=0))
            times.append(settling_samples(piece - step, BAND * self.ranges))
        reached = [time for time in times if time is not None]
        mean = self.plant.step_s * float(np.mean(reached)) if reached else None
        worst = np.max(errors, axis=0)
        return {
            "set_points_reached": f"{len(reached)} of {len(times)}",
            "set_point_s": rounded(mean),
            "set_point_errors": " ".join(f"{max(each):.3g}" for each in errors),
            "set_point_error_percent": rounded(100 * float((worst / self.ranges).max())),
        }


def settling_samples(distances: Signals, band: Float[np.ndarray, "c"]) -> int | None:
    """First sample from which on every output stays within a band; None where the last sixth of
    the trial leaves it."""
    outside = np.flatnonzero((np.abs(distances) > band).any(axis=1))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return first if first < len(distances) * 5 // 6 else None


def rounded(value: float | None) -> object:
    """A number with four digits; empty for none."""
    return "" if value is None else float(f"{value:.4g}")


def run_words(plant: StrangerPlant) -> list[str]:
    """Words of the plain command for a plant's log, as `ssm-study look` prints them."""
    named = {"input": plant.inputs, "output": plant.outputs, "disturbance": plant.disturbances}
    settings = [
        f"data.{side}={names[0] if len(names) == 1 else '[' + ','.join(names) + ']'}"
        for side, names in named.items()
        if names
    ]
    words = [quote(setting) for setting in (*settings, *plant.settings)]
    path = f"data.path={plant.name}.csv"
    return ["run", f"study={plant.name}", "data=recorded", path, *words, "progress=false"]


def run_folder(plant: StrangerPlant, work: Path) -> Path | None:
    """Folder of the plant's finished run; None where there is none."""
    records = sorted((work / "results" / plant.name).glob("*/record.json"))
    return records[0].parent if records else None


def make_run(plant: StrangerPlant, work: Path) -> Path | None:
    """Log the plant, give the command and export the controller; what is there is not made
    again."""
    with chdir(work):
        if run_folder(plant, work) is None:
            plant.write_log(work)
            ssm_study(run_words(plant))
        folder = run_folder(plant, work)
        if folder is not None and not (work / plant.name / "controller.c").exists():
            ssm_study(["export", str(folder), "--to", plant.name, "--yes"])
    return folder


def row_of(plant: StrangerPlant, work: Path) -> dict[str, object]:
    """One row of the table."""
    folder = make_run(plant, work)
    row: dict[str, object] = {"plant": plant.name, "describes": plant.describes}
    if folder is None:
        return row | {"status": "no run"}
    record = json.loads((folder / "record.json").read_text())
    row["status"] = record["status"]
    row |= {name: shortened(record.get(name)) for name in COPIED}
    predicted = record.get("fit_test_members_percent") or record.get("fit_test_percent")
    baseline = record.get("fit_baseline_percent")
    if predicted is not None and baseline is not None:
        row["ahead_points"] = rounded(predicted - baseline)
    if not (folder / "model.json").exists():
        return row
    return row | loop_columns(plant, folder, work / plant.name)


def loop_columns(plant: StrangerPlant, folder: Path, exported: Path) -> dict[str, object]:
    """Columns of the plant with its controller, and without one."""
    recording = plant.record()
    model = load_model(folder)
    bench = Bench(plant=plant, recording=recording, model=model, device=None)
    columns = bench.settling_columns("_open")
    if not (exported / "controller.c").exists():
        return columns
    device = Device(exported, len(plant.outputs), len(plant.inputs))
    controlled = Bench(plant=plant, recording=recording, model=model, device=device)
    return columns | controlled.settling_columns("") | controlled.set_point_columns()


def shortened(value: object) -> object:
    """A stored value with four digits."""
    return rounded(value) if isinstance(value, float) else value


def chosen_plants(names: Sequence[str]) -> list[StrangerPlant]:
    """Plants of these names; all of them without names."""
    plants = [make() for make in (*PLANTS, *PLANTS_ASIDE)]  # type: ignore[call-arg]
    return [plant for plant in plants if plant.name in names or not names]


def main() -> None:
    """Make the rows of the chosen plants."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--table", "--to", type=Path, default=TABLE, metavar="FILE")
    options = parser.parse_args()
    work = options.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    order = [plant.name for plant in chosen_plants([])]
    for plant in chosen_plants(options.only):
        row = row_of(plant, work)
        print(row, flush=True)
        keep(options.table, [row], ("plant",), lambda each: order.index(str(each["plant"])))


if __name__ == "__main__":
    main()
