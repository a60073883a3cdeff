"""How every figure looks."""

STYLE = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.dpi": 130,
    "font.size": 10,
    "grid.alpha": 0.3,
    "legend.frameon": False,
}

# Okabe and Ito's colours, without those that vanish on a white or on a black page.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8A6FDF", "#A6761D")

# From the path outwards. Each is the part of Viridis that stands out from its page: what is far
# from the path does most.
DISTANCE_SCALES = {
    "light": ("#1e9c89", "#2a788e", "#38588c", "#472f7d", "#440154"),
    "dark": ("#2a788e", "#1e9c89", "#44bf70", "#a0da39", "#fde725"),
}


def color(index: int) -> str:
    """Return the colour of a bag or of a curve; after the last one the first comes again."""
    return COLORS[index % len(COLORS)]


def is_dashed(index: int) -> bool:
    """Return whether the curve of a colour that was there before is dashed."""
    return index // len(COLORS) % 2 == 1
