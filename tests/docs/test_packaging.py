"""The page of dependencies and the source distribution agree with `pyproject.toml`."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
REQUIREMENT = re.compile(r"([\w-]+)(?:\[[\w,]+\])?>=([\d.]+)(?:,!=[\d.]+)*,<([\d.]+)")


def bounds():
    """Return (package, lower, upper) of every requirement, extras included."""
    project = SETTINGS["project"]
    extras = project["optional-dependencies"].values()
    listed = [*project["dependencies"], *(line for extra in extras for line in extra)]
    return {REQUIREMENT.fullmatch(line).groups() for line in listed if "torchpose[" not in line}


def test_every_dependency_is_on_its_page_with_its_bounds():
    page = (ROOT / "docs" / "dependencies.md").read_text("utf-8")
    found = set()
    for row in re.findall(r"^\|.*≥.*\|$", page, re.M):
        *_, names, given, _ = [cell.strip() for cell in row.strip("|").split("|")]
        packages = [re.sub(r"\[\w+\]", "", name) for name in names.split(", ")]
        limits = re.findall(r"≥ ([\d.]+), < ([\d.]+)", given)
        found |= {(name, *pair) for name, pair in zip(packages, limits, strict=True)}
    assert found == bounds()


def test_the_source_distribution_holds_what_its_pages_and_targets_use():
    included = {
        name.strip("/")
        for name in SETTINGS["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    }
    readme = (ROOT / "README.md").read_text("utf-8")
    linked = {link.split("/")[0] for link in re.findall(r"\]\((?!http)([^)#]+)", readme)}
    used = {
        word.split("/")[0]
        for word in re.findall(r"(\.ci/\w+)", (ROOT / "Makefile").read_text("utf-8"))
    }
    assert linked | used <= included
