"""A disk that loses unsynced writes: every state that a crash may leave of a watched folder.

The model: a crash keeps synced writes and any subset of the rest. Content of a file is durable by
an fsync of the file; names in a folder (creations, renames, removals) by an fsync of the folder.
A write consists of blocks, and each block may be lost by itself.
"""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import pytest

SYNCS = ("fsync", "fdatasync")
CHANGES = (
    *("pwrite", "write", "ftruncate", "truncate"),
    *("replace", "rename", "unlink", "remove", "rmdir", "mkdir"),
)
ALL_SUBSETS = 7  # up to so many pending changes every subset is tried, beyond that a selection
Tree = dict[str, Any]  # name: bytes of a file, or the tree of a folder


class Crash(BaseException):
    """The process died."""


@dataclass(eq=False)
class _File:
    durable: bytes = b""
    seen: bytes = b""
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)  # None: cut off there

    def change(self, content: bytes, block: int) -> None:
        """Note what differs from the content that was seen last."""
        if len(content) < len(self.seen):
            self.pending.append((len(content), None))
        for start in range(0, len(content), block):
            data = content[start : start + block]
            if data != self.seen[start : start + block]:
                self.pending.append((start, data))
        self.seen = content

    def sync(self) -> None:
        self.durable = self.seen
        self.pending = []

    def after(self, kept: list[bool]) -> bytes:
        """The content when only some of the pending changes reach the disk."""
        content = bytearray(self.durable)
        for (offset, data), keep in zip(self.pending, kept, strict=True):
            if not keep:
                continue
            content[:] = content.ljust(offset, b"\0")
            content[offset : None if data is None else offset + len(data)] = data or b""
        return bytes(content)


@dataclass(eq=False)
class _Folder:
    durable: dict[str, Any] = field(default_factory=dict)
    seen: dict[str, Any] = field(default_factory=dict)
    pending: list[dict[str, Any]] = field(default_factory=list)  # names that change at once

    def change(self, names: dict[str, Any]) -> None:
        """Give names to files and folders; None removes a name. All or nothing of it is kept."""
        self.pending.append(names)
        self.seen = _renamed(self.seen, names)

    def sync(self) -> None:
        self.durable = dict(self.seen)
        self.pending = []

    def after(self, kept: list[bool]) -> dict[str, Any]:
        names = dict(self.durable)
        for change, keep in zip(self.pending, kept, strict=True):
            names = _renamed(names, change) if keep else names
        return names


def _renamed(names: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in (names | change).items() if v is not None}


