"""A run's controller for use elsewhere, with the certificate beside it."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

from ssm_study.models.identified import SSM
from ssm_study.refusal import require
from ssm_study.report.export_c import c_header
from ssm_study.report.export_onnx import onnx_model
from ssm_study.report.portable import PortableController, portable
from ssm_study.synthesis.certificate import Design

_SCRIPT = Path(__file__).with_name("export_script.py.txt")


def export(run: Path, to: Path) -> list[Path]:
    """Write the controller of the run folder into the folder `to`; returns what was written.

    `controller.h` (dependency-free C), `controller.json` (the numbers), `controller.py` (a python-control system from
    them, NumPy and control only), `controller.onnx` (where onnx is installed) and `certificate.json`, the run's own.
    Raises `BadRequest` for a run without controller, or when `to` is a file.
    """
    controller = load(run)
    require(not to.exists() or to.is_dir(), "to", to, "is a file", "name a folder")
    to.mkdir(parents=True, exist_ok=True)
    about = describe(run)
    (to / "controller.h").write_text(c_header(controller, about))
    (to / "controller.json").write_text(json.dumps({"about": about, **controller.to_json()}, indent=1) + "\n")
    shutil.copyfile(_SCRIPT, to / "controller.py")
    shutil.copyfile(run / "certificate.json", to / "certificate.json")
    if find_spec("onnx") is not None:
        (to / "controller.onnx").write_bytes(onnx_model(controller, about).SerializeToString())
    return sorted(path for path in to.iterdir() if path.stem in ("controller", "certificate"))


def load(run: Path) -> PortableController:
    """The controller of a run folder as plain arrays."""
    for name in ("model.json", "certificate.json"):
        found = (run / name).is_file()
        require(found, "run", run, f"it has no {name}", "name the folder of a run that reached the controller")
    return portable(SSM.from_json(json.loads((run / "model.json").read_text())), Design.load(run / "certificate.json"))


def describe(run: Path) -> str:
    """One line on where the controller comes from and what was certified of it."""
    design = Design.load(run / "certificate.json")
    rates = f"rates {design.state_feedback.rate:g} (controller), {design.observer.rate:g} (observer) per sample"
    verdict = f"certified for its model at {rates}" if design.certified else "NOT certified"
    return f"Controller of run {run.resolve().parent.name}/{run.resolve().name}, {verdict}; see certificate.json."
