"""`torchpose evaluate`: a stand-in protocol gets its options, and the real ones have parsers."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from torchpose.cli import _evaluate as evaluate
from torchpose.errors import OverlapError


@pytest.fixture
def calls(monkeypatch):
    """Calls of a protocol that stands in for learning-curve."""
    made = []

    def run(
        data: Path,
        out: Path,
        *,
        seed: int = 0,
        progress: bool = True,
        quick: bool = False,
        n_views: int | None = None,
        methods: tuple[str, ...] = ("a",),
        recipe: object = None,
        prior: object = None,
    ):
        """Score it.

        Args:
            data: folder. out: folder.
            quick: few sequences. n_views: how many
                viewpoints.
        """
        if seed == 13:
            raise OverlapError("the prior was fitted on p1")
        made.append({k: v for k, v in locals().items() if k != "made"})
        return SimpleNamespace(summary=lambda: "error 5.0 cm")

    module = ModuleType("torchpose.evaluation._learning_curve")
    module.run = run
    monkeypatch.setitem(sys.modules, "torchpose.evaluation._learning_curve", module)
    return made


def test_options_reach_the_protocol(torchpose, calls, tmp_path):
    line = ("--data", tmp_path, "--out", tmp_path / "out", "--seed", 4)
    done = torchpose("evaluate", "learning-curve", *line, "--quick", "true", "--n-views", 3)
    assert done.code == 0, done.err
    assert done.out == "error 5.0 cm\n"
    (call,) = calls
    assert call["data"] == [tmp_path] and call["out"] == tmp_path / "out"
    assert (call["seed"], call["quick"], call["n_views"], call["prior"]) == (4, True, 3, None)
    assert call["methods"] == ("a",) and call["recipe"] is None
    done = torchpose("evaluate", *line, "learning-curve", "--methods", '["b", "c"]')
    assert done.code == 0, done.err
    assert tuple(calls[-1]["methods"]) == ("b", "c")
    for given in (["b"], ["b,c"], ["b", "c"]):
        done = torchpose("evaluate", "learning-curve", tmp_path, "--methods", *given, *line[2:])
        assert done.code == 0, done.err
        assert ",".join(calls[-1]["methods"]) == ",".join(given)


def test_help_comes_from_the_docstring(torchpose, calls):
    text = " ".join(torchpose("evaluate", "learning-curve", "--help").out.split())
    assert "--quick true|false few sequences" in text
    assert "--n-views N how many viewpoints" in text
    assert "--recipe" not in text


def test_prior_is_loaded(torchpose, calls, tmp_path, files):
    line = ("--data", tmp_path, "--out", tmp_path / "out", "--prior", files / "prior.safetensors")
    assert torchpose("evaluate", "learning-curve", *line).code == 0
    assert calls[0]["prior"].info.name == "tiny"


def test_config_file_round_trip(torchpose, calls, tmp_path):
    line = ("--data", tmp_path, "--out", tmp_path / "out", "--n-views", 7)
    printed = torchpose("evaluate", "learning-curve", *line, "--print_config")
    (tmp_path / "e.yaml").write_text(printed.out)
    assert torchpose("evaluate", "learning-curve", "--config", tmp_path / "e.yaml").code == 0
    assert calls[0]["n_views"] == 7


def test_refusals(torchpose, calls, tmp_path):
    data, out = ("--data", tmp_path), ("--out", tmp_path / "out")
    (tmp_path / "file").write_text("")
    for arguments, message in (
        ((), "the protocol is missing; known are score, leave-one-person-out"),
        (("ub-two", *data, *out), "unknown protocol 'ub-two'"),
        (("learning-curve", *data), "missing: --out"),
        (("learning-curve", "--data", tmp_path / "none", *out), "no such folder"),
        (("learning-curve", *data, "--out", tmp_path / "file" / "x"), "cannot be written"),
        (("learning-curve", *data, *out, "--n-views", "many"), "argument --n-views"),
        (("learning-curve", *data, *out, "--prior", "nobody"), "name of a prior"),
        (("learning-curve", *data, *out, "--seed", 13), "was fitted on p1"),
    ):
        done = torchpose("evaluate", *arguments)
        assert done.code == 2 and message in done.err, done
        assert len(done.err.splitlines()) == 1
    assert not calls


@pytest.mark.parametrize("name", evaluate.PROTOCOLS)
def test_parsers_of_the_real_ones(name):
    args = evaluate.build(name, evaluate.PROTOCOLS[name]).parse_args(
        ["--data", "d", "--out", "o", "--seed", "1"]
    )
    assert (args.data, args.out, args.seed) == ("d", "o", 1)


def test_the_help_of_lists_shows_what_is_taken():
    parser = evaluate.build("learning-curve", evaluate.PROTOCOLS["learning-curve"])
    text = parser.format_help()
    assert "--counts [N,...]" in text and "--more [DIR,...]" in text
    assert "torchpose.learning._" not in text
    args = parser.parse_args(["d", "--out", "o", "--counts", "[1,2]", "--more", "[a/,b/]"])
    assert list(args.counts) == [1, 2] and list(args.more) == ["a/", "b/"]