class LossyDisk:
    """Watches all writes below ``root``; all that is there at the start is durable.

    ``block``: bytes that are written or lost together. ``visit`` is called before each step
    (a sync, or a change by a function of ``os``) and may look at :meth:`states`.
    ``die_at``: the number of the step before which the process dies.
    ``lost_sync``: the number of the sync that the program forgets.
    """

    def __init__(self, root: Path, *, block: int = 512) -> None:
        self.root, self.block = root, block
        self.visit: Callable[[], None] = lambda: None
        self.die_at = self.lost_sync = -1
        self.steps = self.syncs = 0
        self._top = _Folder()
        self._nodes: dict[int, Any] = {}
        self._observe()
        for node in self._all_nodes():
            node.sync()

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Within the block, the functions of ``os`` tell the disk what they do."""
        with pytest.MonkeyPatch.context() as patch:
            for name in (*SYNCS, *CHANGES):
                if hasattr(os, name):
                    patch.setattr(os, name, self._wrapped(name, getattr(os, name)))
            yield
        self._observe()

    def states(self) -> Iterator[Tree]:
        """What may be on the disk after a crash now."""
        self._observe()
        nodes = list(self._all_nodes())
        states: list[Tree] = []
        for kept in _subsets(sum(len(n.pending) for n in nodes)):
            position = 0
            chosen = {}
            for node in nodes:
                chosen[node] = kept[position : position + len(node.pending)]
                position += len(node.pending)
            tree = _tree(self._top, chosen)
            if tree not in states:
                states.append(tree)
                yield tree

    def _wrapped(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            if name == "write" and not self._is_mine(args[0]):
                return real(*args, **options)
            self._observe()
            if self.steps == self.die_at:
                raise Crash
            self.visit()
            self.steps += 1
            if name in SYNCS:  # the real disk need not be waited for
                self._sync(args[0])
                return None
            result = real(*args, **options)
            if name in ("replace", "rename"):
                self._rename(Path(args[0]), Path(args[1]))
            self._observe()
            return result

        return call

    def _is_mine(self, handle: int) -> bool:
        return os.fstat(handle).st_ino in self._nodes

    def _sync(self, handle: int) -> None:
        node = self._nodes.get(os.fstat(handle).st_ino)
        if node is not None and self.syncs != self.lost_sync:
            node.sync()
        self.syncs += node is not None

    def _rename(self, source: Path, target: Path) -> None:
        if source.parent.stat().st_ino in self._nodes:
            assert source.parent == target.parent, "renames between folders are not modelled"
            folder = self._nodes[source.parent.stat().st_ino]
            folder.change({source.name: None, target.name: folder.seen[source.name]})

    def _observe(self) -> None:
        nodes: dict[int, Any] = {self.root.stat().st_ino: self._top}
        self._observe_folder(self._top, self.root, nodes)
        self._nodes = nodes

    def _observe_folder(self, folder: _Folder, path: Path, nodes: dict[int, Any]) -> None:
        entries = {e.name: e for e in os.scandir(path)}
        for name in [n for n in folder.seen if n not in entries]:
            folder.change({name: None})
        for name, entry in entries.items():
            kind = _Folder if entry.is_dir(follow_symlinks=False) else _File
            if not isinstance(folder.seen.get(name), kind):
                folder.change({name: kind()})
            node = folder.seen[name]
            nodes[entry.inode()] = node
            if kind is _Folder:
                self._observe_folder(node, path / name, nodes)
            else:
                content = (path / name).read_bytes()
                if content != node.seen:
                    node.change(content, self.block)

    def _all_nodes(self) -> Iterator[Any]:
        """Files and folders that a state may show."""
        todo = [self._top]
        known = {self._top}
        while todo:
            node = todo.pop()
            yield node
            if isinstance(node, _Folder):
                inside = [*node.durable.values(), *(v for p in node.pending for v in p.values())]
                new = [n for n in dict.fromkeys(inside) if n is not None and n not in known]
                known.update(new)
                todo.extend(new)


def _subsets(count: int) -> Iterator[tuple[bool, ...]]:
    """Which of ``count`` changes are kept: every subset of few, a selection of many."""
    if count <= ALL_SUBSETS:
        yield from product((False, True), repeat=count)
        return
    yield (False,) * count
    yield (True,) * count
    for k in range(count):
        yield tuple(i < k for i in range(count))
        yield tuple(i >= k for i in range(count))
        yield tuple(i == k for i in range(count))
        yield tuple(i != k for i in range(count))
    choice = random.Random(count)
    for _ in range(30):
        yield tuple(choice.random() < 0.5 for _ in range(count))


def _tree(folder: _Folder, chosen: dict[Any, tuple[bool, ...]]) -> Tree:
    tree: Tree = {}
    for name, node in folder.after(list(chosen[folder])).items():
        kept = chosen[node]
        tree[name] = _tree(node, chosen) if isinstance(node, _Folder) else node.after(list(kept))
    return tree


def read_tree(folder: Path) -> Tree:
    """The content of a folder."""
    return {
        p.name: read_tree(p) if p.is_dir() else p.read_bytes() for p in sorted(folder.iterdir())
    }


def write_tree(tree: Tree, folder: Path) -> Path:
    """Put files and folders into ``folder``, which is created."""
    folder.mkdir(parents=True)
    for name, content in tree.items():
        if isinstance(content, bytes):
            (folder / name).write_bytes(content)
        else:
            write_tree(content, folder / name)
    return folder
