"""The figures that a written page carries."""

import base64
import gzip
import re


def page_data(page: str) -> str:
    """Return the data of a page's figures as the JSON text that its script unpacks."""
    packed = re.search(r'id="data">([^<]*)</script>', page)
    assert packed is not None
    return gzip.decompress(base64.b64decode(packed[1])).decode()
