"""The reference has a page for every room, made from the room's `__all__`, and the site shows it."""

import pkgutil
import re
import warnings
from pathlib import Path

import pytest

import torchpose

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
ROOMS = ("torchpose", *sorted(torchpose._PACKAGES))


def test_there_is_a_page_for_every_room():
    pages = {path.stem for path in REFERENCE.glob("*.md")}
    assert pages == {"index", *ROOMS}


@pytest.mark.parametrize("room", ROOMS)
def test_the_page_shows_the_room_and_nothing_private(room):
    module = "torchpose" if room == "torchpose" else f"torchpose.{room}"
    shown = re.findall(r"^::: (\S+)$", (REFERENCE / f"{room}.md").read_text("utf-8"), re.MULTILINE)
    assert shown[0] == module
    for subpackage in shown[1:]:
        assert subpackage.startswith(f"{module}.")
        folder = ROOT.joinpath(*subpackage.split("."))
        assert "__all__" in (folder / "__init__.py").read_text("utf-8")


@pytest.mark.parametrize("room", ROOMS)
def test_the_site_lists_the_page(room):
    assert f"reference/{room}.md\n" in (ROOT / "mkdocs.yml").read_text("utf-8")
    assert f"({room}.md)" in (REFERENCE / "index.md").read_text("utf-8")


def test_names_on_the_pages_are_those_of_today():
    """`torchpose.room.name` in running text is there, and goes with no later release."""
    names = {
        name
        for page in PAGES
        for name in re.findall(r"`(torchpose(?:\.\w+)+)", page.read_text("utf-8"))
    }
    assert len(names) > 20
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        for name in sorted(names):
            pkgutil.resolve_name(name)
