"""Output files: what is wrong with them is one sentence, said before the work if possible."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import output_to


def check_figure(file: Path | None) -> None:
    """Refuse a figure of a kind that cannot be drawn, before any work is done.

    Raises:
        FileError: Its name does not end in a known kind of picture.

    """
    if file is None:
        return
    from matplotlib.backend_bases import FigureCanvasBase  # which others need not wait for

    if file.suffix.lower().removeprefix(".") not in FigureCanvasBase.get_supported_filetypes():
        raise FileError(
            f"figure {file} must end in .png, .svg, .pdf or another kind of picture, as in "
            f"{file.with_suffix('.png')}"
        )


def write_npz(file: Path, arrays: dict[str, Any]) -> None:
    """Write arrays to a compressed NumPy file of exactly this name.

    Raises:
        FileError: It cannot be written.

    """
    content = io.BytesIO()  # a zip file that cannot be finished complains once more at its end
    np.savez_compressed(content, **arrays)
    with output_to(file):
        # Not getbuffer(): Python 3.12.1 crashes when an exception's traceback holds on to one.
        file.write_bytes(content.getvalue())
