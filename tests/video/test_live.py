"""The live view as a browser sees it: over HTTP, with urllib and plain sockets."""

import http.client
import io
import os
import socket
import sys
import threading
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from torchpose.errors import InputError, OutputError
from torchpose.video._live_view import LiveView

PATIENCE = 5.0


def picture(red: int) -> np.ndarray:
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    image[..., 0] = red
    return image


def get(url: str) -> http.client.HTTPResponse:
    return urllib.request.urlopen(url, timeout=PATIENCE)


def read_picture(stream: io.BufferedIOBase) -> np.ndarray:
    """One part of the stream, as RGB."""
    assert stream.readline().startswith(b"--")
    length = 0
    while line := stream.readline().strip():
        name, value = line.split(b": ")
        if name == b"Content-Length":
            length = int(value)
    data = np.frombuffer(stream.read(length), dtype=np.uint8)
    assert stream.read(2) == b"\r\n"
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]


def test_the_page_shows_the_stream_and_needs_no_network():
    with LiveView() as view:
        page = get(view.url).read().decode()
    assert 'src="stream"' in page and "<button" in page
    assert "//" not in page.replace("<!DOCTYPE html>", "")


def test_the_newest_picture_arrives_in_rgb():
    with LiveView() as view:
        view.show(picture(100))
        view.show(picture(200))
        with get(view.url + "stream") as stream:
            assert stream.headers["Content-Type"].startswith("multipart/x-mixed-replace")
            first = read_picture(stream)
            assert first.shape == (48, 64, 3)
            assert np.abs(first.mean((0, 1)) - [200, 0, 0]).max() < 4
            view.show(picture(50))
            assert abs(read_picture(stream)[..., 0].mean() - 50) < 4


def test_the_picture_is_that_of_the_moment_of_show():
    with LiveView() as view:
        image = picture(200)
        view.show(image)
        image[:] = 0
        with get(view.url + "stream") as stream:
            assert read_picture(stream)[..., 0].mean() > 190


def test_a_browser_that_comes_before_the_first_picture_waits():
    with LiveView() as view:
        timer = threading.Timer(0.2, view.show, [picture(90)])
        timer.start()
        with get(view.url + "stream") as stream:
            assert abs(read_picture(stream)[..., 0].mean() - 90) < 4
        timer.join()


def test_the_button_requests_a_stop():
    with LiveView() as view:
        assert not view.stop_requested
        request = urllib.request.Request(view.url + "stop", method="POST")
        assert urllib.request.urlopen(request, timeout=PATIENCE).status == 200
        assert view.stop_requested and view.stop_requested
        view.show(picture(1))  # goes on until the block ends


def test_looking_does_not_stop_and_unknown_pages_are_not_found():
    with LiveView() as view:
        for path in ("stop", "etc/passwd"):
            with pytest.raises(urllib.error.HTTPError) as caught:
                get(view.url + path)
            assert caught.value.code == 404
            caught.value.close()
        assert not view.stop_requested


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
def test_pages_of_other_sites_are_refused(headers):
    with LiveView() as view:
        view.show(picture(1))
        for path, method in (("stop", "POST"), ("stream", "GET"), ("", "GET")):
            request = urllib.request.Request(view.url + path, headers=headers, method=method)
            with pytest.raises(urllib.error.HTTPError) as caught:
                urllib.request.urlopen(request, timeout=PATIENCE)
            assert caught.value.code == 403
            caught.value.close()
        assert not view.stop_requested


def test_it_listens_on_this_machine_only():
    with LiveView() as view:
        assert view.url.startswith("http://127.0.0.1:")
        port = int(view.url.rstrip("/").rsplit(":", 1)[1])
        # the same port of another address of this machine is free
        with socket.socket() as other:
            other.bind(("127.0.0.2", port))


def test_nothing_is_left_running_and_the_port_is_free_again():
    before = threading.active_count()
    with LiveView() as view:
        port = int(view.url.rstrip("/").rsplit(":", 1)[1])
        view.show(picture(1))
        stream = get(view.url + "stream")
        read_picture(stream)
    assert stream.read().endswith(b"--\r\n")  # told that it is over, not cut off
    stream.close()
    deadline = time.monotonic() + PATIENCE
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.02)
    assert threading.active_count() == before
    with LiveView(port=port) as again:
        assert again.url.endswith(f":{port}/")


def test_a_browser_that_hangs_delays_nobody():
    with LiveView() as view:
        port = int(view.url.rstrip("/").rsplit(":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)) as lazy:
            lazy.sendall(f"GET /stream HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
            large = np.random.default_rng(0).integers(0, 255, (600, 800, 3)).astype(np.uint8)
            start = time.perf_counter()
            for _ in range(50):
                view.show(large)
            assert time.perf_counter() - start < 2
            start = time.perf_counter()
    assert time.perf_counter() - start < 2


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals of this kind here")
def test_q_in_a_terminal_requests_a_stop(monkeypatch):
    ours, theirs = os.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: os.getpgrp())
    with open(theirs, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with LiveView() as view:
            os.write(ours, b"x")
            time.sleep(0.05)
            assert not view.stop_requested
            os.write(ours, b"q")  # without Enter
            deadline = time.monotonic() + PATIENCE
            while not view.stop_requested and time.monotonic() < deadline:
                time.sleep(0.01)
            assert view.stop_requested
        import termios

        assert termios.tcgetattr(theirs)[3] & termios.ICANON  # the terminal is as it was
    os.close(ours)


@pytest.mark.parametrize("stdin", [None, io.StringIO("q\n")])
def test_without_a_terminal_nothing_is_read(monkeypatch, stdin):
    monkeypatch.setattr(sys, "stdin", stdin)
    with LiveView() as view:
        assert not view.stop_requested
    assert stdin is None or stdin.read() == "q\n"


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="port"):
        LiveView(port=70000)
    with pytest.raises(InputError, match="quality"):
        LiveView(quality=0)
    with LiveView() as view, pytest.raises(InputError, match="RGB"):
        view.show(np.zeros((4, 4), dtype=np.uint8))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(OutputError, match="port"), LiveView(port=taken.getsockname()[1]):
            pass
