"""Files of tensors: against safetensors' own reader, what comes back, what is refused."""

import json
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from torchpose._core.tensor_file import (
    FileKind,
    info_from_json,
    info_to_json,
    read_tensors,
    require_tensor,
    write_tensors,
)
from torchpose.errors import FileFormatError, InputError, OutputError, PriorError


@dataclass(frozen=True)
class Facts:
    name: str = ""
    fps: float | None = None
    count: int = 0
    mirrored: bool = False
    centres: tuple[tuple[float, ...], ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise PriorError(f"count must not be negative, got {self.count}")


KIND = FileKind(
    "test-means", 3, Facts, older=(2,), tensors={"mean": "E 3", "cov": "E 3 3", "gamma": ""},
    indices={"edges": "E 2"},
)  # fmt: skip
INFO = Facts("walk", 60.0, 4, True, ((0.5, 1.0), (2.0,)), {"list": [1, 2]})


def tensors():
    generator = torch.Generator().manual_seed(0)
    return {
        "mean": torch.randn(4, 3, generator=generator, dtype=torch.float64),
        "cov": torch.randn(3, 3, 4, generator=generator).permute(2, 0, 1),  # not contiguous
        "gamma": torch.tensor(2.0),
        "edges": torch.arange(8).reshape(4, 2),
    }


@pytest.fixture
def path(tmp_path):
    write_tensors(tmp_path / "a.safetensors", KIND, INFO, tensors())
    return tmp_path / "a.safetensors"


def header_of(path):
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["torchpose"])


def rewrite(path, found=None, **header):
    header = header_of(path) | header
    save_file(found or load_file(path), path, metadata={"torchpose": json.dumps(header)})


def test_what_is_written_is_read_by_both_readers(path):
    info, found = read_tensors(path, KIND)
    assert info == INFO
    plain = load_file(path)
    assert found.keys() == plain.keys() == tensors().keys()
    for name, value in tensors().items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value) and torch.equal(plain[name], value)
    assert header_of(path)["format"] == "test-means" and header_of(path)["version"] == 3


def test_same_bytes_again_and_nothing_else_in_the_folder(path):
    before = path.read_bytes()
    write_tensors(path, KIND, INFO, dict(reversed(tensors().items())))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_tensors_that_share_memory_are_written(tmp_path):
    whole, kind = torch.arange(6.0), FileKind("any", 1, Facts)
    write_tensors(tmp_path / "b", kind, Facts(), {"a": whole, "b": whole[:3], "c": whole[::2]})
    _, found = read_tensors(tmp_path / "b", kind)  # a kind without names takes any
    assert torch.equal(found["c"], torch.tensor([0.0, 2.0, 4.0]))


def test_older_versions_are_read(path):
    rewrite(path, version=2)
    assert read_tensors(path, KIND)[0] == INFO


@pytest.mark.parametrize("keep", [0, 4, 100, -20])
def test_truncated_files_are_refused(path, keep):
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(FileFormatError, match=r"a\.safetensors: expected a test means.*truncated"):
        read_tensors(path, KIND)


@pytest.mark.parametrize(
    ("header", "match"),
    [
        ({"format": "other"}, r"expected a test-means, got a file of another kind \(other\)"),
        (
            {"version": 4},
            "expected version 3 of test-means or an older one, got 4; use a torchpose",
        ),
        ({"version": None}, "got None"),
        ({"info": "no"}, "expected the JSON of a Facts"),
        ({"info": "[1]"}, r"expected the JSON of a Facts, got '\[1\]'"),
        ({"info": None}, "expected the JSON of a Facts"),
        (
            {"info": '{"colour": 1}'},
            "unknown field 'colour' in the JSON of a Facts, known are name",
        ),
        ({"info": '{"name": 1}'}, "bad value of name in the JSON of a Facts: 1"),
        ({"info": '{"fps": "fast"}'}, "bad value of fps"),
        ({"info": '{"count": null}'}, "bad value of count"),
        ({"info": '{"centres": 2}'}, "bad value of centres"),
    ],
)
def test_other_headers_are_refused(path, header, match):
    rewrite(path, **header)
    with pytest.raises(FileFormatError, match=match) as caught:
        read_tensors(path, KIND)
    assert str(caught.value).startswith(f"{path}: ")


