"""Options read from signatures: types, defaults, choices and texts, and that they reach what they are of."""

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypedDict, Unpack

import pytest
from torch import Tensor

from tests.cli.conftest import keypoints
from torchpose.cli import COMMANDS
from torchpose.cli import _demo as demo
from torchpose.cli import _fit as fit
from torchpose.cli import _fit_bodies as fit_bodies
from torchpose.cli import _info as info
from torchpose.cli import _track as track
from torchpose.cli import _track_body as track_body
from torchpose.cli import _track_body_options as track_body_options
from torchpose.cli._command import Command
from torchpose.cli._options import REQUIRED, documented, options_of, options_of_methods
from torchpose.io import write_keypoints
from torchpose.learning import ActionRecipe, ManifoldRecipe, UpperBodyRecipe
from torchpose.upper_body import METHODS, method_options, register_method
from torchpose.upper_body._keypoint_files import TrackSettings
from torchpose.upper_body._windows import WindowMixture
from torchpose.whole_body import _filter_table as body_methods

COMMAND_OF = {
    "track": track.command,
    "track-body": track_body.command,
    "fit": fit.command,
    **{f"fit {kind}": lambda kind=kind: fit_bodies.command(kind) for kind in fit_bodies.KINDS},
    "demo": lambda: Command("demo", demo.run, ""),
    "info": lambda: Command("info", info.run, ""),
}


class Colour(Enum):
    RED = 1
    BLUE = 2


@dataclass
class Settings:
    """Settings of a drawing.

    Args:
        width, height: of the page, metres. colour: of the lines; by default black. file: where to.
        names: of the lines,
            one each. seed: of the noise (see `noise`). model: of a person, or its name.
    """

    width: float
    height: float = 0.5
    style: Literal["plain", "dotted"] = "plain"
    colour: Colour | None = None
    file: Path | None = None
    names: Sequence[str] | None = None
    exact: bool = False
    seed: int = 0
    model: Tensor | str | None = None
    noise: Tensor | None = None


def test_types_defaults_choices_and_texts():
    found = {option.name: option for option in options_of(Settings, spaced=("names",))}
    assert set(found) == {f.name for f in fields(Settings)} - {"noise"}  # no tensors
    assert found["width"].default is REQUIRED and found["height"].default == 0.5
    kinds = {name: option.kind for name, option in found.items()}
    assert kinds["height"] is float and kinds["file"] is str and kinds["model"] is str
    assert kinds["colour"] is Colour and found["colour"].choices == ("RED", "BLUE")
    assert found["style"].metavar == "plain|dotted" and found["exact"].metavar == "true|false"
    assert found["names"].spaced and found["names"].text == "of the lines, one each"
    assert found["height"].help == "of the page, metres (default 0.5)"
    assert found["width"].help == "of the page, metres"
    assert found["colour"].help == "of the lines; by default black"
    assert found["exact"].flag == "--exact" and found["exact"].help.endswith("(default false)")


def test_the_placeholder_of_a_list_says_how_it_is_typed():
    def draw(
        lines: list[int] | None = None,
        steps: tuple[float, ...] = (),
        names: Sequence[str] = (),
        files: Sequence[str] = (),
    ) -> None:
        """Draw."""

    options = options_of(draw, spaced=("files",))
    shown = {option.name: option.metavar for option in options}
    expected = {"lines": "[N,...]", "steps": "[X,...]", "names": "[NAMES,...]", "files": "FILES"}
    assert shown == expected


def test_texts_of_a_docstring_that_names_parameters_within_sentences():
    def fit(steps: int, fps: float, actions: str):
        """Fit.

        Args:
            steps: at most; see fps: it tells. fps: frames per second.
            actions: see `choose`.

        Returns:
            fps: nothing.
        """

    assert documented(fit) == {
        "steps": "at most; see fps: it tells", "fps": "frames per second", "actions": "see `choose`",
    }  # fmt: skip

    def choose(actions: str):
        """Choose.

        Args:
            actions: that are kept.
        """

    referring = {o.name: o.text for o in options_of(fit, refers_to=choose)}
    assert referring["actions"] == "that are kept"
    assert documented(lambda: None) == {}


