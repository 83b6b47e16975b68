"""Show a live view in the browser: pictures over HTTP on this machine, with a stop button."""

import contextlib
import functools
import http.server
import os
import select
import sys
import threading
from collections.abc import Iterator
from typing import Any, Self

from torchpose._core.checks import check_rgb
from torchpose._core.images import Image
from torchpose.errors import InputError, OutputError

_HOST = "127.0.0.1"  # this machine only, since it shows a camera
_BOUNDARY = "torchpose-frame"
_PATIENCE = 1.0  # seconds after which a waiting browser gets the last picture again

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>torchpose live</title>
<style>
body { margin: 0; padding: 16px; font: 15px/1.5 system-ui, sans-serif; text-align: center; }
img { display: block; margin: 0 auto 12px; max-width: 100%; max-height: 82vh; border-radius: 8px; }
button { padding: 8px 28px; font: inherit; cursor: pointer; }
</style>
</head>
<body>
<img src="stream" alt="What the tracker sees, live">
<button type="button" id="stop">Stop (q)</button>
<p id="state">Live. What was tracked is written when you stop.</p>
<script>
"use strict";
const stop = () => fetch("stop", { method: "POST" }).then(() => {
  document.getElementById("stop").disabled = true;
  document.getElementById("state").textContent = "Stopped; the results are being written.";
});
document.getElementById("stop").addEventListener("click", stop);
document.addEventListener("keydown", (event) => { if (event.key === "q") stop(); });
</script>
</body>
</html>
"""


class LiveView:
    """Shows pictures in a browser as they are made, and reports a request to stop.

    A server on 127.0.0.1 runs in threads of its own until the end of the block: a page at `url` with the
    stream (MJPEG) and a stop button. Only the newest picture is kept, so that a slow browser delays
    nothing. Pictures are compressed only while a browser is connected. In a terminal the key q requests
    a stop as well (not under Windows).

    Args:
        port: the port of the server; 0 takes any that is free.
        quality: the quality of the JPEG pictures, 1 to 100.

    Attributes:
        url: the address of the page, while the block lasts.

    Raises:
        InputError: a port or quality that is out of range. OutputError: the port is taken.

    >>> import numpy as np
    >>> with LiveView() as view:
    ...     view.show(np.zeros((48, 64, 3), dtype=np.uint8))
    ...     view.stop_requested
    False
    """

    def __init__(self, port: int = 0, quality: int = 80) -> None:
        if not 0 <= port <= 65535:
            raise InputError(f"port must be in 0 to 65535, got {port}")
        if not 1 <= quality <= 100:
            raise InputError(f"quality must be in 1 to 100, got {quality}")
        self.port, self.quality = port, quality
        self.url = ""
        self._news = threading.Condition()
        self._image: Image | None = None
        self._jpeg = b""
        self._number = 0  # of the newest picture, 0 before the first
        self._compressed = 0  # number of the picture in _jpeg
        self._compressing = threading.Lock()
        self._keys = _Keys()
        self._stop = threading.Event()
        self._closed = False
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        try:
            self._server = _Server((_HOST, self.port), self)
        except OSError as error:
            raise OutputError(
                f"port {self.port}: no live view here ({error.strerror or error}); take another "
                "port, or 0 for any that is free"
            ) from error
        self.url = f"http://{_HOST}:{self._server.server_port}/"
        self._closed = False
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        self._thread.start()
        self._keys.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._keys.close()
        with self._news:
            self._closed = True
            self._news.notify_all()
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._thread.join()
            self._server.server_close()
        self._server = self._thread = None

    @property
    def stop_requested(self) -> bool:
        """Return whether the button or the key q was pressed."""
        if not self._stop.is_set() and self._keys.pressed_q():
            self._stop.set()
        return self._stop.is_set()

    def show(self, image: Image) -> None:
        """Make an RGB picture [H, W, 3], uint8, the newest one, without waiting.

        Raises:
            InputError: another kind of picture.
        """
        check_rgb("image", image, empty=False)
        with self._news:
            self._image = image.copy()  # the caller may draw into the same memory again
            self._number += 1
            self._news.notify_all()

    def _pictures(self) -> Iterator[bytes]:
        """Yield JPEG files: each new picture once, the last one again after a while without a new one."""
        last = 0
        while True:
            with self._news:
                self._news.wait_for(functools.partial(self._has_news, last), _PATIENCE)
                if self._closed:
                    return
                if self._image is None:
                    continue
                image, last = self._image, self._number
            yield self._compress(image, last)

    def _has_news(self, last: int) -> bool:
        return self._closed or self._number > last

    def _compress(self, image: Image, number: int) -> bytes:
        """Return a picture as JPEG, compressed once for all browsers, and outside of the lock of `show`."""
        with self._compressing:
            if self._compressed != number:
                self._jpeg, self._compressed = _to_jpeg(image, self.quality), number
            return self._jpeg


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # a browser that hangs must not delay the results

    def __init__(self, address: tuple[str, int], view: LiveView) -> None:
        self.view = view
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that disconnect."""


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server
    timeout = 10.0  # of a browser that neither reads nor leaves

    def do_GET(self) -> None:
        if not self._is_local():
            return
        if self.path == "/":
            self._answer(200, _PAGE.encode(), "text/html; charset=utf-8")
        elif self.path == "/stream":
            with contextlib.suppress(OSError):  # closed by the browser
                self._stream()
        else:
            self._answer(404, b"not found\n")

    def do_POST(self) -> None:
        if not self._is_local():
            return
        if self.path == "/stop":
            self.server.view._stop.set()
            self._answer(200, b"stopping\n")
        else:
            self._answer(404, b"not found\n")

    def _is_local(self) -> bool:
        """Return whether a page of this server made the request; answer others with an error."""
        own = f"{_HOST}:{self.server.server_port}"
        named = f"localhost:{self.server.server_port}"
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        site = self.headers.get("Sec-Fetch-Site", "none")
        if (
            host in (own, named)
            and origin in (None, f"http://{own}", f"http://{named}")
            and site in ("none", "same-origin")
        ):
            return True
        self._answer(403, b"this server answers to pages of its own only\n")
        return False

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        for jpeg in self.server.view._pictures():
            head = (
                f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            )
            self.wfile.write(head.encode() + jpeg + b"\r\n")
        self.wfile.write(f"--{_BOUNDARY}--\r\n".encode())

    def _answer(self, status: int, body: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing for a request."""


def _to_jpeg(image: Image, quality: int) -> bytes:
    import cv2

    done, buffer = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise InputError(f"a picture of {list(image.shape)} cannot be compressed as JPEG")
    return buffer.tobytes()


class _Keys:
    """Reads single keys of the terminal without waiting; none where there is no terminal.

    Ctrl-C keeps its meaning, and the settings of the terminal are restored.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._settings: list[Any] | None = None

    def open(self) -> None:
        try:
            import termios
            import tty

            descriptor = sys.stdin.fileno()
            # a background job is halted when it changes the terminal
            if not os.isatty(descriptor) or os.tcgetpgrp(descriptor) != os.getpgrp():
                return
            with contextlib.suppress(termios.error):
                self._settings = termios.tcgetattr(descriptor)
                tty.setcbreak(descriptor)
                self._descriptor = descriptor
        except (ImportError, OSError, ValueError, AttributeError):
            return  # another system, or no terminal

    def pressed_q(self) -> bool:
        if self._descriptor is None:
            return False
        try:
            if os.tcgetpgrp(self._descriptor) != os.getpgrp():
                return False
            ready, _, _ = select.select([self._descriptor], [], [], 0)
            return bool(ready) and b"q" in os.read(self._descriptor, 256).lower()
        except (OSError, ValueError):  # the terminal is gone
            return False

    def close(self) -> None:
        if self._descriptor is None or self._settings is None:
            return
        import termios

        with contextlib.suppress(OSError, termios.error):
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._settings)
        self._descriptor = self._settings = None
