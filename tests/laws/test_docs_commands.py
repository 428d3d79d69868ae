"""Every command that README and docs show is executed, or composed and parsed; what nothing recognises is an error."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from ssm_study import cli
from ssm_study.results.naming import register_resolver

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(?:console|bash|sh|shell)\n(.*?)^```", re.M | re.S)
ELSEWHERE = {"git", "pip", "cd", "source", ".", "python3.11", "apt-get", "export", "tensorboard", "slurm_local.sh"}
EXTRAS = ("submitit", "ray")  # launchers that live in extras: their groups exist only where those are installed


def commands(page: Path) -> Iterator[str]:
    for block in FENCE.findall(page.read_text()):
        for line in block.replace("\\\n", " ").splitlines():
            command = re.sub(r"\s+#.*$", "", line.strip().removeprefix("$ "))
            if command and not command.startswith("#"):
                yield command


ALL = [pytest.param(command, id=f"{page.name}: {command[:70]}") for page in PAGES for command in commands(page)]


def test_there_are_commands_to_check() -> None:
    assert len(ALL) > 15


@pytest.mark.parametrize("command", ALL)
def test_every_command_is_recognised(command: str) -> None:
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S*", word)]
    words = words[1:] if words[0] in ("unshare", "time") else words
    program, arguments = Path(words[0]).name, words[1:]
    if program == "make":
        targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
        assert set(arguments) <= targets
    elif program == "ssm-study" and arguments[:1] == ["run"]:
        composed(arguments[1:])
    elif program == "ssm-study":
        cli._parser().parse_args(arguments)
    elif program == "python":
        assert (ROOT / arguments[0]).is_file() or arguments[0] == "-m", f"{arguments[0]} is not there"
        if arguments[0] == "experiments/run.py":
            composed(arguments[1:])
    else:
        assert program in ELSEWHERE or words[0] in ELSEWHERE, f"nothing here knows {program}"


def composed(arguments: list[str]) -> None:
    """The configuration of the first job of the request: unknown groups, options and values do not compose."""
    options = {word for word in arguments if word.startswith("-")}
    assert options <= {"-m", "--multirun", "--help", "--dry-run", "--retry-failed"}
    arguments = [word for word in arguments if word not in options]
    chosen = [first_value(word) for word in arguments if not is_from_an_extra(word)]
    named = [word for word in chosen if not word.split("=")[1].startswith("my_")]  # files the reader is to write
    register_resolver()
    with initialize_config_dir(str(cli.configuration_folder()), version_base="1.3"):
        config = compose("study", named, return_hydra_config=True)
    assert isinstance(config, DictConfig)
    OmegaConf.resolve(OmegaConf.masked_copy(config, [key for key in config if key not in ("hydra", "data")]))


def is_from_an_extra(word: str) -> bool:
    chosen = "launcher" in word and any(extra in word for extra in EXTRAS)
    return chosen or word.lstrip("+").startswith("hydra.launcher")


def first_value(word: str) -> str:
    override = OverridesParser.create().parse_override(word)
    if not override.is_sweep_override():
        return word
    if override.is_interval_sweep():
        return f"{override.input_line.split('=')[0]}={override.value().start}"
    return f"{override.input_line.split('=')[0]}={next(iter(override.sweep_string_iterator()))}"


@pytest.mark.parametrize("wrong", ["modle.order=4", "model.ordre=4", "synthesis=ricati", "experiment=papr"])
def test_a_misspelt_request_does_not_pass_this_check(wrong: str) -> None:
    with pytest.raises(Exception, match=r"Could not|not in|In 'study'"):
        composed([wrong])


def test_the_tutorial_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for command in commands(ROOT / "docs" / "tutorial.md"):
        program, *arguments = shlex.split(command)
        if program == "ssm-study":
            words = [sys.executable, "-m", "ssm_study.cli", *arguments]
            done = subprocess.run(words, capture_output=True, text=True, check=False)
            assert done.returncode == 0, f"{command}: {done.stderr[-2000:]}"
    assert (tmp_path / "results" / "first_sweep" / "report.html").is_file()
    assert (tmp_path / "results" / "first_sweep" / "figures" / "rates.pdf").is_file()
