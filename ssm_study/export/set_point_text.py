"""Sentences in the header of an exported controller on its set points: how exact they are, and
which of them the input limits hold."""

from ssm_study.export.device import DeviceController

FAR = 1e6  # output scales: beyond what any input limits hold
UNLIMITED = 1e30  # physical: an input limit of this size is none


def describe_set_points(device: DeviceController) -> tuple[str, ...]:
    """Sentences on the set points of a controller; none without set points."""
    return (*describe_interpolation_error(device), *describe_held_set_points(device))


def describe_interpolation_error(device: DeviceController) -> tuple[str, ...]:
    """Sentence on the largest error of equilibria that are interpolated between tabulated ones."""
    points = device.set_point_maps
    if points is None or not points.missed:
        return ()
    missed = f"missed by at most {points.missed:.1e}."
    return (f"Set points lie on lines between stored rest points: {missed}",)


def describe_held_set_points(device: DeviceController) -> tuple[str, ...]:
    """Sentence on the set points that the input limits hold; none where they are not known."""
    held = held_set_points(device)
    if held is None:
        return ()
    ends = f"from {held[0]:.6g} to {held[1]:.6g}"
    return (f"The limits hold set points {ends}; of others the nearest is taken.",)


def held_set_points(device: DeviceController) -> tuple[float, float] | None:
    """Smallest and largest output at which a constant input within the limits holds the model; None
    with several signals, without limits, or where every output is an equilibrium."""
    points = device.set_point_maps
    if points is None or points.inward is None:
        return None
    scale = device.controller.scale
    is_single = scale.inputs == 1 and scale.outputs == 1
    widest = max(float(device.upper[0]), -float(device.lower[0]))
    if not is_single or widest >= UNLIMITED:
        return None
    ends = []
    for direction in (-1.0, 1.0):
        offset = direction * FAR * scale.output_scale
        nearest = device.nearest_equilibrium(scale.output_equilibrium + offset)
        output = scale.physical_output(nearest["w"])
        ends.append(float(output[0]))
    return min(ends), max(ends)
