"""Logs on servers: s3://, gs:// and https:// addresses as paths, read in ranges, never copied to
disk.

The network is used only for such addresses. A connection that drops is tried again a few times;
then a RemoteError ends the work: what could not be read is not damage of the log.
"""

from __future__ import annotations

import errno
import importlib
import io
import os
import re
import stat
import time
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path, PosixPath
from typing import IO, Any, BinaryIO, TypeVar, cast
from urllib.parse import quote, urlsplit

from semloc_logs.errors import RemoteError

EXTRAS = {"s3": "s3", "gs": "gs", "http": "http", "https": "http"}  # the extra of a scheme
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
_IN_URLS = "%/:?#[]@!$&'()*+,;=~"  # characters that need no quoting, or are quotes
TRIES = 5
_PAUSE_S = 0.25  # before the second try; twice as long before each further one
_SILENCE_S = 60.0  # a server that sends nothing for so long is tried again
BLOCK = 1 << 20  # bytes; a file is read in multiples of them
_AHEAD = 4  # blocks read at once where reading goes straight on
_KEPT = 32  # blocks of a file in memory
_HELD = 64 << 20  # bytes at the end of a file being written that can still change
_HEAD = 1 << 20  # bytes at its start that can be read again
_PART = 16 << 20  # bytes sent at once

Answer = TypeVar("Answer")


def log_path(text: str | Path) -> Path:
    """``text`` as a path; an address as a RemotePath, RemoteError where it is of no known kind."""
    if isinstance(text, Path):
        return text
    scheme = _SCHEME.match(text)
    if scheme is None or Path(text).exists():
        return Path(text)
    if scheme[1].lower() not in EXTRAS:
        raise RemoteError(
            f"{text} cannot be read: logs are files, or addresses with {', '.join(EXTRAS)}."
        )
    return RemotePath.of_url(text)


def is_remote(path: Path) -> bool:
    """Whether ``path`` is an address on a server."""
    return isinstance(path, RemotePath)


