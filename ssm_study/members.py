"""Which runs of a sweep are trained in one program, and their training; see `training.together`."""

import json
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from ssm_study.data.simulated import SimulatedData
from ssm_study.results.plan import PlannedStages
from ssm_study.results.store import Stages, Store
from ssm_study.signals import DataSet
from ssm_study.specification import Specification
from ssm_study.stages import Kept, dataset_stage, model_stage, select
from ssm_study.sweeps.groups import Sharing, attempt
from ssm_study.training.together import Member, may_train_together, records_gain, train_together

MAY_DIFFER = frozenset({"slope_lower", "slope_upper", "start", "real_modes", "ring_radius", "ring_frequency"})


def sharing(specification: Specification, stages: Stages) -> Sharing | None:
    """Runs that differ in seed, slope bounds or starting point alone may be trained in one program.

    None where the settings forbid it or the model is there.
    """
    if not may_train_together(specification.training, specification.model) or not short(specification):
        return None
    model = model_stage(specification, stages, dataset_stage(specification, stages))
    if model.result.reused:
        return None
    alike = select(specification, "data", "training", *(("plant", "excitation") if specification.plant else ()))
    settings = {name: value for name, value in specification.configuration["model"].items() if name not in MAY_DIFFER}
    return Sharing(kind=json.dumps(alike | {"model": settings}, sort_keys=True, default=str), key=model.key)


def short(specification: Specification) -> bool:
    """Whether the records are of the kind that gains, see `records_gain`."""
    data = specification.data
    if isinstance(data, SimulatedData):
        return records_gain(max(data.samples, data.validation_samples), data.start_up_samples)
    found = specification.dataset()
    return records_gain(max(len(record) for record in (*found.training, *found.validation)), found.start_up_samples)


def train_members(configs: list[DictConfig]) -> None:
    """The models of these runs into the store, trained together as far as they can be.

    Meanwhile no other sweep trains one of them; what another has trained before is left.
    """
    members: dict[str, tuple[Member, Specification, Kept[DataSet]]] = {}
    store = Store(Path(str(configs[0].results_dir)) / ".store")

    def prepare(config: DictConfig) -> None:
        made = Specification.from_config(config)
        data = dataset_stage(made, store)
        key = model_stage(made, PlannedStages(store), data).key
        if key not in members:
            member = Member(spec=made.model, data=data.value, seed=made.seed, training=made.training)
            members[key] = member, made, data

    def keep(member: Member, number: int) -> None:
        made, data = next((made, data) for one, made, data in members.values() if one is member)
        attempt(lambda: model_stage(made, store, data, lambda folder: member.conclude(folder, number)), "keeping")

    for config in configs:
        attempt(partial(prepare, config), "preparing")
    with store.hold("model", members):
        missing = [member for key, (member, *_) in members.items() if store.find("model", key) is None]
        if missing:
            train_together(missing, keep)
