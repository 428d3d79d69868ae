"""The store: one key, one computation, the same bytes for ever; whatever happens to a file is
noticed."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.durable import is_locked
from ssm_study.engine import plan as planning
from ssm_study.engine.plan import PlannedStages, plan_lines
from ssm_study.engine.settings import canonical_json, digest_of_value
from ssm_study.engine.stages import Stage
from ssm_study.engine.store import MANIFEST, Store, read_intact_manifest
from ssm_study.refusal import BadRequest

KEY = digest_of_value("a key")
CONTENT = {"model.json": b'{"a": 1}', "inner/weights.bin": bytes(range(256)) * 4}


def write_content(folder: Path) -> None:
    for name, content in CONTENT.items():
        parent = (folder / name).parent
        parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)


def write_kept(folder: Path, *_: object, **__: object) -> None:
    write_content(folder)


def refuse_to_compute(folder: Path) -> None:
    raise AssertionError(f"computed again in {folder}")


def content_of(folder: Path) -> dict[str, bytes]:
    paths = folder.rglob("*")
    files = [path for path in paths if path.is_file() and path.name != MANIFEST]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_a_stage_is_computed_once_and_then_found(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = store.stage_result("model", KEY, {}, write_content)
    again = store.stage_result("model", KEY, {}, refuse_to_compute)
    assert first.reused is False
    assert again.reused is True
    assert again.path == first.path
    assert again.seconds == first.seconds
    assert content_of(again.path) == CONTENT


def test_equal_meanings_have_equal_keys() -> None:
    c = [1, 2.5]
    a = {"c": c, "d": 2}
    c = (1, 2.5)
    reordered_part = {"d": 2.0, "c": c}
    reordered = {"a": reordered_part, "b": 2.0}
    plain = {"b": 2, "a": a}
    digest = digest_of_value(plain)
    assert digest == digest_of_value(reordered)
    assert canonical_json(True) != canonical_json(1)
    assert canonical_json("1") != canonical_json(1)


FINITE = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | FINITE | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_the_canonical_text_does_not_depend_on_the_order_of_keys(value: object) -> None:
    def reversed_keys(node: object) -> object:
        if isinstance(node, dict):
            return {key: reversed_keys(node[key]) for key in reversed(node)}
        return [reversed_keys(item) for item in node] if isinstance(node, list) else node

    text = canonical_json(reversed_keys(value))
    assert text == canonical_json(value)


DAMAGES = ["flip", "truncate", "extend", "remove"]


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", [*CONTENT, MANIFEST])
def test_damage_is_never_silent(tmp_path: Path, name: str, damage: str) -> None:
    store = Store(tmp_path)
    stage = store.stage_result("model", KEY, {}, write_content)
    path = stage.path / name
    harm(path, damage)
    assert read_intact_manifest(stage.path) is None
    again = store.stage_result("model", KEY, {}, write_content)
    assert not again.reused
    assert content_of(again.path) == CONTENT
    paths = list((tmp_path / ".corrupt").iterdir())
    assert len(paths) == 1


def harm(path: Path, damage: str) -> None:
    content = bytearray(path.read_bytes())
    if damage == "remove":
        path.unlink()
        return
    if damage == "flip":
        content[len(content) // 2] ^= 1
    truncate = content[:-1]
    damaged = {"flip": content, "truncate": truncate, "extend": content + b" "}
    path.write_bytes(damaged[damage])


def test_no_flipped_bit_anywhere_in_a_stage_is_silent(tmp_path: Path) -> None:
    stage = Store(tmp_path).stage_result("model", KEY, {}, write_content)
    rng = np.random.default_rng(0)
    silent = []
    for name in [*CONTENT, MANIFEST]:
        original = (stage.path / name).read_bytes()
        bits_of_file = 8 * len(original)
        smallest = min(150, bits_of_file)
        bits = rng.choice(bits_of_file, size=smallest, replace=False)
        for bit in bits:
            flipped = bytearray(original)
            flipped[bit // 8] ^= 1 << (bit % 8)
            (stage.path / name).write_bytes(flipped)
            manifest = read_intact_manifest(stage.path)
            if manifest is not None:
                silent.append((name, bit))
        (stage.path / name).write_bytes(original)
    assert silent == []
    assert read_intact_manifest(stage.path) is not None


def test_a_computation_that_raises_leaves_nothing(tmp_path: Path) -> None:
    def halfway(folder: Path) -> None:
        (folder / "half").write_text("x")
        raise RuntimeError("the solver gave up")

    with pytest.raises(RuntimeError, match="gave up"):
        Store(tmp_path).stage_result("model", KEY, {}, halfway)
    paths = list((tmp_path / "model").iterdir())
    assert paths == []
    stage_result = Store(tmp_path).stage_result("model", KEY, {}, write_content)
    assert not stage_result.reused


SLOWLY = """
import os, sys, time
from pathlib import Path
KEY = 64 * "a"
from ssm_study.engine.store import Store
root, ledger = Path(sys.argv[1]), Path(sys.argv[2])
def compute(folder):
    with ledger.open("a") as stream:
        stream.write(f"{os.getpid()}\\n")
    time.sleep(0.3)
    (folder / "model.json").write_text("{}")
