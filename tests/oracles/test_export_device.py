"""The C code against the same law in NumPy, the law against the Python loop, rounding against exact
arithmetic."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from export_cases import compiled, device, products, written
from report_runs import KINDS, random_scaffold

import ssm_study as st
from ssm_study.bounds.network import invert_map
from ssm_study.certificates.certificate import Design
from ssm_study.cli.main import main
from ssm_study.export.c import escape_comment, render_c_files
from ssm_study.export.device import DeviceController
from ssm_study.export.set_point_text import describe_set_points, held_set_points
from ssm_study.export.targets import load_controller, prove_deployed_rates, render_c_sources
from ssm_study.loop.controller import ObserverFeedback
from ssm_study.loop.trajectory import set_point_equilibria
from ssm_study.models.identified import SSM
from ssm_study.refusal import BadRequest

SAMPLES = 150


def signals(model: SSM, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements that go far, and set points that inputs well within the limits hold."""
    rng = np.random.default_rng(seed)
    outputs = model.scale.outputs
    levels = rng.uniform(-1, 1, (2, SAMPLES // 15, outputs)).repeat(15, axis=1)
    lifted = model.scaffold_in(levels[1])
    linear_a = model.linear.a
    difference = np.eye(model.order) - linear_a
    linear_b = model.linear.b
    rest = np.linalg.solve(difference, linear_b)
    w = 1000 * levels[0]
    return model.scale.physical_output(w), model.output_at(lifted @ rest.T, lifted)


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("kind", KINDS)
def test_c_equals_the_law_to_the_last_digit(tmp_path: Path, kind: str, real: str) -> None:
    made = device(tmp_path, kind=kind, real=real, integral=kind != "residual")
    folder = written(made, tmp_path / "c")
    assert compiled(folder, "-std=c99").startswith("0 of 200 inputs differ")
    separate = ("controller_replay.c", "controller.c")
    words = ("-std=c11", "-DCONTROLLER_EXTERN", "-O0")
    text = compiled(folder, *words, sources=separate)
    assert text.startswith("0 of 200")


@pytest.mark.parametrize(
    "words", [("-std=c++17", "-x", "c++"), ("-fsanitize=address,undefined", "-O0")]
)
def test_as_cpp_and_under_sanitizers(tmp_path: Path, words: tuple[str, ...]) -> None:
    made = device(tmp_path, kind="monotone", channels=2, real="float", integral=True)
    folder = written(made, tmp_path / "c")
    compiler = "g++" if "c++" in words else "gcc"
    text = compiled(folder, *words, compiler=compiler)
    assert text.startswith("0 of 400 inputs differ")


def test_a_wrong_number_is_seen(tmp_path: Path) -> None:
    folder = written(device(tmp_path, kind="mlp"), tmp_path / "c")
    text = (folder / "controller.h").read_text()
    gain = re.search(r"controller_k\[\d+\] = \{(\S+?),", text)
    assert gain
    wrong_text = text.replace(gain[1], f"1.001 * {gain[1]}")
    (folder / "controller.h").write_text(wrong_text)
    with pytest.raises(AssertionError, match=r"of 200 inputs differ"):
        compiled(folder, "-std=c99")


@pytest.mark.parametrize(("kind", "channels"), [("linear", 2), ("monotone", 2), ("mlp", 2)])
def test_the_header_counts_the_multiplications_of_a_sample(
    tmp_path: Path, kind: str, channels: int
) -> None:
    """With pieces and matrices, with set points and without; while a limit acts there are fewer."""
    made = device(tmp_path, kind=kind, channels=channels, integral=True)
    lower = made.lower - 1e9
    upper = made.upper + 1e9
    free = replace(made, lower=lower, upper=upper)
    expected = products(free, tmp_path / "c")
    assert free.multiplication_count == expected


@pytest.mark.parametrize(("real", "size"), [("double", 8), ("float", 4)])
def test_the_header_counts_the_bytes_of_its_constants(tmp_path: Path, real: str, size: int) -> None:
    controller_path = (
        written(device(tmp_path, kind="mlp", real=real), tmp_path / "c") / "controller.h"
    )
    header = controller_path.read_text()
    tables = re.findall(rf"static const {real} \w+\[\d+\] = \{{(.*?)\}};", header, re.DOTALL)
    numbers = sum(len(table.split(",")) for table in tables)
    assert f"CONSTANT_BYTES {numbers * size} " in header


@pytest.mark.parametrize("integral", [False, True, ["ramp"]])
@pytest.mark.parametrize(
    ("kind", "channels"), [("linear", 2), ("monotone", 2), ("mlp", 1), ("residual", 1)]
)
def test_the_law_is_the_python_loop(
    tmp_path: Path, kind: str, channels: int, integral: bool | list[str]
) -> None:
    """At rest points of the model, found by root search there and by the inverse's pieces here;
    limits act in both."""
    made = device(tmp_path, kind=kind, channels=channels, integral=integral)
    model_path = tmp_path / "run" / "model.json"
    text = model_path.read_text()
    content = json.loads(text)
    model = SSM.from_json(content)
    certificate_path = tmp_path / "run" / "certificate.json"
    design = Design.load(certificate_path)
    law = ObserverFeedback.from_design(model, design)
    y, r = signals(model, channels)
    targets = law.target_trajectory(r)
    points = set_point_equilibria(model, r)
    targets[:, : points.shape[1]] = points
    targets[:, points.shape[1] :] = r
    vector = made.equilibrium_state(y[0])
    memory = vector[None]
    expected = []
    for seen, target in zip(y, targets, strict=True):
        inputs = law.input(memory, seen[None], target)
        expected.append(np.clip(inputs, made.lower, made.upper))
        memory = law.next_memory(memory, expected[-1], seen[None], target)
    applied = made.recomputed_inputs(y, r)
    difference = np.abs(applied - np.concatenate(expected))
    largest_difference = difference.max()
    assert largest_difference < 1e-7
    assert ((applied == made.lower) | (applied == made.upper)).any()
    assert ((applied > made.lower) & (applied < made.upper)).any()


@pytest.mark.parametrize("kind", ["linear", "monotone"])
def test_the_header_names_the_set_points_that_the_limits_hold(tmp_path: Path, kind: str) -> None:
    """At its ends an input limit holds the model; of a set point beyond the end is taken."""
    made = device(tmp_path, kind=kind)
    c = made.controller
    held = held_set_points(made)
    assert held is not None
    low, high = held
    assert low < c.scale.output_equilibrium < high
    for end, beyond in ((low, low - 1.0), (high, high + 1.0)):
        nearest = made.nearest_equilibrium(np.array([beyond]))
        output = c.scale.physical_output(nearest["w"])
        np.testing.assert_allclose(output, end)
        u = c.scale.physical_input(nearest["v"])
        assert np.isclose(u, made.lower) or np.isclose(u, made.upper)
    (sentence,) = describe_set_points(made)
    assert sentence == (
        f"The limits hold set points from {low:.6g} to {high:.6g}; of others the nearest is taken."
    )


def test_a_set_point_beyond_the_limits_is_approached_and_nothing_winds_up(tmp_path: Path) -> None:
    """The rest point at the limit is held; back within reach the input leaves the limit at once."""
    made = device(tmp_path, kind="monotone", integral=True)
    c = made.controller
    w = np.array([50.0])
    r = c.scale.physical_output(w)
    far = made.nearest_equilibrium(r)
    assert c.scale.physical_input(far["v"]) in (made.lower, made.upper)
    rest = c.scale.physical_output(far["w"])
    x = far["x"]
    for _ in range(200):  # held at what it can reach, measured without error
        w = np.array([50.0])
        r = c.scale.physical_output(w)
        u, x = made.compute_step(x, rest, r)
    difference = np.abs(x - far["x"])
    largest_difference = difference.max()
    assert largest_difference < 1e-9
    r = c.scale.output_equilibrium
    u, _ = made.compute_step(x, rest, r)
    difference = np.abs(u - c.scale.physical_input(far["v"]))
    assert difference > 0.1 * c.scale.input_scale


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("channels", [1, 2])
def test_the_inverse_undoes_the_map(kind: str, channels: int) -> None:
    rng = np.random.default_rng(4)
    scaffold = random_scaffold(rng, kind, channels)
    portable = scaffold.as_portable()
    inverse = invert_map(portable)
    portable_map = portable(np.linspace(-9, 9, 5000)[:, None] * np.ones(channels))
    slopes = np.diff(portable_map, axis=0)
    if kind in ("mlp", "residual") and (channels == 2 or slopes.min() * slopes.max() < 0):
        assert inverse is None, "channels are coupled, or the map turns"
        return
    assert inverse is not None
    rng = np.random.default_rng(0)
    white_noise = rng.standard_normal((200, channels))
    v = white_noise * 4
    w = portable(v)
    back = inverse(w)
    difference = np.abs(back - v)
    largest_difference = difference.max()
    assert largest_difference < 1e-9


def test_a_map_with_a_flat_piece_has_no_inverse() -> None:
    rng = np.random.default_rng(1)
    scaffold = random_scaffold(rng, "monotone", 1)
    slopes = scaffold.slopes * (np.arange(6) != 2)
    flat = replace(scaffold, slopes=slopes)
    portable = flat.as_portable()
    assert invert_map(portable) is None


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    a = [[0.95, 0.1], [0.0, 0.8]]
    b = [[0.02], [0.3]]
    c = [[1.0, 0.0]]
    d = [[0.0]]
    plant = control.StateSpace(a, b, c, d, 0.1)
    rates = ("synthesis.rate_controller=0.3", "synthesis.rate_observer=0.4")
    design = st.control(plant, "synthesis=riccati", *rates)
    run_path = tmp_path_factory.mktemp("certified") / "run"
    return design.save(run_path)


def test_rounding_is_certified_for_what_is_deployed(certified: Path) -> None:
    """float64 changes nothing; float32 has its own verdict; float32 of a spoilt gain, or of a huge
    rate, has none."""
    design = Design.load(certified / "certificate.json")
    controller = load_controller(certified)
    none = np.array([np.inf])
    exact = prove_deployed_rates(
        DeviceController.from_controller(controller, "double", -none, none), design
    )
    proved = {side: design.certified_rate(side) for side in ("state_feedback", "observer")}
    assert exact == proved  # the largest of these gains
    assert proved["state_feedback"] > 0.3  # what was asked
    assert proved["observer"] > 0.4
    single = DeviceController.from_controller(controller, "float", -none, none)
    rounded = prove_deployed_rates(single, design)
    controller_a = single.controller.a
    controller_b = single.controller.b
    controller_k = single.controller.k
    a, b, k = (np.asarray(x, dtype=float) for x in (controller_a, controller_b, controller_k))
    assert not np.array_equal(a, controller.a)
    assert 0 < rounded["state_feedback"] <= proved["state_feedback"]
    eigenvalues = np.linalg.eigvals(a + b @ k)
    radius = np.abs(eigenvalues).max()
    assert radius < np.sqrt(1 - rounded["state_feedback"])
    controller_k = single.controller.k
    spoilt = replace(single, controller=replace(single.controller, k=-3 * controller_k))
    state_feedback = prove_deployed_rates(spoilt, design)["state_feedback"]
    assert state_feedback is None


def test_a_rate_that_rounding_costs_is_the_largest_that_is_left(certified: Path) -> None:
    """A stored rate of 0.99, which the matrices do not prove, is replaced by what they do prove, to
    a 4096th of that."""
    design = Design.load(certified / "certificate.json")
    none = np.array([np.inf])
    part = design.state_feedback
    device = DeviceController.from_controller(load_controller(certified), "double", -none, none)
    state_feedback = replace(part, rate=0.99)
    faster = replace(design, state_feedback=state_feedback, extra_certificates={})
    found = prove_deployed_rates(device, faster)["state_feedback"]
    assert 0.3 < found < 0.99
    for rate, proved in ((found, True), (found + 0.99 / 4096, False)):
        state_feedback = replace(part, rate=rate)
        stored = replace(design, state_feedback=state_feedback, extra_certificates={})
        state_feedback = prove_deployed_rates(device, stored)["state_feedback"]
        assert (state_feedback == rate) is proved


def test_what_rounding_does_to_the_loop_is_measured_and_told(certified: Path) -> None:
    """In single precision a few of its units; in double nothing is said."""
    reals = ("float", "double")
    single, double = (render_c_sources(certified, real=real)["controller.h"] for real in reals)
    assert "Rounding to" not in double
    (told,) = re.findall(
        r"Rounding to float moves the loop on the model by at most (\S+) output scales", single
    )
    unit = float(np.finfo(np.float32).eps)
    assert 0.01 * unit < float(told) < 100 * unit


@pytest.mark.parametrize(
    "name", ["evil */ int x; /*", "back\\\\slash\\", "new\nline\\\n*/", "what??/\n"]
)
def test_a_name_ends_no_comment(tmp_path: Path, name: str) -> None:
    folder = written(device(tmp_path, kind="linear"), tmp_path / "c", about=name)
    assert compiled(folder, "-std=c99").startswith("0 of 200")
    assert not set("*\\\n/?") & set(escape_comment(name))


def test_export_writes_what_was_asked(tmp_path: Path, smoke_run: Path) -> None:
    """Limits of the record, units and digest in the header; an own prefix and float."""
    to = tmp_path / "out"
    assert (
        main(["export", str(smoke_run), "--to", str(to), "--real", "float", "--prefix", "drive"])
        == 0
    )
    text = (to / "drive.h").read_text()
    assert "input 0: armature_voltage (V), limited to" in text
    assert (
        text.count(hashlib.sha256((smoke_run / "certificate.json").read_bytes()).hexdigest()) == 2
    )
    assert "output 0: load_speed (rad/s), seen from" in text
    assert "controller" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    assert re.search(
        r"Rates proved for the numbers below, in float: state feedback 0\.\d+, observer 0\.\d+",
        text,
    )
    assert compiled(to, "-std=c99", sources=("drive_replay.c",)).startswith("0 of 200")


def test_two_controllers_in_one_program(tmp_path: Path) -> None:
    for name, kind in (("inner", "mlp"), ("outer", "monotone")):
        written(device(tmp_path / name, kind=kind), tmp_path / "c", name=name)
    both_path = tmp_path / "c" / "both.c"
    both_path.write_text('#include "inner.h"\n#include "outer.h"\nint main(void) { return 0; }\n')
    assert compiled(tmp_path / "c", "-std=c99", sources=("both.c",)) == ""


def test_refusals(tmp_path: Path) -> None:
    made = device(tmp_path, kind="linear")
    for name in ("two words", "9lives", "float", "while", ""):
        with pytest.raises(BadRequest, match="is no name in C"):
            render_c_files(made, name, origin_text="")
    with pytest.raises(BadRequest, match=r"real = half: unknown; use double or float"):
        device(tmp_path / "half", kind="linear", real="half")
    coupled = device(tmp_path / "two", kind="mlp", channels=2)
    assert coupled.set_point_maps is None
    files = render_c_files(coupled, origin_text="")
    header = files["controller.h"]
    assert "No set points: a map couples channels." in header
    assert "controller_track(controller_state" not in header


def test_why_a_linear_model_has_no_set_points(tmp_path: Path) -> None:
    made = device(tmp_path, kind="linear")
    assert made.no_set_points_reason == ""
    unseen = {name: 0 * getattr(made.controller, name) for name in "cd"}
    blind = replace(made, controller=replace(made.controller, **unseen))
    assert blind.no_set_points_reason == "no constant input reaches every output"
    held = np.eye(len(made.controller.a))
    integrating = replace(made, controller=replace(made.controller, a=held))
    assert integrating.no_set_points_reason.startswith("the model integrates, but not")
