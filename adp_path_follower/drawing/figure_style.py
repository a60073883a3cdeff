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

# Okabe and Ito's hues, as dark as it takes to stand out from a white page (4.5:1).
COLORS = ("#0072B2", "#C25500", "#00805E", "#B4508A", "#7A5BD8", "#8F6412")
PATH_COLOR = "rgba(128,128,128,0.6)"
POINT_COLOR = "#6B737B"  # of many points beside a few that matter
# A dark page has lighter ones, which stand out from it as much.
ON_DARK = {
    **dict(
        zip(
            COLORS,
            ("#56B4E9", "#F2853F", "#2BBE8F", "#E096C0", "#A895F2", "#D0A13F"),
            strict=True,
        )
    ),
    PATH_COLOR: "#7D858D",
    POINT_COLOR: "#9AA3AC",
}

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
