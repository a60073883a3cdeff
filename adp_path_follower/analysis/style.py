"""How every figure looks."""

from __future__ import annotations

import matplotlib as mpl

mpl.use("Agg")  # files only: no window, no display needed

# Okabe and Ito's colours: told apart by the colour-blind too. For pictures that are never on a dark
# page; what a report shows has those of the palette.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLE = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.dpi": 130,
    "font.size": 10,
    "grid.alpha": 0.3,
    "legend.frameon": False,
}
