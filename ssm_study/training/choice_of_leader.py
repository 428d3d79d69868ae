"""Choice of a model with an integrator that clearly leads in cross-validation although none of its
brief trainings was certified.

Whether such a model can be certified is much a matter of the start: the gain must keep its sign at
every slope of the neurons. The folds train it from one start, the end from many. So it is trained
to the end before it is given up, and kept only if it is certified then.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from ssm_study.models.bilinear_spec import BilinearSpec
from ssm_study.training.candidates import Candidate, simplest_good_candidate
from ssm_study.training.choice_of_size import simplest_certifiable_candidate
from ssm_study.training.search import STRUCTURED, SettingsChoice, SettingsSearch

LEAD = 0.25  # of a leader's error: by more than that the chosen model's error must be larger
SIZE_NAMES = {"order": "states", "neurons": "neurons", "knots": "break points"}
REMARK_IF_CERTIFIED = "no brief training of it was certified, but the full training was"
REMARK_IF_UNCERTIFIED = "predicted better, but no training of it was certified"


def find_uncertified_leader(
    search: SettingsSearch, candidates: Sequence[Candidate]
) -> Candidate | None:
    """Smallest good model with an integrator, if the model that would be chosen is clearly worse
    and none of its trainings on the folds can be certified; otherwise None."""
    integrating = integrating_candidates(search)
    if not integrating:
        return None
    leader = simplest_good_candidate(integrating)
    chosen = simplest_certifiable_candidate(search, candidates)
    has_all_folds = len(leader.errors) >= len(chosen.errors)
    leads = has_all_folds and chosen.is_clearly_worse(leader, LEAD)
    return leader if leads and not search.is_certifiable(leader) else None


def integrating_candidates(search: SettingsSearch) -> list[Candidate]:
    """Candidate models with an integrator, the smallest first. Of those that were trained further
    the further trained are taken."""
    by_size: dict[tuple[int, ...], Candidate] = {}
    for candidate in search.tried:
        settings = candidate.settings
        if candidate.model == STRUCTURED and settings.get("integrating_output") is True:
            by_size[candidate_size(search, candidate)] = candidate
    return [by_size[size] for size in sorted(by_size)]


def candidate_size(search: SettingsSearch, candidate: Candidate) -> tuple[int, ...]:
    """Order, number of neurons and number of break points of a candidate structured model."""
    values = (candidate.settings.get(name, search.setting_value(name)) for name in SIZE_NAMES)
    return tuple(int(value) for value in values)


def offer_leader(
    search: SettingsSearch, leader: Candidate, predictor: BilinearSpec | None
) -> Iterator[SettingsChoice]:
    """Offer a leader as a choice to be kept only if it is certified in the end. All later choices
    tell that it was given up."""
    search.certified[id(leader)] = True  # the table must say so if this choice is kept
    choice = search.build_settings_choice(leader)
    yield replace(choice, only_if_certified=True, predictor=predictor, remark=REMARK_IF_CERTIFIED)
    search.certified[id(leader)] = False
    search.remark = (
        f"a model with an integrator ({size_text(search, leader)}) {REMARK_IF_UNCERTIFIED}"
    )


def size_text(search: SettingsSearch, candidate: Candidate) -> str:
    """Text that states the size of a candidate structured model, such as `states 2, neurons 1`."""
    size = candidate_size(search, candidate)
    words_and_numbers = zip(SIZE_NAMES.values(), size, strict=True)
    texts = (f"{word} {number}" for word, number in words_and_numbers)
    return ", ".join(texts)