def test_files_that_torchpose_did_not_write_are_refused(tmp_path):
    path = tmp_path / "b.safetensors"
    with pytest.raises(InputError, match="no such file"):
        read_tensors(path, KIND)
    for metadata in (None, {"torchpose": "[]"}):
        save_file(tensors() | {"cov": torch.zeros(1)}, path, metadata=metadata)
        with pytest.raises(FileFormatError, match="a file of another kind"):
            read_tensors(path, KIND)
    save_file({"a": torch.zeros(1)}, path, metadata={"torchpose": "{"})
    with pytest.raises(FileFormatError, match="of another kind"):
        read_tensors(path, KIND)


def test_facts_that_the_dataclass_refuses_keep_their_error(path):
    rewrite(path, info='{"count": -1}')
    with pytest.raises(PriorError, match=r"a\.safetensors: count must not be negative, got -1"):
        read_tensors(path, KIND)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"mean": None}, "expected the tensors cov, edges, gamma, mean, found cov, edges, gamma"),
        ({"more": torch.zeros(2)}, "expected the tensors .*, found .*more"),
        ({"mean": torch.zeros(4)}, r"expected the sizes \[E, 3\] of mean, got \[4\]"),
        ({"mean": torch.zeros(4, 2)}, r"expected the sizes \[E, 3\] of mean, got \[4, 2\]"),
        ({"mean": torch.zeros(5, 3)}, r"\[E, 3, 3\] of cov, got \[4, 3, 3\] where E = 5"),
        ({"gamma": torch.zeros(1)}, r"expected the sizes \[\] of gamma, got \[1\]"),
        (
            {"mean": torch.zeros(4, 3).long()},
            "expected floating-point numbers in mean, got .*int64",
        ),
        ({"edges": torch.zeros(4, 2)}, "expected whole numbers in edges, got torch.float32"),
        ({"edges": torch.zeros(4, 2) > 0}, "expected whole numbers in edges, got torch.bool"),
    ],
)
def test_other_tensors_are_refused(path, change, match):
    found = {k: v.contiguous() for k, v in (tensors() | change).items() if v is not None}
    rewrite(path, found)
    with pytest.raises(FileFormatError, match=match):
        read_tensors(path, KIND)


def test_failed_writes_keep_the_old_file(path, monkeypatch):
    before = path.read_bytes()
    for bad in (Facts(extra={"a": object()}), Facts(fps=float("nan"))):
        with pytest.raises(PriorError, match="only what JSON can hold"):
            write_tensors(path, KIND, bad, tensors())
    with pytest.raises(OutputError, match="cannot write here"):
        write_tensors(path / "none" / "a", KIND, INFO, tensors())

    def full(*_args: Any, **_options: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchpose._core.tensor_file.save_file", full)
    with pytest.raises(OutputError, match="No space left"):
        write_tensors(path, KIND, INFO, tensors())
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_single_tensor_can_be_asked_for(path):
    found = {"a": torch.ones(2), "b": torch.ones(2).long()}
    assert require_tensor(path, found, "a").dtype == torch.float64
    with pytest.raises(FileFormatError, match="expected a tensor c, found a, b"):
        require_tensor(path, found, "c")
    with pytest.raises(FileFormatError, match=r"floating-point numbers in b, got torch\.int64"):
        require_tensor(path, found, "b")


def test_json_round_trip_of_facts():
    assert info_from_json(Facts, info_to_json(INFO)) == INFO
    assert info_from_json(Facts, '{"fps": 30}') == Facts(fps=30)
