"""Servers on this machine: HTTP with ranges, and one like S3; both can drop connections."""

from __future__ import annotations

import base64
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest


class WebServer(ThreadingHTTPServer):
    """Serves ``files`` by their names.

    The next ``drops`` answers to GET are cut off after half of their bytes. ``requests``: method,
    name and range of all requests; ``queries`` are the ends of their addresses.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {}
        self.requests: list[tuple[str, str, str]] = []
        self.drops = 0
        self.has_ranges = True
        self.has_etags = True
        self.queries: list[str] = []
        self.password = ""  # USER:PASSWORD

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, *_: object) -> None:
        """A client that went away needs no message."""


class _Handler(BaseHTTPRequestHandler):
    server: WebServer
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def _answer(self, *, with_body: bool) -> None:
        name = self.path.partition("?")[0].lstrip("/")
        wanted = self.headers.get("Range", "")
        self.server.requests.append((self.command, name, wanted))
        self.server.queries.append(self.path.partition("?")[2])
        content = self.server.files.get(name)
        basic = base64.b64encode(self.server.password.encode()).decode()
        if self.server.password and self.headers.get("Authorization") != f"Basic {basic}":
            self.send_response(401)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        if content is None:
            self.send_response(404)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        body = content
        if wanted and self.server.has_ranges:
            first, _, last = wanted.removeprefix("bytes=").partition("-")
            body = content[int(first) : int(last or len(content) - 1) + 1]
            self.send_response(206)
            end = int(first) + len(body) - 1
            self.send_header("Content-Range", f"bytes {first}-{end}/{len(content)}")
        else:
            self.send_response(200)
        if self.server.has_etags:
            self.send_header("ETag", f'"{hash(content):x}"')
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if not with_body:
            return
        if self.server.drops > 0:
            self.server.drops -= 1
            self.wfile.write(body[: len(body) // 2])
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
            self.close_connection = True
            return
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Quiet."""


@contextmanager
def web_server() -> Iterator[WebServer]:
    """A running WebServer; the test is skipped where the extra http is missing."""
    pytest.importorskip("aiohttp", reason="the extra 'http' is missing")
    server = WebServer()
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class Bucket:
    """A bucket of an S3-like server, ``s3://drives``."""

    def __init__(self, endpoint: str) -> None:
        import boto3

        self.endpoint = endpoint
        self.url = "s3://drives"
        self._client = boto3.client("s3", endpoint_url=endpoint, region_name="us-east-1")
        self._client.create_bucket(Bucket="drives")

    def put(self, name: str, content: bytes | Path) -> str:
        """Store an object; its address."""
        body = content.read_bytes() if isinstance(content, Path) else content
        self._client.put_object(Bucket="drives", Key=name, Body=body)
        return f"{self.url}/{name}"

    def get(self, name: str) -> bytes:
        return bytes(self._client.get_object(Bucket="drives", Key=name)["Body"].read())

    def names(self) -> list[str]:
        entries = self._client.list_objects_v2(Bucket="drives").get("Contents", [])
        return sorted(entry["Key"] for entry in entries)

    def unfinished(self) -> list[str]:
        """Names of uploads that were begun and neither completed nor given up."""
        entries = self._client.list_multipart_uploads(Bucket="drives").get("Uploads", [])
        return [entry["Key"] for entry in entries]


@contextmanager
def s3_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    """A bucket, empty; the test is skipped where the extra s3, or moto, is missing."""
    pytest.importorskip("s3fs", reason="the extra 's3' is missing")
    for module in ("moto", "boto3", "flask", "flask_cors"):
        pytest.importorskip(module, reason=f"{module}, of the extra 'dev', is missing")
    from moto.moto_api._internal.models import moto_api_backend
    from moto.server import ThreadedMotoServer

    from semloc_logs.logs import remote

    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "anyone")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    remote._system.cache_clear()  # it knows an earlier server
    try:
        yield Bucket(f"http://{host}:{port}")
    finally:
        moto_api_backend.reset()  # what it holds is of the process
        server.stop()
        remote._system.cache_clear()