class Shared(TypedDict, total=False):
    sharpness: float


class Base:
    """A filter.

    Args:
        sharpness: of all filters.
    """

    def __init__(self, body: Any, *, sharpness: float = 2.0):
        pass


class Own(Base):
    """A filter of one's own.

    Args:
        wait: frames.
    """

    def __init__(self, body: Any, *, wait: int = 3, **options: Unpack[Shared]):
        super().__init__(body, **options)


def test_options_that_a_class_hands_on_are_documented_by_its_base():
    assert {o.name: o.help for o in options_of(Own)} == {
        "wait": "frames (default 3)", "sharpness": "of all filters (default 2)",
    }  # fmt: skip
    merged = options_of_methods({"own": options_of(Own), "base": options_of(Base)})
    assert {o.name: (o.default, o.help) for o in merged} == {
        "wait": (None, "own: frames (default 3)"),
        "sharpness": (None, "own, base: of all filters (default 2)"),
    }


class Page(NamedTuple):
    """A page.

    Attributes:
        width: of the page. seed: of the noise.
    """

    width: float = 1.0
    seed: int = 0


@pytest.fixture
def drawn():
    """The command `draw`, and its calls."""
    calls = []

    def run(
        paths: list[str], what: str | None = None, *, page: dict, style: Literal["a", "b"] = "a"
    ):
        """Draw paths.

        Args:
            paths: to be drawn. what: is in them. page: of `Page`. style: of the lines.
        """
        calls.append((paths, what, page, style))
        return 0

    groups = {"page": options_of(Page, keys={"width": "page_width"})}
    return Command("draw", run, "draw x", groups, spaced=("paths",)), calls


def test_a_function_is_called_with_its_groups(drawn):
    command, calls = drawn
    assert command.main(["x", "y", "--page-width", "2", "--style", "b"]) == 0
    assert calls == [(["x", "y"], None, {"width": 2.0, "seed": 0}, "b")]
    assert [option.key for option in command.options] == [
        "paths",
        "what",
        "page_width",
        "seed",
        "style",
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["x", "--style", "c"], "--style must be one of a, b, got 'c'"),
        (["x", "--page-width", "wide"], "page_width"),
        (["x", "--width", "1"], "--width"),
        (["x", "--seed", "-1"], "--seed must be a whole number"),
    ],
)
def test_bad_values_are_refused(drawn, line, said):
    command, calls = drawn
    with pytest.raises(Exception, match=said):
        command.main(line)
    assert not calls


# --- the commands ---------------------------------------------------------------------------------


def test_every_command_is_here():
    assert {name.split()[0] for name in COMMAND_OF} == set(COMMANDS) - {"evaluate"}


@pytest.mark.parametrize("name", COMMAND_OF)
def test_every_option_has_a_help_and_the_default_of_its_function(name):
    command = COMMAND_OF[name]()
    defaults = vars(command.parser().get_defaults())
    for option in command.options:
        assert option.help, f"{name} {option.flag} has no help"
        expected = None if option.default is REQUIRED else option.default
        assert defaults[option.key] == expected, option.flag
    text = command.parser().format_help()
    assert "+ [" not in text, "jsonargparse's flag that appends to a list"
    parameters = inspect.signature(command.run).parameters
    assert {"given"} | parameters.keys() >= {o.name for o in command.own} | command.groups.keys()


@pytest.mark.parametrize(
    ("name", "source", "python_only"),
    [
        ("track", TrackSettings, ()),
        ("fit", UpperBodyRecipe, fit.PYTHON_ONLY),
        ("fit manifold", ManifoldRecipe, fit_bodies.PYTHON_ONLY),
        ("fit actions", ActionRecipe, ()),
    ],
)
def test_every_setting_is_an_option(name, source, python_only):
    reached = {o.name for group in COMMAND_OF[name]().groups.values() for o in group}
    plain = {option.name for option in options_of(source)}
    assert plain - reached == set(python_only)


