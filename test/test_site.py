"""The documentation as a site: built strictly, searched and read without a server or a network."""

import re
import runpy
import shutil
import subprocess
import sys

import pytest

from folders import ROOT

pytest.importorskip("mkdocs", reason="the site needs the extra 'docs'")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the site; a broken link or anchor, or a page that no menu has, is an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium")
def test_pages_fit_a_telephone_and_ask_for_nothing_and_the_search_finds(site):
    asked = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 400, "height": 800})
        page.on("request", lambda request: asked.append(request.url))
        # Long lines, formulas, tables, and a page that a server shows from its root.
        for name in ("commands", "404", "optimality", "index"):
            page.goto((site / f"{name}.html").as_uri())
            assert page.evaluate("getComputedStyle(document.body).display") == "flex", name
            assert page.evaluate("document.documentElement.scrollWidth") <= 400, name
        page.keyboard.press("f")
        result = ".md-search-result__link:has-text('Metrics')"
        for _ in range(60):  # letters that come before the page listens are lost
            page.fill(".md-search__input", "")
            page.type(".md-search__input", "excitation_min")
            page.wait_for_timeout(1000)
            if page.is_visible(result):
                break
        assert page.is_visible(result)
        browser.close()
    assert [url for url in asked if not url.startswith((site.as_uri(), "blob:"))] == []


def test_a_code_block_ends_no_list(site):
    """GitHub needs neither four spaces before a block in an item nor a blank line after it."""
    for page in site.glob("*.html"):
        assert not re.search(r"^(?:<p>)?\d+\. ", page.read_text("utf-8"), re.M), page.name


def test_the_site_has_every_command_and_every_name_of_the_package(site):
    import adp_path_follower
    from adp_path_follower.cli.main import _COMMANDS

    commands, python = ((site / f"{name}.html").read_text() for name in ("commands", "python"))
    assert all(f'id="adp-{name}"' in commands for name in _COMMANDS)
    assert all(f".{name}" in python for name in adp_path_follower.__all__)
    assert "shape (B, 3)" in python


def test_the_page_of_metrics_is_the_generated_one():
    hooks = runpy.run_path(str(ROOT / "bench" / "site" / "hooks.py"))
    assert hooks["METRICS_PAGE"].read_text(encoding="utf-8") == hooks["metrics_page"]()
