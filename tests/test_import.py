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


def test_modules_load_no_optional_package():
    modules = ("camera", "errors", "filters", "metrics", "priors", "skeleton", "tracking")
    lines = "\n".join(f"torchpose.{name}" for name in modules)
    loaded = loaded_after(f"import torchpose\n{lines}")
    assert {f"torchpose.{name}" for name in modules} <= loaded
    assert not loaded & set(HEAVY)


@pytest.mark.parametrize("name", [*torchpose.__all__, *sorted(torchpose._SUBMODULES)])
def test_every_public_name_resolves(name):
    assert name in dir(torchpose)
    assert getattr(torchpose, name) is not None


def test_version():
    assert torchpose.__version__[0].isdigit()


def test_unknown_name():
    with pytest.raises(AttributeError, match="no_such_name"):
        torchpose.no_such_name  # noqa: B018
