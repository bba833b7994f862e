"""Running ``hil`` inside the process of a test."""

import contextlib
import io
import signal
from unittest import mock

from hil import cli


def called(*arguments: object) -> tuple[int, str, str]:
    """``hil ARGUMENT...``: exit code, standard output, standard error."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    out, err, ended = io.StringIO(), io.StringIO(), 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch("sys.argv", ["hil", *map(str, arguments)]),
    ):
        try:
            cli.main()
        except SystemExit as end:
            ended = int(end.code or 0)
    for number, handler in handlers.items():
        signal.signal(number, handler)
    return ended, out.getvalue(), err.getvalue()


def hil(*arguments: object, code: int = 0) -> tuple[str, str]:
    """``hil ARGUMENT...``: standard output and standard error; `code` is the exit code that must come."""
    ended, out, err = called(*arguments)
    assert ended == code, err
    return out, err
