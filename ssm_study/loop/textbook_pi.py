"""Table columns on a PI controller that is tuned by a textbook rule from the same identified model,
for comparison with a certified design. It runs on the same plant from the same initial states."""

import numpy as np

from ssm_study.loop.motion import settling_times_s
from ssm_study.loop.peers.peer import replace_neurons_by_slopes
from ssm_study.loop.peers.pi import tyreus_luyben_pi
from ssm_study.loop.regulation import LoopExperiment
from ssm_study.models.structured import Model
from ssm_study.plants.plant import Plant
from ssm_study.refusal import BadRequest


def textbook_pi_columns(
    plant: Plant | None, model: Model, loop: LoopExperiment, seed: int
) -> dict[str, float | int | None]:
    """Table columns on the closed loop of a simulated plant with a PI controller tuned by Tyreus
    and Luyben's rule.

    The same starts, noise, reference, disturbance and limits as for the certified design. None for
    a log, a device (which is not run again), several inputs or outputs, and where the rule has no
    answer.
    """
    if plant is None or plant.is_physical:
        return {}
    try:
        controller = tyreus_luyben_pi(replace_neurons_by_slopes(model))
    except BadRequest:
        return {}
    runs = loop.run_on_plant(plant, controller, seed)
    all_times_s = settling_times_s(runs.rollouts_for_settling, runs.settling_band)
    times_s = [time_s for time_s in all_times_s if time_s is not None]
    mean_s = float(np.mean(times_s)) if times_s else None
    return {"stable_count_pi": len(times_s), "settling_time_pi_s": mean_s}
