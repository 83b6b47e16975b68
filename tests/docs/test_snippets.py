"""Every piece of code in the documentation runs, and prints what the pages say it prints.

A snippet starts in an empty folder that holds `keypoints.npz` and, if it reads it, `clip.mp4`. Lines
that begin with `# >` are its expected output. What docs/ includes and what README.md shows are these
very files.
"""

import re
import runpy
import shutil
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
SNIPPETS = sorted((ROOT / "docs" / "snippets").glob("*.py"))
PAGES = sorted((ROOT / "docs").rglob("*.md"))


@pytest.fixture(scope="session")
def clip(tmp_path_factory):
    """Two thirds of a second of a rendered performer; who is seen for half a second counts."""
    from torchpose.demo import demo_camera, performer
    from torchpose.demo._rendering import render_video

    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    render_video(path, performer(20, 30.0, 0), demo_camera())
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder with the keypoints of head, neck and hands, one second long."""
    from torchpose.io import Keypoints, write_keypoints

    seconds = torch.arange(30, dtype=torch.float64) / 30
    still = torch.tensor([[320.0, 160.0], [320.0, 205.0], [400.0, 330.0], [240.0, 330.0]])
    points = still.double().repeat(30, 1, 1)
    points[:, 2, 1] -= 60 * (1 - torch.cos(seconds * 2))
    points[10:20, 3] = torch.nan
    names = ("head", "neck", "hand_left", "hand_right")
    clip = Keypoints(points, names, fps=30.0, image_size=(640, 480))
    write_keypoints(tmp_path / "keypoints.npz", clip)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def methods():
    """Take back what a snippet registers."""
    from torchpose.upper_body import METHODS
    from torchpose.whole_body._filter_table import METHODS as BODY_METHODS

    before = [(table, dict(table)) for table in (METHODS, BODY_METHODS)]
    yield
    for table, entries in before:
        table.clear()
        table.update(entries)


@pytest.mark.parametrize("path", SNIPPETS, ids=lambda p: p.stem)
def test_snippet(path, folder, request, capsys):
    if "clip.mp4" in path.read_text():
        shutil.copy(request.getfixturevalue("clip"), folder)
    state = torch.get_rng_state()
    runpy.run_path(str(path), run_name="__main__")
    torch.set_rng_state(state)
    expected = [line[4:] for line in path.read_text().splitlines() if line.startswith("# > ")]
    if expected:
        assert capsys.readouterr().out.splitlines() == expected


def test_code_on_the_pages_comes_from_files():
    """Python on a page is included from docs/snippets; console sessions and data may be typed."""
    names = {path.name for path in SNIPPETS}
    used = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in re.findall(r"```python[^\n]*\n(.*?)```", text, re.DOTALL):
            included = re.fullmatch(r'--8<-- "snippets/(\w+\.py)"\n', block)
            assert included, f"{page}: typed code, which no test runs:\n{block}"
            used.add(included[1])
    assert used == names


def test_what_pages_include_is_there():
    bases = (ROOT / "docs", ROOT / "torchpose" / "weights")
    for page in PAGES:
        for name in re.findall(
            r'^--8<-- "([^":]+)', page.read_text(encoding="utf-8"), re.MULTILINE
        ):
            assert any((base / name).is_file() for base in bases), f"{page}: {name} is missing"


def test_parts_of_pages_that_are_included_have_the_heads_of_their_tables():
    found = 0
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name, first, last in re.findall(r'^--8<-- "([^":]+):(\d+):(\d+)"', text, re.MULTILINE):
            lines = (ROOT / "docs" / name).read_text(encoding="utf-8").splitlines()
            part = ["", *lines[int(first) - 1 : int(last)]]
            heads = [part[i + 1 : i + 3] for i, line in enumerate(part[:-2]) if not line.strip()]
            for head, below in (pair for pair in heads if pair[0].startswith("|")):
                assert re.fullmatch(r"[|:\s-]+", below), (
                    f"{page}: {name}:{first} begins with {head}"
                )
                found += 1
    assert found > 4


def test_lists_stay_lists_on_the_built_pages():
    """Markdown's Python package wants four spaces within an item, and merges lists that follow each other."""
    for page in PAGES:
        text = re.sub(r"^( *)```.*?^\1```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for wrong in (
            r"\n\n {2,3}[^ \n-][^\n]*",  # after an empty line an item goes on with four
            r"\n    \S[^\n]*\n- [^\n]*",  # and the next one needs an empty line after that
            r"\n\d+\. [^\n]*(?:\n +\S[^\n]*)*\n\n- [^\n]*",  # numbers, and then points
        ):
            found = re.search(wrong, text)
            assert found is None, f"{page}: {found and found[0].strip()}"


def test_readme_shows_a_snippet():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    assert blocks
    for block in blocks:
        assert block in {path.read_text() for path in SNIPPETS}
