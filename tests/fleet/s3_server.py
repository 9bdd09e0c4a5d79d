"""An s3 store on this machine, by moto, which the environment names; it counts what it sends, and can break off."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server

KEY, SECRET = "AKIATESTKEYOFMOTO123", "t0psecretvalueofmoto"
BUCKET = "robots"


@dataclass
class S3Server:
    """The store."""

    sent: int = 0  #: Bytes of objects that it has sent, counted where they leave it
    asked: int = 0  #: How many requests sent them
    cut_after: int | None = None  #: Each answer with an object breaks off after so many bytes

    def counting(self, app: Any) -> Any:
        """`app` with this counter around it."""

        def counted(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
            is_object = environ["REQUEST_METHOD"] == "GET" and environ["PATH_INFO"].count("/") > 1
            for part in app(environ, start_response):
                part = part[: self.cut_after] if is_object else part
                if is_object:
                    self.sent += len(part)
                    self.asked += 1
                yield part

        return counted


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """The store with an empty bucket; it ends with the block."""
    import s3fs

    server = S3Server()
    app = server.counting(DomainDispatcherApplication(create_backend_app))
    httpd = make_server("127.0.0.1", 0, app, threaded=True, request_handler=_Silent)
    thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    endpoint = f"http://127.0.0.1:{httpd.server_port}"
    names = {"AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_ENDPOINT_URL": endpoint}
    try:
        with patch.dict(os.environ, names):
            forget_stores()
            s3fs.S3FileSystem().mkdir(BUCKET)
            yield server
    finally:
        forget_stores()
        httpd.shutdown()
        thread.join()
        httpd.server_close()


def forget_stores() -> None:
    """Make the next request ask the environment again for the store's address and keys."""
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()


class _Silent(WSGIRequestHandler):
    """Says nothing of requests."""

    def log(self, kind: str, message: str, *arguments: object) -> None:
        """Nothing."""
