"""`import torchpose` is light, and its namespace is what it says."""

import subprocess
import sys

import pytest

import torchpose

HEAVY = ("cv2", "lightning", "matplotlib", "pytorch_lightning", "scipy", "sklearn", "torchmetrics")

NO_NETWORK = """
import socket
def refuse(*args, **kwargs):
    raise RuntimeError("a connection was opened")
socket.socket.connect = socket.create_connection = refuse
"""


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", NO_NETWORK + code], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_after(code: str) -> set[str]:
    return set(run(code + "\nimport sys\nprint(*sys.modules)").split())


def test_import_loads_nothing_heavy():
    loaded = loaded_after("import torchpose")
    assert not loaded & {*HEAVY, "torch", "numpy"}


ROOMS = tuple(
    f"torchpose.{name}"
    for name in ("camera", "errors", "filters", "metrics", "priors", "skeleton", "upper_body")
)
FILTERS = """
import torch
from torchpose.filters import BootstrapParticleFilter, MixtureKalmanFilter
from torchpose.math._gaussian import kalman_update
from torchpose.priors import GaussianMixture
gmm = GaussianMixture(torch.full((2,), 0.5), torch.eye(2), torch.eye(2).repeat(2, 1, 1))
z, mask = torch.zeros(2, 3, 2), torch.ones(2, 3, 2, dtype=torch.bool)
mask[0, 1, 0] = False
noise = torch.eye(2).repeat(2, 3, 1, 1)
for tracks in ("fixed", "sampled", "split"):
    model = MixtureKalmanFilter(gmm, torch.ones(2), torch.ones(2), [0, 1], tracks)
    model(z, mask), model(z, mask, noise)
eye, zeros = torch.eye(2), torch.zeros(4, 3, 2)
kalman_update(zeros, eye.repeat(3, 1, 1), zeros, eye, torch.tensor([0, 1]))  # shared covariances
BootstrapParticleFilter(gmm, torch.ones(2), torch.ones(2), [0, 1], n_particles=9)(z, mask)
"""


@pytest.fixture(scope="module")
def loaded():
    """What is loaded after most rooms were, and filters have run."""
    return loaded_after("import torchpose\n" + "\n".join(ROOMS) + FILTERS)


def test_modules_load_no_optional_package(loaded):
    assert set(ROOMS) <= loaded
    assert not loaded & set(HEAVY)


def test_no_filter_loads_a_computer_algebra_system_on_its_way(loaded):
    """torch.broadcast_shapes does, which takes a second in the middle of a track."""
    assert "sympy" not in loaded


@pytest.mark.parametrize("name", [*torchpose.__all__, *sorted(torchpose._PACKAGES)])
def test_every_public_name_resolves(name):
    assert name in dir(torchpose)
    assert getattr(torchpose, name) is not None


def test_version():
    assert torchpose.__version__[0].isdigit()


def test_unknown_name():
    with pytest.raises(AttributeError, match="no_such_name"):
        torchpose.no_such_name  # noqa: B018
