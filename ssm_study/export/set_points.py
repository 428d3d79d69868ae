"""Reason why the exported code of a run follows no set points."""

from pathlib import Path

from ssm_study.export.device import Device
from ssm_study.export.targets import find_input_limits, load_controller


def missing_set_points_reason(run: Path) -> str:
    """Reason why the exported code of a run follows no set points, as a clause; empty if it does,
    or if the run has no controller."""
    try:
        controller = load_controller(run)
        limits = find_input_limits(run)
    except (OSError, ValueError, KeyError):  # a baseline, an infeasible run, a damaged file
        return ""
    return Device.from_controller(controller, "double", *limits).no_set_points_reason