class RemotePath(PosixPath):
    """An address. Shown without what may be secret in it: user, password and query."""

    url: str

    @classmethod
    def of_url(cls, url: str) -> RemotePath:
        """The path of an address; RemoteError where it names no file or folder."""
        scheme, _, rest = url.partition("://")
        scheme = scheme.lower()
        is_web = EXTRAS[scheme] == "http"
        host, _, names = rest.partition("/")
        if is_web:  # keys of other servers may have any letters
            parts = urlsplit(url)
            url = quote(url, _IN_URLS)  # apart from that it is sent as it is
            host, names = parts.netloc.rpartition("@")[2], parts.path
        names = names.strip("/") if is_web else names.rstrip("/")
        if not host or "//" in f"/{names}":
            raise RemoteError(
                f"{scheme}://{host}/{names} is not the address of a log: it has the form"
                f" {scheme}://{'HOST' if is_web else 'BUCKET'}/PATH."
            )
        path = cls(f"{scheme}:", host, *names.split("/"))
        path.url = f"{scheme}{url[len(scheme) :].rstrip('/')}"
        return path

    def _address(self) -> str:
        """The URL; of a path made from another one, without the user and the query of that."""
        return getattr(self, "url", None) or str(self)

    def __str__(self) -> str:
        scheme, *rest = self.parts
        return f"{scheme}//{'/'.join(rest)}"

    def __fspath__(self) -> str:
        return str(self)

    def __repr__(self) -> str:
        return f"RemotePath({str(self)!r})"

    def __reduce__(self) -> Any:
        return log_path, (self._address(),)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RemotePath) and self._address() == other._address()

    def __hash__(self) -> int:
        return hash(self._address())

    @property
    def scheme(self) -> str:
        return self.parts[0].removesuffix(":")

    def absolute(self) -> RemotePath:
        return self

    def resolve(self, strict: bool = False) -> RemotePath:
        return self

    def is_absolute(self) -> bool:
        return True

    def samefile(self, other_path: Any) -> bool:
        return bool(self == other_path)

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        return self.is_file() or self.is_dir()

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        with suppress(FileNotFoundError):
            return bool(self.info()["type"] == "file") and not self._is_listing()
        return False

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        with suppress(FileNotFoundError):
            return bool(self.info()["type"] == "directory") or self._is_listing()
        return False

    def _is_listing(self) -> bool:
        """Whether a web server lists a folder at this address."""
        is_web = EXTRAS[self.scheme] == "http"
        return is_web and not self.suffix and self.info().get("mimetype") == "text/html"

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        kind = stat.S_IFDIR if self.is_dir() else stat.S_IFREG
        size = self.info().get("size") or 0
        return os.stat_result((kind, 0, 0, 1, 0, 0, size, 0, 0, 0))

    def iterdir(self) -> Generator[RemotePath, None, None]:
        """The files and folders in it."""
        names = _requested(self, lambda system: system.ls(self._listed(), detail=False))
        for name in sorted({str(f).rstrip("/").rpartition("/")[2] for f in names}):
            if name != self.name:
                yield self / name

    def _listed(self) -> str:
        return f"{self._address()}/" if EXTRAS[self.scheme] == "http" else self._address()

    def matches(self) -> list[RemotePath]:
        """The files that the address as a pattern matches, sorted."""
        paths = _requested(self, lambda system: system.glob(self._address()))
        return [RemotePath.of_url(f"{self.scheme}://{name}") for name in sorted(paths)]

    def info(self) -> dict[str, Any]:
        """Facts about it: ``size``, ``type`` and more. FileNotFoundError where it is missing."""
        return dict(_requested(self, lambda system: system.info(self._address())))

    def etag(self) -> str | None:
        """A text that changes whenever the content does; None where the server has none."""
        info = self.info()
        tag = next((str(info[k]) for k in ("ETag", "etag", "md5Hash") if info.get(k)), "")
        return None if not tag or tag.startswith("W/") else tag.strip('"')

    def read_range(self, start: int, stop: int) -> bytes:
        """The bytes from ``start`` to ``stop`` of it; RemoteError where the server cannot."""

        def request(system: Any) -> bytes:
            data = bytes(system.cat_file(self._address(), start=start, end=stop))
            if len(data) < stop - start:
                raise EOFError(f"{len(data)} of {stop - start} bytes came")
            return data

        data = _requested(self, request)
        if len(data) > stop - start:
            raise RemoteError(
                f"{self} cannot be read: its server sends whole files only, not ranges of them;"
                " copy the log to a disk."
            )
        return data

    def open(self, mode: str = "r", *_: Any, **__: Any) -> IO[Any]:  # type: ignore[override]
        """A file to read."""
        if set(mode) - set("rbt"):
            raise OSError(errno.EROFS, "only uploading writes to a server", str(self))
        file = io.BufferedReader(RemoteFile(self), BLOCK // 16)
        return file if "b" in mode else io.TextIOWrapper(file, encoding="utf-8")


class _Positioned(io.IOBase):
    """What is read at a position that can be moved."""

    _position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position


class RemoteFile(_Positioned, io.RawIOBase):
    """Reads blocks of an address, the last ones kept."""

    def __init__(self, path: RemotePath) -> None:
        info = path.info()
        if info["type"] == "directory":
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if info.get("size") is None:
            raise RemoteError(
                f"{path} cannot be read: its server does not tell how large it is; copy the log to"
                " a disk."
            )
        self._path = path
        self._size = int(info["size"])
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._last = -2  # block that was read last

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        origin = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        if origin + offset < 0:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL), str(self._path))
        self._position = origin + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        data = self._span(self._position, min(self._position + len(view), self._size))
        view[: len(data)] = data
        self._position += len(data)
        return len(data)

    def _span(self, start: int, stop: int) -> bytes:
        if stop <= start:
            return b""
        first, last = start // BLOCK, (stop - 1) // BLOCK
        if any(k not in self._blocks for k in range(first, last + 1)):
            if last - first >= _KEPT - _AHEAD:  # it would push itself out
                return self._path.read_range(start, stop)
            self._fetch(first, last)
        for k in range(first, last + 1):
            self._blocks.move_to_end(k)
        joined = b"".join(self._blocks[k] for k in range(first, last + 1))
        self._last = last
        return joined[start - first * BLOCK : stop - first * BLOCK]

    def _fetch(self, first: int, last: int) -> None:
        """Reads the blocks from the first to the last one that is missing."""
        missing = [k for k in range(first, last + 1) if k not in self._blocks]
        first, until = missing[0], missing[-1] + 1
        if first in (self._last, self._last + 1):
            until = max(until, first + _AHEAD)
        stop = min(until * BLOCK, self._size)
        data = self._path.read_range(first * BLOCK, stop)
        for k in range(first, -(-stop // BLOCK)):
            begin = (k - first) * BLOCK
            self._blocks[k] = data[begin : begin + BLOCK]
            self._blocks.move_to_end(k)
        while len(self._blocks) > _KEPT:
            self._blocks.popitem(last=False)


@contextmanager
def uploading(path: RemotePath) -> Iterator[BinaryIO]:
    """A file that appears at ``path``, whole, when the block ends well.

    Its first megabyte can be read again, and its last 64 can be changed.
    """
    if EXTRAS[path.scheme] == "http":
        raise RemoteError(f"{path} cannot be written: results go to a file, or to s3:// or gs://.")
    try:
        system = _file_system(path)
        target = system.open(path.url, "wb", block_size=_PART, autocommit=False)
    except Exception as error:
        raise _unwritten(path, error) from error
    upload = _Upload(path, target)
    try:
        yield cast(BinaryIO, upload)
        upload.send_all()
        target.close()
        target.commit()
    except BaseException as error:
        target.closed = True  # else its end would be sent when it is collected
        with suppress(Exception):
            target.discard()
        if isinstance(error, _SendError):
            raise _unwritten(path, error.__cause__ or error) from error
        if isinstance(error, OSError):
            raise _unwritten(path, error) from error
        raise


class _SendError(Exception):
    """The server did not take a part."""


class _Upload(_Positioned, io.BufferedIOBase):
    """Sends what has been written, apart from the last bytes."""

    def __init__(self, path: RemotePath, target: Any) -> None:
        self._path, self._target = path, target
        self._head = b""
        self._sent = 0
        self._held = bytearray()

    def writable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        end = self._sent + len(self._held)
        self._position = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: end}[
            whence
        ] + offset
        return self._position

    def write(self, data: Any) -> int:
        content = memoryview(data).cast("B")
        begin = self._position - self._sent
        if not 0 <= begin <= len(self._held):
            raise OSError(errno.ESPIPE, "an earlier part was sent already", str(self._path))
        self._held[begin : begin + len(content)] = content
        self._position += len(content)
        if len(self._held) > _HELD + _PART:
            self._send(len(self._held) - _HELD)
        return len(content)

    def read(self, size: int | None = -1) -> bytes:
        size = -1 if size is None else size
        begin = self._position - self._sent
        if begin < 0:
            if size < 0 or self._position + size > len(self._head):
                raise OSError(errno.ESPIPE, "an earlier part was sent already", str(self._path))
            data = self._head[self._position : self._position + size]
        else:
            data = bytes(self._held[begin : len(self._held) if size < 0 else begin + size])
        self._position += len(data)
        return data

    def truncate(self, size: int | None = None) -> int:
        end = self._position if size is None else size
        del self._held[max(0, end - self._sent) :]
        return end

    def send_all(self) -> None:
        """Send the rest."""
        self._send(len(self._held))

    def _send(self, count: int) -> None:
        part = bytes(self._held[:count])
        self._head += part[: _HEAD - len(self._head)]
        try:
            self._target.write(part)
        except Exception as error:
            raise _SendError from error
        del self._held[:count]
        self._sent += count


# -- requests


@cache
def _system(scheme: str, process: int) -> Any:
    """The fsspec file system of a scheme in a process. ImportError without the extra."""
    import fsspec

    options: dict[str, Any] = {"skip_instance_cache": True, "use_listings_cache": False}
    if scheme == "s3":
        importlib.import_module("s3fs")
        silence = {"connect_timeout": 10, "read_timeout": _SILENCE_S}
        options["config_kwargs"] = {"retries": {"max_attempts": 1}, **silence}
    elif scheme == "gs":
        importlib.import_module("gcsfs")
    else:
        aiohttp = importlib.import_module("aiohttp")
        silent = aiohttp.ClientTimeout(total=None, sock_connect=10, sock_read=_SILENCE_S)
        options |= {"client_kwargs": {"timeout": silent}, "encoded": True}
    return fsspec.filesystem(scheme, **options)


def _file_system(path: RemotePath) -> Any:
    try:
        return _system(path.scheme, os.getpid())
    except ImportError as error:
        extra = EXTRAS[path.scheme]
        raise RemoteError(
            f"{path} cannot be read: {path.scheme}:// needs the extra '{extra}':"
            f" pip install 'semloc_logs[{extra}]'."
        ) from error


def _requested(path: RemotePath, request: Callable[[Any], Answer]) -> Answer:
    """The answer of a server, which gets several tries.

    FileNotFoundError and PermissionError are answers; RemoteError after the last try.
    """
    system = _file_system(path)
    pause_s = _PAUSE_S
    for left in reversed(range(TRIES)):
        try:
            return request(system)
        except Exception as error:
            _raise_answer(path, error)
            if not left:
                raise RemoteError(
                    f"{path} cannot be read: its server failed {TRIES} times in a row"
                    f" ({_reason(error)}); give the same command again when it answers."
                ) from error
        time.sleep(pause_s)
        pause_s *= 2
    raise AssertionError


def _raise_answer(path: RemotePath, error: Exception) -> None:
    """Raises what a server means by an error; nothing where it may be another at the next try."""
    chain: list[BaseException] = [error]
    while chain[-1].__cause__ is not None:
        chain.append(chain[-1].__cause__)
    names = {type(e).__name__ for e in chain}
    if names & {"NoCredentialsError", "PartialCredentialsError", "ProfileNotFound"}:
        raise RemoteError(
            f"{path} cannot be read: credentials for it are missing; set AWS_PROFILE, or"
            " FSSPEC_S3_ANON=true where anyone may read it."
        ) from error
    if names & {"InvalidURL", "InvalidUrlClientError", "ParamValidationError"}:
        raise RemoteError(f"{path} is not an address that a server can have.") from error
    status = next((s for e in chain if isinstance(s := getattr(e, "status", None), int)), None)
    if any(isinstance(e, PermissionError) for e in chain) or status in (401, 403):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path)) from error
    # the HTTP file system calls every failure so, with the reason behind it
    is_told = len(chain) == 1 or EXTRAS[path.scheme] != "http"
    if status in (404, 410) or (is_told and isinstance(error, FileNotFoundError)):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from error


def _reason(error: BaseException) -> str:
    while isinstance(error, FileNotFoundError) and error.__cause__ is not None:
        error = error.__cause__
    text = " ".join(str(error).split()).rstrip(".")
    return text[:200] or type(error).__name__


def _unwritten(path: RemotePath, error: BaseException) -> RemoteError:
    if isinstance(error, RemoteError):
        return error
    return RemoteError(
        f"{path} could not be written ({_reason(error)}): check the address, the permissions and"
        " the connection."
    )
