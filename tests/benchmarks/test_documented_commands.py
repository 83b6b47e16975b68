"""The commands of the benchmarks that the pages name take the options that they are given there."""

import functools
import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks._command import execute, spell_out_switches
from benchmarks._protocols import PROTOCOLS
from tests.benchmarks.test_command import OWN_PARSERS
from torchpose.cli._evaluate import build

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", *(ROOT / "docs").rglob("*.md")]
OTHERS = {"speed", "speed.NAME"} | {
    name.removesuffix(".py").removesuffix("/__main__").replace("/", ".") for name in OWN_PARSERS
}


def documented():
    """Return (name, options) of every command, from prose, blocks of code and the list."""
    found = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        text = re.sub(r"(?<!`)`[^`]+`(?!`)", lambda code: code[0].replace("\n", " "), text)
        found.update(re.findall(r"python -m benchmarks\.(\w+(?:\.\w+)?)\b([^`\n#(;]*)", text))
    listed = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    speed = listed.index("| `python -m benchmarks.speed.`")
    for match in re.finditer(r"^\| `(?!python)(\w+)([^`]*)` \|", listed, re.M):
        found.add((("speed." if match.start() > speed else "") + match[1], match[2]))
    return sorted(
        (name, options.removesuffix("-->").strip(" ,:"))
        for name, options in found
        if name not in OTHERS
    )


def test_every_command_is_on_the_list():
    listed = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    names = set(re.findall(r"^\| `(?:python -m benchmarks\.)?(\w+)[^`]*` \|", listed, re.M))
    commands = [
        path
        for path in (ROOT / "benchmarks").rglob("*.py")
        if re.search(r"^    run_(command|protocol)\(", path.read_text("utf-8"), re.M)
        or path.name in OWN_PARSERS
    ]
    found = {path.parent.name if path.stem == "__main__" else path.stem for path in commands}
    assert found <= names
    assert len(found) > 50


def main_of(name):
    """Return the function that a command runs, of a module or of a package."""
    module = import_module(f"benchmarks.{name}")
    if not hasattr(module, "main"):
        module = import_module(f"benchmarks.{name}.__main__")
    return module.main


@pytest.mark.parametrize(("name", "options"), documented())
def test_documented_options_are_taken(name, options, tmp_path, monkeypatch, capsys):
    pytest.importorskip("cv2")
    monkeypatch.chdir(tmp_path)
    arguments = shlex.split(options.replace("[", "").replace("]", ""))
    if name in PROTOCOLS:
        protocol = PROTOCOLS[name]
        parser = build(f"benchmarks.{name}", protocol, "python -m")
        given = ["--data", "DIR", "--out", "OUT"] if "--out" not in arguments else []
        parser.parse_args([*given, *spell_out_switches(arguments, protocol.options)])
        return
    ran = []

    @functools.wraps(main_of(name))
    def instead(*args, **values):
        ran.append(values)

    code = execute(instead, arguments)
    assert code == 0, capsys.readouterr().err
    assert ran
