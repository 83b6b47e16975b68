"""The suite itself: wrong shapes are caught, and typed errors come through."""

import contextlib
import importlib
import os
import sys

import pytest
import torch
from jaxtyping import TypeCheckError

from tests import shape_checks
from torchpose.camera import _projection as projection
from torchpose.errors import ShapeError
from torchpose.math import _gaussian as gaussian

pytestmark = pytest.mark.skipif(
    os.environ.get("TORCHPOSE_SHAPE_CHECKS") == "0", reason="shape checks are switched off"
)


def test_wrong_shape_is_caught():
    """Mean and covariance disagree about D, which indexing alone would not notice."""
    with pytest.raises(TypeCheckError):
        gaussian.marginal(torch.zeros(3), torch.eye(2), torch.tensor([0]))


def test_wrong_dtype_is_caught():
    with pytest.raises(TypeCheckError):
        gaussian.symmetrise(torch.eye(2, dtype=torch.long))


def test_typed_error_of_the_function_wins():
    eye = torch.eye(3)
    with pytest.raises(ShapeError, match="points"):
        projection.project(torch.zeros(4, 2), eye, eye, torch.zeros(3))


PACKAGE = '''
"""Functions whose shapes disagree on purpose."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor


def head(x: Float[Tensor, "N D"], n: int) -> Float[Tensor, "n D"]:
    return x[0] if n == 0 else x[:n]


def noted(x: Float[Tensor, "N D"], notes: list[str]) -> Any:
    notes.append("called")


def nested(x):
    def inner(x: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        return x[1:] if len(x) == 3 else x

    return inner(x)


@dataclass
class Pair:
    a: Float[Tensor, "N"]
    b: Float[Tensor, "N"]

    @property
    def width(self) -> int:
        return len(self.a) or "none"

    @classmethod
    def of(cls, a: Float[Tensor, "N"]) -> Self:
        return cls(a, a)


def joined(parts: dict[str, Float[Tensor, "N"]], *more: Float[Tensor, "N"], **named: str) -> int:
    return len(parts)


def turned(x: Float[Tensor, "N"], order: Literal["up", "down"]) -> str:
    return order


def called(name: str, parts: list[str]) -> str:
    return name


def summed(pick: Callable[[int], int], sizes: tuple[int, ...], *more: Any, **named: int) -> int:
    return sum(map(pick, sizes)) if callable(pick) else 0


def counted(parts: Sequence[int | None]) -> int:
    return len(parts)


@dataclass
class Kept:
    parts: dict[str, Float[Tensor, "N"]] = field(default_factory=dict)


def halves(x: Float[Tensor, "N"] | None = None, *, n: int = 2) -> tuple[Float[Tensor, "M"], int]:
    y = torch.zeros(2) if x is None else x
    return (y, 1) if len(y) < 4 else (y, 1, 1)
'''


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A package of which every call is checked."""
    folder = tmp_path_factory.mktemp("packages")
    (folder / "shaped_on_purpose").mkdir()
    (folder / "shaped_on_purpose" / "__init__.py").write_text("")
    (folder / "shaped_on_purpose" / "functions.py").write_text(PACKAGE)
    before = list(sys.meta_path)
    shape_checks.install("shaped_on_purpose")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield importlib.import_module("shaped_on_purpose.functions")
    sys.meta_path[:] = before


def test_every_new_combination_of_shapes_is_checked(package):
    x = torch.zeros(3, 2)
    for _ in range(3):
        assert package.head(x, 2).shape == (2, 2)
    with pytest.raises(TypeCheckError, match=r"functions\.head"):
        package.head(x, 0)  # the arguments are as before, the result is not
    with pytest.raises(TypeCheckError):
        package.head(x.long(), 2)
    with pytest.raises(TypeCheckError):
        package.head(x, torch.tensor(2))
    with pytest.raises(TypeCheckError):  # what failed fails again
        package.head(x, 0)
    assert package.head(x, n=1).shape == (1, 2)


def test_arguments_are_checked_whatever_is_returned_and_after_the_call(package):
    notes = []
    package.noted(torch.zeros(2, 2), notes)
    with pytest.raises(TypeCheckError):
        package.noted(torch.zeros(2), notes)
    assert notes == ["called", "called"]


def test_nested_functions_and_methods_are_checked(package):
    for n in (2, 3, 2):
        context = pytest.raises(TypeCheckError) if n == 3 else contextlib.nullcontext()
        with context:
            package.nested(torch.zeros(n))
    assert package.Pair.of(torch.zeros(2)).width == 2
    with pytest.raises(TypeCheckError):
        package.Pair(torch.zeros(2), torch.zeros(3))
    with pytest.raises(TypeCheckError):
        package.Pair.of(torch.zeros(2, 2))
    with pytest.raises(TypeCheckError):
        _ = package.Pair.of(torch.zeros(0)).width


def test_items_of_collections_are_checked(package):
    two, three = torch.zeros(2), torch.zeros(3)
    for _ in range(2):
        assert package.joined({"a": two}, two, two, more="words") == 1
    for bad in (({"a": three}, two), ({"a": two}, two, three), ({"a": two.long()},), ({1: two},)):
        with pytest.raises(TypeCheckError):
            package.joined(*bad)
    with pytest.raises(TypeCheckError):
        package.joined({}, more=two)
    assert package.joined({}, *[two] * 40) == 0
    with pytest.raises(TypeCheckError):
        package.joined({}, *[two] * 39, three)


def test_words_are_told_apart_where_an_annotation_lists_them(package):
    x = torch.zeros(2)
    assert package.turned(x, "up") == "up" and package.turned(x, "down") == "down"
    for bad in ("left", "left"):
        with pytest.raises(TypeCheckError):
            package.turned(x, bad)
    assert package.called("a", ["b"]) == "a" and package.called("c", ["d"]) == "c"
    for bad in ((1, ["b"]), ("a", [1]), (None, ["b"])):
        with pytest.raises(TypeCheckError):
            package.called(*bad)


def test_functions_and_any_number_of_items_are_checked_by_their_types(package):
    def pick(value):
        return 1

    for _ in range(2):
        assert package.summed(pick, (1, 2, 3), "a", object(), n=1) == 3
    assert package.summed(abs, (-4,), torch.zeros(2)) == 4
    for bad in ((pick, ["1"]), (pick, ("1", "2")), (3, (1,))):
        with pytest.raises(TypeCheckError):
            package.summed(*bad, "a", n=1)
    with pytest.raises(TypeCheckError):
        package.summed(pick, (1, 2), n="1")
    for _ in range(2):
        assert package.counted([1, None]) == package.counted((1, None)) == 2
        assert package.counted([None] * 40) == 40
    for bad in (["1", "2"], ("1",), {1, 2}, ["1"] * 40):
        with pytest.raises(TypeCheckError):
            package.counted(bad)


def test_defaults_are_passed_on_and_marks_among_them_are_no_values(package):
    assert package.Kept().parts == {} and package.Kept({"a": torch.zeros(2)}).parts.keys() == {"a"}
    with pytest.raises(TypeCheckError):
        package.Kept({"a": 1})


def test_items_of_results_are_checked_and_what_may_be_none(package):
    for _ in range(2):
        assert package.halves()[1] == package.halves(None, n=2)[1] == 1
        assert len(package.halves(torch.zeros(2))) == 2
    for bad in (torch.zeros(4), torch.zeros(2, 2), torch.zeros(2).long(), "two"):
        with pytest.raises(TypeCheckError):
            package.halves(bad)


def test_a_package_that_was_imported_already_is_refused():
    with pytest.raises(RuntimeError, match="torchpose was imported before"):
        shape_checks.install("torchpose")
