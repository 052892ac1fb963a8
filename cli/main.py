"""The `semloc` program: commands loaded when called, errors as one sentence and an exit code.

Exit codes: 0 done; 1 failed; 2 wrong usage; 3 done, but some input was skipped; 130 and 143
interrupted.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, NoReturn

import click

from semloc_logs import __version__
from semloc_logs.errors import SemlocError, SettingsError, TopicError, did_you_mean

from .console import console

COMMANDS = {  # name -> (module of commands/, what --help says), in the order of the story
    "inspect": ("inspect_log", "Contents of a log, and what prevents its use."),
    "run": ("run", "Logs -> loop closures: fuse, describe, close, annotate."),
    "fuse": ("fuse", "Logs -> the semantic map of one session."),
    "describe": ("describe", "Maps -> semantic words."),
    "close": ("close", "Words -> loop closures."),
    "sessions": ("sessions", "What a workspace holds; rename and remove sessions."),
    "doctor": ("doctor", "Every file of a workspace checked, and what mends it."),
    "optimize": ("optimize", "Closures -> all sessions in one frame."),
    "tasks": ("cluster.tasks", "The tasks of a stage as JSON lines, for a cluster."),
    "task": ("cluster.task", "One of these tasks."),
    "annotate": ("annotate", "Closures -> channels of a log."),
    "index": ("index", "The index of the words: what it holds; up to date."),
    "evaluate": ("evaluate", "Closures against the truth."),
    "show": ("show", "Pictures of closures and of rejected hypotheses."),
    "report": ("report", "One page with maps, closures and reasons."),
    "export": ("export", "Poses, pose graph or map for other programs."),
    "simulate": ("simulate", "Drive logs through a procedural town, with truth."),
    "import": ("import_dataset", "Public data sets -> logs with truth."),
    "train": ("train", "Learn the descriptor."),
    "vocabulary": ("vocabulary", "Learn the words."),
    "demo": ("demo", "Everything once, on two simulated sessions."),
    "benchmark": ("benchmark", "Figures of speed, measured here and now."),
}


LEAVE_SECONDS = 4.5  # after SIGTERM: a cluster kills soon after it terminates
TERMINATED = "Terminated; finished work is kept, run the same command again to go on."


class Terminated(BaseException):
    """SIGTERM, as an exception, so that everything unwinds."""


class Program(click.Group):
    """Commands by name; the module of a command is imported when it is needed."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f".commands.{COMMANDS[cmd_name][0]}", __package__)
        loaded: click.Command = module.command
        return loaded

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """UsageError that names the command spelled most like an unknown one."""
        name = args[0] if args else ""
        if not name.startswith("-") and self.get_command(ctx, name) is None:
            ctx.fail(f"No such command '{name}'.{did_you_mean(name, COMMANDS)}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary) for name, (_, summary) in COMMANDS.items()])

    def main(
        self, args: Sequence[str] | None = None, prog_name: str | None = None, *_: Any, **__: Any
    ) -> NoReturn:
        """Run and exit with one of the documented exit codes."""
        from semloc_logs.engines.processes import single_threaded

        console.reset()
        single_threaded()
        warnings.simplefilter("ignore")  # remarks of numerical libraries are not for users
        with _terminating():
            code = self._guarded(args, prog_name)
        sys.exit(code)

    def _guarded(self, args: Sequence[str] | None, prog_name: str | None) -> int:
        try:
            code = super().main(args, prog_name or "semloc", standalone_mode=False)
            return code if isinstance(code, int) else 0
        except click.exceptions.Abort:
            console.error(
                "Interrupted; finished work is kept, run the same command again to go on."
            )
            return 128 + signal.SIGINT
        except Terminated:
            console.error(TERMINATED)
            return 128 + signal.SIGTERM
        except click.ClickException as problem:
            if console.log_format == "json":
                console.error(problem.format_message())
            else:
                problem.show()
            return problem.exit_code
        except (SettingsError, TopicError) as problem:
            console.error(str(problem))
            return 2
        except SemlocError as problem:
            console.error(str(problem))
            return 1
        except OSError as problem:
            _explain(problem)
            where = problem.filename or "A file"
            console.error(
                f"{where} cannot be read or written ({problem.strerror or problem}): check the"
                " path, permissions and disk space."
            )
            return 1
        except MemoryError as problem:
            _explain(problem)
            console.error("There is not enough memory: use fewer --jobs, or larger voxels.")
            return 1
        except Exception as problem:
            _explain(problem)
            frames = traceback.extract_tb(problem.__traceback__)
            where = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
            detail = " ".join(str(problem).split())[:200]
            console.error(
                f"Unexpected {type(problem).__name__}{where} ({detail}): run again with -v for the"
                " traceback and report it."
            )
            return 1


def _explain(problem: BaseException) -> None:
    if console.verbosity > 0:
        click.echo("".join(traceback.format_exception(problem)), err=True, nl=False)


@contextmanager
def _terminating() -> Iterator[None]:
    """SIGTERM raises Terminated in the block. The process ends LEAVE_SECONDS later at the latest,
    also where the main thread is in a long call of a library: files are whole at any time.
    """
    if threading.current_thread() is not threading.main_thread():  # of an embedding program
        yield
        return
    waiting, waking = socket.socketpair()
    waking.setblocking(False)
    before = signal.signal(signal.SIGTERM, _terminate)
    wakeup = signal.set_wakeup_fd(waking.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_leave_in_time, args=(waiting,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGTERM, before)
        waking.close()


def _leave_in_time(waiting: socket.socket) -> None:
    """Gets a byte for each signal, whatever the main thread does; none when the block is over."""
    with waiting:
        number = waiting.recv(1)
        while number and number[0] != signal.SIGTERM:
            number = waiting.recv(1)
    if number:
        time.sleep(LEAVE_SECONDS)
        for worker in multiprocessing.active_children():
            worker.kill()
        os.write(2, f"Error: {TERMINATED}\n".encode())
        os._exit(128 + signal.SIGTERM)


def _terminate(number: int, _: object) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # once is enough; the unwinding must not be interrupted
    raise Terminated


@click.group(
    cls=Program,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done but some input was skipped.",
)
@click.version_option(__version__, prog_name="semloc")
def program() -> None:
    """Where has a drive been before? Semantic loop closures from recorded drive logs (.mcap, .bag,
    .db3, ROS 2 bag folders).

    \b
    semloc demo                              everything once, on two simulated sessions
    semloc inspect A.mcap                    contents of a log, and what prevents its use
    semloc run A.mcap B.bag -w work          logs -> maps -> words -> closures, resumable
    """


def main() -> NoReturn:
    """The console script."""
    program.main()
