"""Bring the numbers of `adp paper` into docs/method.md, wherever a phrase tells one of them.

adp paper --out DIR && python bench/site/numbers.py DIR    # DIR/paper.json becomes docs/paper.json
"""

import json
import re
import shutil
import string
import sys
from pathlib import Path as FilePath
from typing import Any

ROOT = FilePath(__file__).parents[2]
NUMBERS = ROOT / "docs" / "paper.json"
PAGE = ROOT / "docs" / "method.md"
_NUMBER = r"([-−+]?\d+(?:\.\d+)?)"

# Names of the rows in the order of paper.json.
_ROWS = (
    "initial weights, no learning",
    "printed laws, grid half-widths (1, 1, 1, 0.5)",
    "printed laws, all 0.5 (shipped)",
    "printed laws, all 0.3",
)
# Phrases whose fields are entries of paper.json.
PHRASES = (
    "without limits, J* = {optimal_cost:.6f}:",
    *(
        f"| {name} | {{runs[{row}][cost]:.4f}} | {{runs[{row}][cost_ratio]:.3f}} "
        f"| {{runs[{row}][state_distance]:.3f}} / {{runs[{row}][input_distance]:.3f}} |"
        for row, name in enumerate(_ROWS)
    ),
    "from 0.5 and 0 to {long_runs[0][final_actor_weights][3]:.2f} and "
    "{long_runs[0][final_actor_weights][7]:.2f} with the widest grid",
    "has wandered to {long_runs[0][final_y]:.2f} m and J has grown to {long_runs[0][cost]:.0f} "
    "with the widest grid",
    "and {long_runs[1][cost]:.2f} with the shipped one",
    "L_f/2 = {theorem[q_min_needed]:.4f}.",
    "c_min = {theorem[c_min]:.3f} is below",
    "= {theorem[c_min_needed]:.1f}; its first term",
)


def with_numbers(page: str, numbers: dict[str, Any]) -> str:
    """Return a page with each phrase's numbers; raise ValueError where it has not the phrase."""
    for phrase in PHRASES:
        parts = list(string.Formatter().parse(phrase))
        literal = [r"\s+".join(map(re.escape, text.split(" "))) for text, *_ in parts]
        fields = [_NUMBER if name is not None else "" for _, name, *_ in parts]
        pattern = "".join(f"{text}{field}" for text, field in zip(literal, fields, strict=True))
        found = re.search(pattern, page)
        if found is None:
            raise ValueError(f"docs/{PAGE.name} has no such phrase: {phrase}")
        named = [(name, form) for _, name, form, _ in parts if name is not None]
        for group in range(len(named), 0, -1):  # from the end, so that places stay
            name, form = named[group - 1]
            text = f"{{{name}:{form}}}".format(**numbers).replace("-", "−")
            page = page[: found.start(group)] + text + page[found.end(group) :]
    return page


if __name__ == "__main__":
    if len(sys.argv) > 1:
        shutil.copyfile(FilePath(sys.argv[1]) / "paper.json", NUMBERS)
    content = json.loads(NUMBERS.read_text(encoding="utf-8"))
    PAGE.write_text(with_numbers(PAGE.read_text(encoding="utf-8"), content), encoding="utf-8")
