"""Every old name leads somewhere, is understood wherever strangers write it, and is said to be
old."""

import subprocess
import sys
import warnings
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ssm_study import renamed
from ssm_study.cli.request import translate_arguments
from ssm_study.durable import (
    add_digest,
    read_json_with_digest,
    read_limited_bytes,
    write_json_atomically,
)
from ssm_study.engine.records import CORRUPT, parse_record, read_record, write_record
from ssm_study.refusal import BadRequest
from ssm_study.renamed import OldNameWarning, Withdrawal

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "ssm_study"


def configured(path: str) -> bool:
    """Whether some yaml of ours has a setting of this path's last name."""
    name = path.rpartition(".")[2]
    files = (ROOT / "conf").rglob("*.yaml")
    return any(f"{name}:" in file.read_text() for file in files)


@pytest.mark.parametrize("old", renamed.MODULES)
def test_an_old_module_is_the_new_one(old: str) -> None:
    place = SOURCES / Path(*old.split("."))
    assert not place.with_suffix(".py").exists(), "the old name is in use: take the entry out"
    assert find_spec(f"ssm_study.{renamed.MODULES[old]}") is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OldNameWarning)
        module = import_module(f"ssm_study.{old}")
    assert module is import_module(f"ssm_study.{renamed.MODULES[old]}")


