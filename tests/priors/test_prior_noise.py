"""Numbers that a prior or a model cannot have, wherever they come from."""

import json
import struct

import numpy as np
import pytest
import torch

from tests.fuzz.samples import SAMPLES, prior
from torchpose.errors import (
    CovarianceError,
    FileFormatError,
    InputError,
    PriorError,
    TorchposeError,
)
from torchpose.priors import (
    ActionBank,
    ActionSpace,
    BackConstrainedGPLVM,
    UpperBodyPrior,
    load_prior,
)
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.priors._prior_file import check_noise

KINDS = {
    "prior": UpperBodyPrior, "manifold": BackConstrainedGPLVM, "limbs": LimbConditionals,
    "space": ActionSpace, "bank": ActionBank,
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file of each kind."""
    folder = tmp_path_factory.mktemp("models")
    made = SAMPLES["models"] | SAMPLES["prior"]
    for make in made.values():
        make(folder)
    return folder


def taken_apart(data):
    """The header of a safetensors file as JSON, and its numbers."""
    size = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])


def put_together(header, numbers):
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + bytes(numbers)


def changed_tensor(data, name, value):
    """The file with the first number of a tensor replaced."""
    header, numbers = taken_apart(data)
    kind = {"F64": "<d", "F32": "<f"}[header[name]["dtype"]]
    start = header[name]["data_offsets"][0]
    numbers[start : start + struct.calcsize(kind)] = struct.pack(kind, value)
    return put_together(header, numbers)


def changed_fact(data, key, text):
    """The file with a fact replaced by a text of JSON."""
    header, numbers = taken_apart(data)
    facts = json.loads(header["__metadata__"]["torchpose"])
    info = json.loads(facts["info"])
    info[key] = "@"
    facts["info"] = json.dumps(info).replace('"@"', text)
    header["__metadata__"]["torchpose"] = json.dumps(facts)
    return put_together(header, numbers)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_no_tensor_of_a_file_holds_what_is_no_number(files, tmp_path, kind, value):
    data = (files / f"{kind}.safetensors").read_bytes()
    names = [n for n, facts in taken_apart(data)[0].items()
             if n != "__metadata__" and facts["dtype"][0] == "F"]  # fmt: skip
    path = tmp_path / "a.safetensors"
    unknown = ("std_latent", "std_pose", "std_step")  # NaN until they are fitted
    for name in [n for n in names if n not in unknown or value == value]:
        path.write_bytes(changed_tensor(data, name, value))
        with pytest.raises(TorchposeError, match=r"a\.safetensors"):
            KINDS[kind].load(path)


@pytest.mark.parametrize(
    ("kind", "name"),
    [("space", "std"), ("space", "match_std"), ("bank", "residual_std"), ("bank", "background_std"),
     ("manifold", "scale"), ("manifold", "gamma_x"), ("limbs", "covariance"), ("limbs", "diffusion"),
     ("prior", "left.covariances"), ("prior", "noise.process_cov_left")],
)  # fmt: skip
def test_deviations_and_covariances_are_positive(files, tmp_path, kind, name):
    path = tmp_path / "a.safetensors"
    data = (files / f"{kind}.safetensors").read_bytes()
    path.write_bytes(changed_tensor(data, name, -1.0))
    with pytest.raises(TorchposeError, match=r"a\.safetensors.*(positive|symmetric|negative)"):
        KINDS[kind].load(path)


FACTS = {
    "persons": ("[1]", "null", '"p"', "[[]]"), "name": ("1", "true", "[" * 5000 + "]" * 5000),
    "fps": ("true", "NaN", "Infinity", "1e999", "-1", "0", "1e9", "9" * 400, "9" * 5000, '"30"'),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("key", FACTS)
def test_facts_of_another_type(files, tmp_path, kind, key):
    if kind == "bank" and key == "name":
        key = "licence"
    path = tmp_path / "a.safetensors"
    data = (files / f"{kind}.safetensors").read_bytes()
    for text in FACTS.get(key, FACTS["name"]):
        path.write_bytes(changed_fact(data, key, text))
        with pytest.raises(TorchposeError, match=r"a\.safetensors") as caught:
            KINDS[kind].load(path)
        assert str(caught.value).isprintable() and len(str(caught.value)) <= 1200


def test_focal_lengths_that_are_true(files, tmp_path):
    data = (files / "prior.safetensors").read_bytes()
    path = tmp_path / "a.safetensors"
    for text in ("true", "1e300", "0", "NaN"):
        path.write_bytes(changed_fact(data, "fx", text))
        with pytest.raises(TorchposeError, match=r"a\.safetensors"):
            UpperBodyPrior.load(path)


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("calibration_scale_pose", -torch.ones(8), InputError),
        ("calibration_scale_pose", torch.zeros(8), InputError),
        ("calibration_scale_pose", torch.ones(7), InputError),
        ("calibration_floor_full", -torch.ones(8), InputError),
        ("process_cov", -torch.ones(21), InputError),
        ("process_cov_left", torch.ones(21, 21, 1), InputError),
        ("process_cov_left", -torch.eye(21), CovarianceError),
        ("measurement_std", torch.zeros(5), InputError),
        ("uniform_weight", torch.tensor(-1.0), InputError),
    ],
)
def test_noise_that_trackers_cannot_use(name, value, error):
    with pytest.raises(error, match=name):
        check_noise(name, value)
    with pytest.raises(error, match=name):
        prior().set_noise(name, value)


def test_noise_that_nobody_knows_may_be_anything():
    check_noise("mine", torch.tensor([-1.0]))


@pytest.mark.parametrize("name", [None, 3, np.zeros(3)])
def test_what_is_no_name_of_a_prior(name):
    with pytest.raises(PriorError, match="expected the name of a prior"):
        load_prior(name)
    with pytest.raises(PriorError, match="neither"):
        load_prior("n" * 5000)


def test_shipped_priors_are_taken(files):
    for name in ("kinect-upper-body", "kinect-upper-body-small"):
        load_prior(name)
    for kind, cls in KINDS.items():
        cls.load(files / f"{kind}.safetensors")
    with pytest.raises(FileFormatError):
        ActionBank.load(files / "space.safetensors")