stage = Store(root).stage_result("model", KEY, {}, compute)
assert (stage.path / "model.json").read_text() == "{}"
"""


def test_four_processes_compute_a_stage_once(tmp_path: Path) -> None:
    store_path = str(tmp_path / "store")
    ledger_path = str(tmp_path / "ledger")
    command = [sys.executable, "-c", SLOWLY, store_path, ledger_path]
    workers = [subprocess.Popen(command) for _ in range(4)]
    expected = [0] * 4
    exit_codes = [worker.wait(timeout=120) for worker in workers]
    assert exit_codes == expected
    text = (tmp_path / "ledger").read_text()
    lines = text.splitlines()
    assert len(lines) == 1


UNREACHED = """
import errno, fcntl, socket, sys, time
from pathlib import Path
root, ledger, node, keys = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4]
socket.gethostname = lambda: node
def flock(*_):
    if node == "b":
        raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = flock  # granted to everybody, or unknown to the file system
from ssm_study.engine.store import Store
def compute(folder):
    with ledger.open("a") as stream:
        stream.write(f"{node} {folder.name}\\n")
    time.sleep(0.2)
    (folder / "model.json").write_text(folder.name.split("-")[1])
for key in keys:
    stage = Store(root).stage_result("model", 64 * key, {}, compute)
    assert (stage.path / "model.json").read_text() == 32 * key, key
"""


def test_two_nodes_that_do_not_see_each_others_locks_share_their_stages(tmp_path: Path) -> None:
    """Six stages, taken from both ends, then the same ones by both at once: most are computed once,
    none is torn."""
    store = tmp_path / "store"
    ledger = tmp_path / "ledger"

    def nodes(**keys: str) -> list[str]:
        ledger.write_text("")
        command = [sys.executable, "-c", UNREACHED, str(store), str(ledger)]
        workers = [
            subprocess.Popen([*command, node, keys_of_node]) for node, keys_of_node in keys.items()
        ]
        expected = [0] * len(workers)
        exit_codes = [worker.wait(timeout=120) for worker in workers]
        assert exit_codes == expected
        return ledger.read_text().splitlines()

    nodes_of_reversed = nodes(a="012345", b="543210")
    assert 6 <= len(nodes_of_reversed) <= 8
    assert nodes(c="012345") == []
    nodes_of_equal = nodes(a="abc", b="abc")
    assert 3 <= len(nodes_of_equal) <= 6
    paths = (store / "model").iterdir()
    folders = list(paths)
    assert len(folders) == 9
    assert all(read_intact_manifest(folder) is not None for folder in folders)
    assert not (store / ".corrupt").exists()


def test_what_another_node_is_at_stays_and_what_it_saved_is_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file system without locks: another machine places the result while we are computing it."""
    from contextlib import nullcontext

    from ssm_study.engine import store as module

    monkeypatch.setattr(module, "file_lock", lambda _: nullcontext())

    def overtaken(folder: Path) -> None:
        (folder / "last.ckpt").write_text("half way")
        monkeypatch.setattr(module.socket, "gethostname", lambda: "elsewhere")
        Store(tmp_path).stage_result(
            "model",
            KEY,
            {},
            lambda theirs: write_content(theirs) or (theirs / "last.ckpt").unlink(),
        )
        write_content(folder)
        (folder / "last.ckpt").unlink()

    stage = Store(tmp_path).stage_result("model", KEY, {}, overtaken)
    assert content_of(stage.path) == CONTENT
    paths = (tmp_path / "model").iterdir()
    names = [path.name for path in paths]
    assert names == [stage.path.name]


