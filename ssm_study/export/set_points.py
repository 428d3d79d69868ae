"""Reason why the exported controller of a run cannot follow set points."""

from pathlib import Path

from ssm_study.export.device import DeviceController
from ssm_study.export.targets import find_input_limits, load_controller


def missing_set_points_reason(run: Path) -> str:
    """Clause that says why the exported controller of a run cannot follow set points; empty if it
    can, or if the run has no controller."""
    try:
        controller = load_controller(run)
        limits = find_input_limits(run)
    except (OSError, ValueError, KeyError):  # a baseline, an infeasible run, a damaged file
        return ""
    return DeviceController.from_controller(controller, "double", *limits).no_set_points_reason