@pytest.mark.parametrize("old", renamed.NAMES)
def test_an_old_name_is_the_new_object(old: str) -> None:
    holder, _, name = old.rpartition(".")
    place, _, present = renamed.NAMES[old].rpartition(".")
    assert present in vars(import_module(f"ssm_study.{place}"))
    module = import_module(f"ssm_study.{holder}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OldNameWarning)
        assert getattr(module, name) is getattr(import_module(f"ssm_study.{place}"), present)


@pytest.mark.parametrize("dotted", renamed.METHODS)
def test_an_old_method_is_the_new_one(dotted: str) -> None:
    place, _, name = dotted.rpartition(".")
    kind = getattr(import_module(f"ssm_study.{place}"), name)
    for old, new in renamed.METHODS[dotted].items():
        assert vars(kind)[old] is vars(kind)[new]


def test_every_other_entry_exists() -> None:
    """Settings and columns have their new name; what is withdrawn is nowhere."""
    from ssm_study.table.columns import BY_NAME

    for old, new in renamed.SETTINGS.items():
        assert configured(new)
        assert not configured(old)
    for new in renamed.COLUMNS.values():
        assert new in BY_NAME
    for path in renamed.WITHDRAWN_SETTINGS:
        assert not configured(path), f"{path} is still a setting"
    for target in renamed.WITHDRAWN_TARGETS:
        module, _, name = target.rpartition(".")
        module = f"ssm_study.{module}"
        assert find_spec(module) is None or not hasattr(import_module(module), name)
    for choice in renamed.WITHDRAWN_CHOICES:
        group, _, name = choice.partition("=")
        assert not (ROOT / "conf" / group / f"{name}.yaml").exists()


OLD_IMPORTS = """
import warnings
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    from ssm_study.synthesis.certificate import StateFeedback
    from ssm_study.synthesis.theorem import Blocks, Known
    import ssm_study.synthesis.theorems.guaranteed_cost as riccati
    from ssm_study.synthesis.theorems import integral_action
    from ssm_study.synthesis.theorem import Known
    from ssm_study.synthesis import rest
    from ssm_study.systems import Pair
words = [str(one.message) for one in said if "is now" in str(one.message)]
from ssm_study.certificates import certificate, theorem
from ssm_study.certificates.theorems import integral_action as present
from ssm_study.robustness import return_to_rest
from ssm_study.synthesis import guaranteed_cost
from ssm_study.systems import Gains
assert StateFeedback is certificate.StateFeedback and Known is theorem.VerificationContext
assert integral_action is present and rest is return_to_rest and riccati is guaranteed_cost
assert Pair is Gains
assert len(words) == len(set(words)), words
assert any("synthesis.theorem is now ssm_study.certificates.theorem;" in word for word in words)
try:
    import ssm_study.synthesis.theorems.never_there
except ModuleNotFoundError:
    print("good")
"""


def test_old_imports_in_a_fresh_process() -> None:
    """In any order, before and after the new names, each said once."""
    done = subprocess.run(
        [sys.executable, "-c", OLD_IMPORTS], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.stdout == "good\n", done.stderr


def test_a_method_that_a_stranger_overrides_by_its_old_name_is_called() -> None:
    class Base:
        def present(self) -> str:
            return "base"

    class Ours(Base):
        def present(self) -> str:
            return "ours"

    methods = {"old_present": "present"}
    renamed.support_old_methods(Base, methods)
    with pytest.warns(OldNameWarning, match=r"Theirs\.old_present is now Theirs\.present"):

        class Theirs(Ours):
            def old_present(self) -> str:
                return f"theirs over {super().old_present()}"  # type: ignore[misc]

    assert Theirs().present() == "theirs over ours"
    assert Ours().old_present() == "ours"  # type: ignore[attr-defined]
    assert Base.old_present is Base.present  # type: ignore[attr-defined]


def test_an_abstract_method_is_answered_by_its_old_name() -> None:
    from abc import ABC, abstractmethod

    class Base(ABC):
        @staticmethod
        @abstractmethod
        def present() -> str: ...

    methods = {"old": "present"}
    renamed.support_old_methods(Base, methods)

    class Theirs(Base):
        @staticmethod
        def old() -> str:
            return "theirs"

    assert Theirs().present() == "theirs"  # type: ignore[abstract]
    with pytest.raises(TypeError):
        type("Empty", (Base,), {})()


def test_stored_targets_are_read_under_their_new_names() -> None:
    old = "ssm_study.synthesis.among_starts.FastestCertified"
    among_starts = {"_target_": old, "at": "${seed}"}
    model = {"among_starts": among_starts}
    config = OmegaConf.create({"model": model, "seed": 3})
    renamed.rename_old_settings(config)
    chosen = config.model.among_starts
    assert chosen._target_ == "ssm_study.synthesis.model_selection.LargestCertifiableRate"
    assert chosen.at == 3
    for foreign in ("os.system", "ssm_study.cli.main.main", "another.synthesis.among_starts.Foo"):
        assert renamed.current_target(foreign) == foreign


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries of every kind, whatever today's tables hold."""
    gone = Withdrawal(since="0.2", remedy="leave it out", neutral=0.0)
    choice = Withdrawal(since="0.2", remedy="use model=gru")
    monkeypatch.setattr(renamed, "SETTINGS", {"model.summed": "model.integrating"})
    monkeypatch.setattr(renamed, "COLUMNS", {"peak_v": "peak"})
    monkeypatch.setattr(renamed, "WITHDRAWN_SETTINGS", {"training.old_weight": gone})
    monkeypatch.setattr(renamed, "WITHDRAWN_CHOICES", {"model=old_net": choice})


@pytest.mark.usefixtures("tables")
def test_old_settings_are_read_and_withdrawn_ones_refused() -> None:
    arguments = ["model.summed=true", "seed=1"]
    expected = ["model.integrating=true", "seed=1"]
    assert translate_arguments(arguments) == expected
    model = {"summed": True, "order": 2}
    training = {"old_weight": 0.0, "starts": 1}
    tree = {"model": model, "training": training}
    model = {"integrating": True, "order": 2}
    training = {"starts": 1}
    expected = {"model": model, "training": training}
    assert renamed.current_settings(tree) == expected
    tree["training"]["old_weight"] = 0.5
    with pytest.raises(
        BadRequest, match=r"training.old_weight = 0.5: was withdrawn in 0.2 \(CHANGE"
    ):
        renamed.current_settings(tree)
    with pytest.raises(BadRequest, match=r"training.old_weight = 0.1: was withdrawn in 0.2"):
        translate_arguments(["training.old_weight=0.1"])
    actual = translate_arguments(["training.old_weight=0.0", "seed=1"])
    assert actual == ["seed=1"]
    with pytest.raises(
        BadRequest, match=r"model = old_net: was withdrawn in 0.2 .*; use model=gru"
    ):
        translate_arguments(["-m", "model=ssm,old_net"])


@pytest.mark.usefixtures("tables")
def test_a_renamed_column_has_both_names_in_a_record(tmp_path: Path) -> None:
    write_record(tmp_path, {"status": "ok", "peak": 1.5})
    record = read_record(tmp_path)
    assert record is not None
    assert record["peak_v"] == 1.5
    assert record["peak"] == 1.5
    assert record["record_version"] == 3
    content = written(tmp_path, {"record_version": 1, "status": "ok", "peak_v": 2.5})
    old = parse_record(content)
    assert old["peak_v"] == 2.5
    assert old["peak"] == 2.5


def written(folder: Path, record: dict[str, object]) -> bytes:
    """A record as another version would have sealed it."""
    write_json_atomically(folder / "other.json", add_digest(record))
    return read_limited_bytes(folder / "other.json")


@pytest.mark.parametrize("version", [0, 4, "2", True, None, 1.0])
def test_a_record_of_an_unknown_version_is_corrupt(tmp_path: Path, version: object) -> None:
    stored = written(tmp_path, {"record_version": version, "status": "ok"})
    assert read_json_with_digest(stored) is not None
    expected = {"status": CORRUPT}
    assert parse_record(stored) == expected
    content = written(tmp_path, {"record_version": 1, "status": "ok"})
    record = parse_record(content)
    status = record["status"]
    assert status == "ok"
