"""Real processes: killed in the middle of a step, resumed, two of them as torchrun starts them."""

import contextlib
import os
import signal
import socket
import sys
import time

import pytest
import torch

pytest.importorskip("lightning", reason="training needs the extra `train`")
pytest.importorskip("tensorboard", reason="training needs the extra `train`")

from tests.train.forked import ForkedFit
from tests.train.people import settings, write_recordings, write_settings
from tests.train.test_fit import assert_same
from torchpose.priors import load_prior
from train.cli import end_process, main

LOCAL = {"OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1", "GLOO_SOCKET_IFNAME": "lo"}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return write_recordings(tmp_path_factory.mktemp("people"))


def end(process):
    """What it wrote as errors, once it is over."""
    return process.communicate(timeout=300)[1]


GO_ON = "train: {}; go on with --ckpt_path last, which takes up the fit after its last step\n"


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("signum", "code", "what"),
    [(signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "interrupted")],
)
def test_a_signal_has_its_exit_code(recordings, tmp_path, signum, code, what):
    """From outside, after the first step of very many; the same command then goes on."""
    values = settings(recordings, tmp_path, pose_steps=10_000)
    config = write_settings(tmp_path, values)
    # A signal may come while Lightning writes its metrics, whose file nobody closes then.
    process = ForkedFit(["--config", config], tmp_path / "errors", (ResourceWarning,))
    last = tmp_path / "runs" / "checkpoints" / "last.ckpt"
    while process.poll() is None and not last.is_file():
        time.sleep(0.05)
    process.send_signal(signum)
    assert end(process) == GO_ON.format(what)
    assert process.returncode == code
    assert {p.name for p in tmp_path.iterdir()} == {"fit.yaml", "runs", "errors"}
    assert [p.name for p in last.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(("signum", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("when", ["reading", "first step", "calibration"])
def test_a_signal_at_any_time(recordings, tmp_path, monkeypatch, capsys, when, signum, code):
    before = [signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)]
    values = settings(recordings, tmp_path)
    if when == "first step":
        kill = {"step": 0, "signum": int(signum)}
        values["trainer"]["callbacks"] = [
            {"class_path": "tests.train.people.Kill", "init_args": kill}
        ]
    else:
        where = {
            "reading": "train.data.read_recordings",
            "calibration": "torchpose.learning._recipes.UpperBodyRecipe.hold_out",
        }
        monkeypatch.setattr(where[when], lambda *_, **__: os.kill(os.getpid(), signum))
    earlier = tmp_path / "runs" / "checkpoints" / "last.ckpt"  # of another run
    earlier.parent.mkdir(parents=True)
    earlier.write_text("")
    assert main(["fit", "--config", str(write_settings(tmp_path, values))]) == code
    said = capsys.readouterr().err
    if when == "calibration":
        assert said == GO_ON.format("terminated" if code == 143 else "interrupted")
    else:
        assert "run the same command again, as no step was finished" in said
    assert len(said.splitlines()) == 1
    assert {p.name for p in tmp_path.iterdir()} <= {"fit.yaml", "runs"}
    for number, handler in zip((signal.SIGTERM, signal.SIGINT), before, strict=True):
        assert signal.signal(number, handler) in (handler, signal.SIG_IGN)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("command", "signum", "lost"),
    [
        ("fit", signal.SIGTERM, False),
        ("fit", signal.SIGINT, False),
        ("fit", signal.SIGTERM, True),
        ("fit", signal.SIGINT, True),
        ("predict", signal.SIGINT, False),
        ("predict", signal.SIGTERM, True),
    ],
)
def test_a_signal_while_modules_are_loaded(monkeypatch, capsys, command, signum, lost):
    """Some modules catch everything, and the exception is lost."""
    name = {"fit": "train.command", "predict": "train.predict"}[command]

    class Finder:
        @staticmethod
        def find_spec(module, *_):
            if module == name:
                with contextlib.suppress(BaseException if lost else ()):
                    os.kill(os.getpid(), signum)

    monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])
    assert main([command]) == 128 + signum
    what = "terminated" if signum == signal.SIGTERM else "interrupted"
    said = capsys.readouterr().err
    assert said.startswith(f"train: {what}; ") and len(said.splitlines()) == 1
    assert "run the same command again" in said


@pytest.mark.parametrize("grouped", [True, False])
def test_only_a_process_of_several_ends_without_clearing_up(monkeypatch, grouped):
    ended = []
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: grouped)
    monkeypatch.setattr(os, "_exit", ended.append)
    with pytest.raises(SystemExit) as stopped:
        end_process(3)
    assert ended == [3] * grouped
    assert stopped.value.code == 3


def started(arguments, folder, nodes=1):
    """Two processes with what torchrun tells them, on one node or on two; its own start takes seconds.

    `python -m train predict` is tested with torchrun itself.
    """
    port = str(free_port())
    ours = {"MASTER_PORT": port, "WORLD_SIZE": "2", "TORCHELASTIC_RUN_ID": "fit"}
    processes = []
    for rank in range(2):
        node, local = divmod(rank, 2 // nodes)
        own = {
            "RANK": rank,
            "GROUP_RANK": node,
            "LOCAL_RANK": local,
            "LOCAL_WORLD_SIZE": 2 // nodes,
        }
        environment = LOCAL | ours | {name: str(value) for name, value in own.items()}
        errors = folder / f"errors{rank}"
        processes.append(ForkedFit(arguments, errors, environment=environment))
    return processes


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.skipif(sys.platform != "linux", reason="SIGKILL, and the loopback's name, are Linux's")
def test_killed_and_resumed_on_one_and_two_processes(recordings, tmp_path):
    """One process dies in its third step, one of two nodes in the fifth; two of one node finish."""
    values = settings(recordings, tmp_path / "one")
    assert main(["fit", "--config", str(write_settings(tmp_path / "one", values))]) == 0
    wanted = load_prior(tmp_path / "one" / "p.safetensors")

    values = settings(recordings, tmp_path)
    out, last = tmp_path / "p.safetensors", tmp_path / "runs" / "checkpoints" / "last.ckpt"
    pictures = {"every": 5, "at_end": True, "n_shown": 1}  # at a step, and after the last one
    config = write_settings(tmp_path / "final", values | {"pictures": pictures})
    kill = {"class_path": "tests.train.people.Kill", "init_args": {"step": 2}}
    values["trainer"]["callbacks"] = [kill]
    dying = write_settings(tmp_path / "dying", values)
    killed = ForkedFit(["--config", dying, "--ckpt_path", "auto"], tmp_path / "errors")
    assert end(killed) == "" and killed.returncode == -signal.SIGKILL
    assert last.is_file() and not out.exists()

    kill["init_args"] = {"step": 4, "rank": 1}
    write_settings(tmp_path / "dying", values)
    left, lost = started(["--config", dying, "--ckpt_path", "last"], tmp_path, nodes=2)
    message = end(left)
    assert left.returncode > 0, message
    assert end(lost) == "" and lost.returncode == -signal.SIGKILL
    assert not out.exists()

    for process in started(["--config", config, "--ckpt_path", "last"], tmp_path):
        said = end(process)
        assert process.returncode == 0, said
    prior = load_prior(out)
    assert_same(prior, wanted, 1e-8)
    assert prior.info.persons == wanted.info.persons
    logs = sorted(p.name for p in (tmp_path / "runs").iterdir())
    assert logs == ["checkpoints", "version_0", "version_1", "version_2"]
    assert (tmp_path / "runs" / "version_2" / "pictures" / "likelihood.png").is_file()