def test_every_option_of_every_method_is_an_option_or_of_python_alone():
    shown = {option.name for option in track.command().options}
    for name in METHODS:
        tensors = {"process_cov", "initial_cov", "dtype", "medians"}
        assert set(method_options(name)) - tensors <= shown | track.PYTHON_ONLY
    shown = {option.name for option in track_body.command().options}
    for name in body_methods.METHODS:
        own = set(body_methods.method_options(name)) - {"limits", "posture_body"}
        assert own <= shown | track_body_options.PYTHON_ONLY
    assert not shown & track_body_options.PYTHON_ONLY


class Damped(WindowMixture):
    """Windows whose covariances grow.

    Args:
        growth: factor on the covariances of the joints.
    """

    def __init__(self, model: Any, *, growth: float = 1.0):
        super().__init__(model)
        self.growth = growth

    def forward(self, *args: Any, **options: Any) -> Any:
        found = super().forward(*args, **options)
        Damped.used = self.growth
        return found


def test_an_option_of_a_registered_method_reaches_it(torchpose, tmp_path):
    register_method("damped", Damped)
    try:
        write_keypoints(tmp_path / "clip.npz", keypoints())
        said = " ".join(torchpose("track", "--help").out.split())
        assert "--growth X damped: factor on the covariances of the joints (default 1)" in said
        line = ("track", tmp_path / "clip.npz", "--out", tmp_path / "out", "--pictures", "false",
                "--prior", "kinect-upper-body-small", "--growth", 2.5)  # fmt: skip
        done = torchpose(*line, "--method", "damped")
        assert done.code == 0, done.err
        assert Damped.used == 2.5
        refused = torchpose(*line, "--method", "window-mixture")
        assert refused.code == 2 and "'growth' does not apply" in refused.err
        assert "it is of damped" in refused.err
    finally:
        del METHODS["damped"]


def test_an_option_of_a_registered_filter_is_an_option(monkeypatch):
    class Slow(body_methods.METHODS["sir"].filter):
        """A filter that waits.

        Args:
            wait: frames before it begins.
        """

        def __init__(self, body, n_particles=10, *, wait: int = 4, **options):
            super().__init__(body, n_particles, **options)

    with monkeypatch.context() as patch:
        patch.setitem(body_methods.METHODS, "slow", body_methods.BodyMethod(Slow))
        command = track_body.command()
    (wait,) = [option for option in command.options if option.name == "wait"]
    assert wait.default is None and wait.help == "slow: frames before it begins (default 4)"
    assert "slow" in command.metavars["method"]
    assert "wait" not in {option.name for option in track_body.command().options}


def test_a_recorded_command_has_what_differs_from_the_defaults():
    line = ["r1", "r2", "--out", "a/p.safetensors", "--components", "7", "--curate", "false",
            "--without", "bob", "carol", "--pictures", "false"]  # fmt: skip
    given = fit.command().given(line)
    assert given.line("p.safetensors") == (
        "torchpose fit r1 r2 --out p.safetensors --components 7 --without bob carol --curate false"
    )


@pytest.mark.parametrize("name", ["track", "track-body", "fit", "demo", "info"])
def test_the_page_names_only_options_that_are_there(name):
    page = (Path(__file__).parents[2] / "docs" / "command-line.md").read_text("utf-8")
    (section,) = re.findall(rf"^## {name}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    said = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", section))
    commands = [build() for key, build in COMMAND_OF.items() if key.split()[0] == name]
    known = {option.flag for command in commands for option in command.options}
    assert said - known <= (
        {"--manifold"} if name == "demo" else set()
    )  # of track-body, in a line there
