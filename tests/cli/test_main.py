"""`torchpose` itself: help, version, exit codes, and that written command lines parse."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from torchpose.cli import COMMANDS
from torchpose.cli import _evaluate as evaluate
from torchpose.cli import main as main_function
from torchpose.cli._command import Command

ROOT = Path(__file__).parents[2]
HELP = [(name,) for name in COMMANDS] + [("evaluate", name) for name in evaluate.PROTOCOLS]


def python(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=120, cwd=ROOT
    )


def test_as_a_module():
    done = python("-m", "torchpose", "--version")
    assert done.returncode == 0 and re.fullmatch(r"torchpose \d.*\n", done.stdout)
    done = python("-m", "torchpose", "trakc")
    assert done.returncode == 2
    known = ", ".join(COMMANDS)
    assert done.stderr == f"torchpose: error: unknown command 'trakc'; known are {known}\n"


def test_help_comes_without_torch():
    code = "import sys; from torchpose.cli import main; main(['--help'])\nprint(*sys.modules)"
    assert "torch" not in python("-c", code).stdout.splitlines()[-1].split()


def test_what_a_command_loads_is_left_out_of_collections_of_garbage():
    code = (
        "import gc; from torchpose.cli import main\n"
        "passes = []; gc.callbacks.append(lambda phase, info: passes.append(info['generation']))\n"
        "main(['track', '--help']); print(gc.isenabled(), gc.get_freeze_count() > 100_000, passes.count(2))"
    )
    enabled, frozen, whole = python("-c", code).stdout.split()[-3:]
    assert (enabled, frozen) == ("True", "True")
    assert int(whole) <= 1


def test_help(torchpose):
    for done in (torchpose("--help"), torchpose("-h")):
        assert done.code == 0 and done.err == ""
        assert all(command in done.out for command in COMMANDS)
    done = torchpose()
    assert done.code == 2 and "usage: torchpose COMMAND" in done.err


@pytest.mark.parametrize("command", HELP, ids=" ".join)
def test_help_of_commands(command, torchpose):
    done = torchpose(*command, "--help")
    assert done.code == 0 and "examples:" in done.out and "--config" in done.out
    assert max(map(len, done.out.splitlines())) <= 110


def test_interruption(torchpose, monkeypatch):
    def interrupt(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchpose.cli._info.main", interrupt)
    assert torchpose("info").code == 130


def test_bugs_are_not_hidden(torchpose, monkeypatch):
    def broken(arguments):
        raise ZeroDivisionError

    monkeypatch.setattr("torchpose.cli._info.main", broken)
    with pytest.raises(ZeroDivisionError):
        torchpose("info")


def console_lines() -> list[str]:
    """Every line that a page or a help text tells the reader to type."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = []
    for page in pages:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        found += re.findall(r"^\$ (torchpose .*)$", text, re.MULTILINE)
    for path in sorted((ROOT / "torchpose" / "cli").glob("*.py")):
        found += re.findall(r"^ *(torchpose [a-z-]+ .*?)\"*$", path.read_text(), re.MULTILINE)
    return sorted({re.split(r" +[#>] ?", line)[0].strip() for line in found})


@pytest.mark.parametrize("line", console_lines())
def test_written_command_lines_parse(line, monkeypatch, tmp_path):
    """The parser of each takes it; the work is not done."""
    parsed = []
    monkeypatch.setattr(Command, "call", lambda _, given: parsed.append(given) or 0)
    monkeypatch.setattr("torchpose.cli._evaluate.execute", lambda *args: parsed.append(args) or 0)
    words = shlex.split(line)[1:]
    if "--config" in words:  # the file has to be there
        config = tmp_path / "config.yaml"
        config.write_text("input: keypoints.npz\nout: result\n")
        words[words.index("--config") + 1] = str(config)
    assert main_function(words) == 0
    assert parsed or {"--help", "--version", "--print_config"} & {*words}


@pytest.mark.parametrize("seed", ["-1", str(2**64), "9" * 5000, "1.5", "x", ""])
def test_seeds_that_no_generator_takes(torchpose, files, tmp_path, seed):
    done = torchpose("track", files / "keypoints.npz", "--out", tmp_path / "out", "--seed", seed)
    assert done.code == 2 and "--seed" in done.err and len(done.err.splitlines()) == 1
    assert len(done.err) < 1500


def test_a_prior_that_is_null(torchpose, files, tmp_path):
    config = tmp_path / "track.yaml"
    config.write_text(f"input: {files / 'keypoints.npz'}\nout: {tmp_path / 'out'}\nprior: null\n")
    done = torchpose("track", "--config", config)
    assert done.code == 2 and len(done.err.splitlines()) == 1


def test_a_rate_that_no_camera_has(torchpose, files, tmp_path):
    done = torchpose("track", files / "keypoints.npz", "--out", tmp_path / "out", "--fps", "10000")
    assert done.code == 2 and "at most 1000 frames per second" in done.err
