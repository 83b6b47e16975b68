"""Every configuration, and every command on the page, is one that the parser takes."""

import doctest
import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

pytest.importorskip("lightning", reason="training needs the extra `train`")

from train.cli import main

ROOT = Path(__file__).parents[2]
CONFIGS = sorted(p.name for p in (ROOT / "configs").glob("*.yaml") if p.name != "predict.yaml")
PAGE = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")


def commands():
    """`train fit ...` and `train select ...` on the page, without what launches them."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line.partition("-m train ")[2] for line in lines if "-m train " in line]


@pytest.mark.parametrize("command", commands())
def test_commands_on_the_page(command, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    assert main([*shlex.split(command), "--print_config"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", [n for n in CONFIGS if n != "many-machines.yaml"])
def test_configurations(name, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    assert main(["fit", "--config", f"configs/{name}", "--print_config"]) == 0
    text = (ROOT / "configs" / name).read_text()
    assert f"configs/{name}" in text and f"configs/{name}" in PAGE
    keys = [line for line in text.splitlines() if re.match(r"\s+\w+: \S", line)]
    assert sum("#" in line for line in keys) >= 0.4 * len(keys), "say what keys do"


def test_configurations_on_top_of_each_other(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    files = [f"--config=configs/{n}.yaml" for n in ("kinect-upper-body-small", "many-machines")]
    assert main(["fit", *files, "--print_config"]) == 0
    printed = capsys.readouterr().out
    assert "ckpt_path: auto" in printed and "n_components: 10" in printed


@pytest.mark.parametrize("name", ["command", "checkpoints"])
def test_examples_in_docstrings(name):
    result = doctest.testmod(import_module(f"train.{name}"))
    assert result.attempted and not result.failed
