"""Read the figures of a written page, and wait for one that a browser shows."""

import base64
import gzip
import re
import time
from typing import Any


def page_data(page: str) -> str:
    """Return the data of a page's figures as the JSON text that its script unpacks."""
    packed = re.search(r'id="data">([^<]*)</script>', page)
    assert packed is not None
    return gzip.decompress(base64.b64decode(packed[1])).decode()


def wait_until(page: Any, expression: str, limit: float = 60.0) -> None:
    """Wait until the JavaScript expression is true on the page that a browser shows.

    Playwright's own `wait_for_function` asks again from within the page, where the page's
    policy forbids `eval`: it fails wherever the first answer is no.

    Raises:
        AssertionError: the expression is not true within `limit` [s].
    """
    end = time.monotonic() + limit
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"not true after {limit:g} s: {expression}"
        time.sleep(0.02)
