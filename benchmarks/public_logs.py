"""Ten public logs, as they lie in their repositories: read, fitted briefly, judged.

    python benchmarks/public_logs.py FOLDER [NAMES]

The files are not part of this project: FOLDER holds them under their own names. Each is read with
its input and output named, and its sampling time where no clock stands in the file; then a model of
three states is trained for a few steps, which says whether the reading makes sense and not how good
a fit can be. The table is kept under results/reference/benchmarks.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from common import REFERENCE, Row, keep

from ssm_study.api.model import Model
from ssm_study.api.parts import StudyParts
from ssm_study.api.steps import identify_model
from ssm_study.data.look import look
from ssm_study.models.baseline_comparison import baseline_columns

TABLE = REFERENCE / "benchmarks" / "public_logs.csv"
STEPS = "training.max_epochs=25"
SPEC = {"order": 3, "neurons": 5, "knots": 8, "starts": 1, "draws": 4, "integrating_output": False}
SAID = ("answer", "integrator", "closed loop", "stands out", "dead time")


@dataclass(frozen=True, kw_only=True)
class PublicLog:
    """Where a log lies, and what a user has to type to have it read."""

    repository: str
    path: str
    input: str
    output: str
    step_s: float | None = None

    @property
    def name(self) -> str:
        return self.path.rpartition("/")[2]


MORAIS = "danielsmorais/system-identification"
NENU = "maria-nenu97/System-Identification-Laboratories"
RAFA = "Rafa7046/Non_Linear_Identification"
FORGIONE = "forgi86/sysid-neural-structures-fitting"
VALUES = {"input": "id.InputData", "output": "id.OutputData"}
FIRST_TWO = {"input": "0", "output": "1"}
LOGS = (
    PublicLog(repository=MORAIS, path="Projeto_1/barra-bola/ballbeam.dat", **FIRST_TWO, step_s=0.1),
    PublicLog(repository=MORAIS, path="Projeto_1/secador/dryer.dat", **FIRST_TWO, step_s=0.08),
    PublicLog(repository=MORAIS, path="Projeto_1/tanques/tanks1.dat", **FIRST_TWO, step_s=5.0),
    PublicLog(repository=NENU, path="Lab10/lab10_8.mat", **VALUES),
    PublicLog(
        repository=NENU,
        path="Lab2/lab2_order1_7.mat",
        input="data.InputData",
        output="data.OutputData",
    ),
    PublicLog(repository=NENU, path="Lab89/lab9_7.mat", **VALUES),
    PublicLog(repository=NENU, path="Lab11/lab11cl_5.mat", **VALUES),
    PublicLog(
        repository=RAFA, path="src/data/robot-arm.csv", input="u", output="y", step_s=1.0
    ),  # the sampling time is not published
    PublicLog(
        repository=FORGIONE, path="examples/CSTR_example/data/cstr.dat", input="1", output="2"
    ),
    PublicLog(
        repository=FORGIONE,
        path="examples/RLC_example/data/RLC_data_id.csv",
        input="V_IN",
        output="V_C",
    ),
)


def read_and_fitted(log: PublicLog, folder: Path) -> Model:
    """The log as the command reads it, and a small model of it after a few steps."""
    parts = StudyParts(
        {"data": "recorded", "model": "structured", "training": "default", "loop": "regulation"},
        (STEPS,),
    )
    parts.change_settings("data", path=str(folder / log.name), input=log.input, output=log.output)
    parts.change_settings("data", step_s=log.step_s)
    parts.change_settings("model", **SPEC)
    data = parts.build("data").build(0)
    with TemporaryDirectory() as place:
        simulator, identification = identify_model(
            parts.build("model"),
            parts.build("training"),
            data,
            0,
            progress=False,
            workplace=Path(place),
            keep_on_interrupt=False,
        )
    return Model(simulator=simulator, data=data, identification=identification)


def row_of(log: PublicLog, folder: Path) -> Row:
    """Line of the table: how the log was read, what `look` and the evidence say, and the fits."""
    start = time.perf_counter()
    seen = look(folder / log.name, input=log.input, output=log.output, step_s=log.step_s)
    model = read_and_fitted(log, folder)
    records = (*model.data.training, *model.data.validation, *model.data.test)
    facts = baseline_columns(model.data) or {}
    reasons = [finding.sentence for finding in model.evidence.findings if finding.level != "note"]
    said = [line for line in seen.sentences if any(word in line for word in SAID)]
    return {
        "log": log.name,
        "repository": log.repository,
        "samples": sum(len(record) for record in records),
        "step_s": f"{model.data.step_s:.6g}",
        "read": model.data.metadata["reading"],
        "look": "; ".join(said),
        "fit_test_percent": f"{model.result_columns['fit_test_percent']:.1f}",
        "fit_baseline_percent": f"{facts.get('fit_baseline_percent', float('nan')):.1f}",
        "baseline": facts.get("baseline"),
        "evidence": model.evidence.level,
        "reasons": " ".join(reasons),
        "seconds": f"{time.perf_counter() - start:.0f}",
    }


def main() -> None:
    """Read, fit and judge each log, and keep its line of the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where the files lie")
    parser.add_argument("names", nargs="*", help="only these files")
    options = parser.parse_args()
    order = [log.name for log in LOGS]
    for log in LOGS:
        if options.names and log.name not in options.names:
            continue
        row = row_of(log, options.folder)
        keep(TABLE, [row], ("log",), lambda one: order.index(str(one["log"])))
        print({name: row[name] for name in ("log", "fit_test_percent", "evidence")}, flush=True)


if __name__ == "__main__":
    main()