def test_leftovers_of_the_killed_are_removed_by_the_next(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.stage_folder("model", KEY)
    leftover = folder.with_name(f".tmp-{folder.name}-deadbeef")
    leftover.mkdir(parents=True)
    store.stage_result("model", KEY, {}, write_content)
    assert not leftover.exists()


def test_what_the_killed_had_saved_goes_to_their_successor(tmp_path: Path) -> None:
    store = Store(tmp_path)
    folder = store.stage_folder("model", KEY)
    leftover = folder.with_name(f".tmp-{folder.name}-deadbeef")
    (leftover / "fold_2" / "start_1").mkdir(parents=True)
    for name in ("last.ckpt", "fold_2/start_1/last.ckpt", "half.json"):
        (leftover / name).write_text(name)

    def going_on(folder: Path) -> None:
        expected = ["fold_2/start_1/last.ckpt", "last.ckpt"]
        assert sorted(content_of(folder)) == expected
        text = (folder / "last.ckpt").read_text()
        (folder / "model.json").write_text(text)

    def stopped(folder: Path) -> None:
        (folder / "last.ckpt").write_text("more")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.stage_result("model", KEY, {}, stopped)
    stage_result = store.stage_result("model", KEY, {}, going_on)
    path = stage_result.path
    assert content_of(path)["model.json"] == b"more"
    assert not leftover.exists()


HOLDING = """
import sys, time
from pathlib import Path
from ssm_study.durable import file_lock
with file_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_lock_is_seen_and_dies_with_its_holder(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    assert not is_locked(path)
    command = [sys.executable, "-c", HOLDING, str(path)]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    assert is_locked(path)
    holder.kill()
    holder.communicate(timeout=30)
    assert not is_locked(path)


def test_a_plan_computes_nothing_and_knows_every_key(tmp_path: Path) -> None:
    store = Store(tmp_path)

    def line(stages: Store | PlannedStages, rate: float) -> str:
        stage = Stage(name="data", compute=write_kept)
        data = stages.run_stage(stage, {})
        stage = Stage(name="model", compute=write_kept)
        settings = {"order": 8}
        model = stages.run_stage(stage, settings, None, data)
        settings = {"rate": rate}
        synthesis = Stage(name="synthesis", compute=write_kept)
        stage = stages.run_stage(synthesis, settings, None, model)
        result = stage.result
        return result.key

    def planned() -> list[list[str]]:
        """Rows of the plan by stage: needed, there, to compute, seconds of each."""
        walks = [lambda s, r=r: line(s, r) for r in range(20)]
        texts = plan_lines(store, walks, 20, 0)[3:6]
        return [text.split() for text in texts]

    rows = [["data", *"101"], ["model", *"101"], ["synthesis", "20", "0", "20"]]
    expected = [[*row, "unknown"] for row in rows]
    assert planned() == expected
    assert not tmp_path.joinpath("model").exists()
    real = [line(store, rate) for rate in range(5)]
    expected = [line(PlannedStages(store), rate) for rate in range(5)]
    assert real == expected
    after = planned()
    expected = {"data": "0", "model": "0", "synthesis": "15"}
    missing_by_stage = {name: missing for name, _, _, missing, *_ in after}
    assert missing_by_stage == expected
    assert all(row[-1] == "s" for row in after)


def test_a_plan_reckons_with_the_mean_of_what_was_timed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three missing stages of 14 s, two at a time; a stage that was never timed makes of it a lower
    bound."""
    store = Store(tmp_path)
    mean_seconds = {"model": 14.0}
    monkeypatch.setattr(planning, "mean_stage_seconds", lambda _, stage: mean_seconds.get(stage))

    def walk(name: str, number: int) -> object:
        return lambda stages: stages.stage_result(
            name, digest_of_value([name, number]), {}, write_content
        )

    walks = [walk("model", k) for k in range(3)]
    plan = plan_lines(store, walks, 3, 0, 2)
    assert plan[-1] == "estimated time: about 21 s with 2 at a time"
    unknown_walk = walk("data", 0)
    with_unknown = plan_lines(store, [*walks, unknown_walk], 3, 0, 2)
    assert with_unknown[-1] == "estimated time: at least 21 s with 2 at a time"
    for seconds, duration in (
        (66.0, "99 s"),
        (200 / 3, "2 min"),
        (2000.0, "50 min"),
        (4000.0, "1.7 h"),
    ):
        mean_seconds["model"] = seconds
        plan_of_known = plan_lines(store, walks, 3, 0, 2)
        assert plan_of_known[-1] == f"estimated time: about {duration} with 2 at a time"


@pytest.mark.parametrize("name", ["../model", "a/b", "", ".hidden"])
def test_a_stage_name_cannot_leave_the_store(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadRequest, match="stage"):
        Store(tmp_path).stage_result(name, KEY, {}, write_content)


NOT_CANONICAL = [float("nan"), float("inf"), object(), {1, 2}]


@pytest.mark.parametrize("value", NOT_CANONICAL)
def test_a_configuration_without_a_canonical_text_is_refused(value: object) -> None:
    with pytest.raises(BadRequest, match="config"):
        canonical_json({"x": value})
