"""The `adp` command in this process: to its user the same, without a second of imports."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from dataclasses import dataclass
from pathlib import Path as FilePath
from unittest.mock import patch

from adp_path_follower.cli import main


@dataclass(frozen=True)
class Done:
    """Output and exit code of a command."""

    returncode: int
    stdout: str
    stderr: str


def adp(*arguments: str, cwd: FilePath | None = None) -> Done:
    """Run the command; whatever it raises, but its exit, is the test's."""
    out, problems, code = io.StringIO(), io.StringIO(), None
    with (
        contextlib.chdir(cwd or FilePath.cwd()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(problems),
        patch.object(sys, "argv", ["adp", *arguments]),
        patch.dict(os.environ, COLUMNS="100"),
    ):
        try:
            main.main()
        except SystemExit as end:
            code = end.code
    assert isinstance(code, int)
    return Done(code, out.getvalue(), problems.getvalue())
