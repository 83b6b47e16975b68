"""The tables of methods and options on the page agree with the methods and the signatures."""

import re
from pathlib import Path

import pytest
import torch

import torchpose
from torchpose.demo import KEYPOINT_NAMES, noisy_keypoints, performer
from torchpose.errors import InputError
from torchpose.upper_body import METHODS, UpperBodyTracker, method_options
from torchpose.whole_body._filter_table import METHODS as BODY_METHODS
from torchpose.whole_body._filter_table import method_options as body_options
from torchpose.whole_body._filters.body_particles import BodyFilterOptions

PAGE = (Path(__file__).parents[2] / "docs" / "which-tracker.md").read_text("utf-8")


def table(first_columns):
    """Return the rows of the one table whose header begins so, as lists of cells."""
    _, *rest = PAGE.split(f"| {first_columns} |")
    assert len(rest) == 1, first_columns
    lines = rest[0].splitlines()[2:]
    rows = lines[: next(i for i, line in enumerate(lines) if not line.startswith("|"))]
    return [[cell.strip() for cell in row.strip("| ").split(" | ")] for row in rows]


def code(cell):
    return re.findall(r"`([^`]+)`", cell)


METHOD_ROWS = {code(row[0])[0]: row for row in table("method | what it follows")}
BODY_ROWS = {code(row[1])[0]: row for row in table("filter | method | what it adds")}


def test_every_method_has_a_row():
    assert list(METHOD_ROWS) == list(METHODS)
    assert set(BODY_ROWS) == set(BODY_METHODS)


@pytest.fixture(scope="module")
def prior():
    return torchpose.load_prior("kinect-upper-body-small")


@pytest.mark.parametrize("method", METHODS)
def test_a_row_says_how_the_method_behaves(method, prior):
    draws, evidence, smooths = METHOD_ROWS[method][2:5]
    keypoints = noisy_keypoints(performer(6, seed=0).joints, std_px=3.0)[None]
    few = {"n_particles": 40} if "n_particles" in method_options(method) else {}
    tracker = UpperBodyTracker(prior, prior.camera, method, **few)
    first, second = (
        tracker(keypoints, names=KEYPOINT_NAMES, generator=torch.Generator().manual_seed(seed))
        for seed in (0, 1)
    )
    assert (draws == "yes") == (not torch.equal(first.joints3d, second.joints3d))
    assert (evidence == "yes") == bool(torch.isfinite(first.log_evidence).all())
    if smooths == "yes":
        UpperBodyTracker(prior, prior.camera, method, smoothing="full", **few)
    else:
        with pytest.raises(InputError, match="smooth"):
            UpperBodyTracker(prior, prior.camera, method, smoothing="full", **few)


def test_the_options_are_those_of_the_methods():
    rows = {
        m: code(options) for methods, options in table("method | options") for m in code(methods)
    }
    assert rows == {method: list(method_options(method)) for method in METHODS}


@pytest.mark.parametrize("method", BODY_METHODS)
def test_a_row_says_what_a_filter_of_bodies_takes(method):
    filter_class, needs = BODY_METHODS[method]
    name, _, _, stated_needs, options, _ = BODY_ROWS[method]
    own = [o for o in body_options(method) if o not in BodyFilterOptions.__annotations__]
    assert code(name) == [filter_class.__name__]
    assert code(options) == own
    words = {"manifold": "manifold", "conditionals": "conditionals", "action": "action space"}
    assert (stated_needs == "a body") if needs is None else (words[needs] in stated_needs)


def test_the_shared_options_of_filters_of_bodies_are_listed():
    stated = code(PAGE.split("All of them also take ")[1].split(";")[0])
    assert stated == [o for o in BodyFilterOptions.__annotations__ if o != "step_std"]
