"""The report in a real browser, without a screen."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from pages import wait_until

from bag_messages import drive_on_line, learner_run, text, twist, write_bag

pytest.importorskip("plotly", reason="the report needs the extra 'report'")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from adp_path_follower.analysis.bag_analysis import BagAnalysis, analyse_bag
from adp_path_follower.analysis.bag_page import write_report
from adp_path_follower.analysis.metrics import parse_requirement
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.drawing.charts import KINDS, SteeringMap
from adp_path_follower.drawing.page import Table, write_runs_page
from adp_path_follower.study.simulation.shown import shown_run
from adp_path_follower.study.simulation.simulate import simulate

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"),
    *("--disable-component-update", "--disable-sync"),
]
ATTACK = (
    "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='t'\">"
)
WIDTHS = {"wide": (1280, 900), "narrow": (400, 800)}

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium"
)


@pytest.fixture(scope="module")
def pages(tmp_path_factory) -> dict[str, FilePath]:
    """Return reports of one bag, of two, one with a long name, and of one full of tags."""
    folder = tmp_path_factory.mktemp("pages")
    bags = {
        "mine": learner_run(),
        f"other_{'x' * 80}": drive_on_line(
            lambda time: 0.1 / (1.0 + time), commands=twist, rate=20
        ),
        ATTACK.replace("/", "\u2215"): [
            *learner_run(hostile=ATTACK),
            (f"/{ATTACK}", 20 * 10**9, text(ATTACK)),
        ],
    }
    for name, messages in bags.items():
        write_bag(folder / name, messages)
    found = {}
    mine, other, hostile = bags
    contents = {"one": [mine], "two": [mine, other], "foreign": [other], "hostile": [hostile]}
    for title, names in contents.items():
        analyses = [
            analyse_bag(folder / name, {}, len(names), folder / "trajectory.tum") for name in names
        ]
        found[title] = folder / f"{title}.html"
        write_report(analyses, [parse_requirement("cross_track_max<0.1")], found[title])
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield found
        found.close()


@dataclass
class Visit:
    """An open page, and what it said and asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def robot(self) -> str:
        """Return where the robot is drawn."""
        return str(
            self.page.evaluate(
                "document.getElementById('figure-track').layout.shapes"
                ".find((shape) => shape.name === 'robot').path"
            )
        )

    def cursor(self, figure: str) -> float:
        """Return the time that a figure's line is at."""
        return float(
            self.page.evaluate(
                f"document.getElementById('figure-{figure}').layout.shapes"
                ".find((shape) => shape.name === 'now').x0"
            )
        )


def open_page(browser: Any, file: FilePath, size: str = "wide", scheme: str = "light") -> Visit:
    width, height = WIDTHS[size]
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    visit = Visit(context.new_page())
    visit.page.on("console", lambda message: visit.said.append(message.text))
    visit.page.on("pageerror", lambda error: visit.said.append(str(error)))
    visit.page.on("request", lambda request: visit.asked.append(request.url))
    visit.page.goto(file.as_uri())
    visit.page.wait_for_selector("html[data-drawn=true]")
    return visit


@pytest.fixture(scope="module")
def visits(pages, browser) -> Callable[..., Visit]:
    """Return a function that opens a page once, for all tests that only look at it."""
    opened: dict[tuple[str, str, str], Visit] = {}

    def visit(name: str, size: str = "wide", scheme: str = "light") -> Visit:
        key = (name, size, scheme)
        if key not in opened:
            opened[key] = open_page(browser, pages[name], size, scheme)
        return opened[key]

    return visit


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", WIDTHS)
@pytest.mark.parametrize("name", ["one", "two"])
def test_it_opens_without_complaint_and_without_network(pages, visits, name, size, scheme):
    visit = visits(name, size, scheme)
    assert visit.said == []
    assert visit.asked == [pages[name].as_uri()]
    width = visit.page.evaluate("document.documentElement.scrollWidth")
    assert width == WIDTHS[size][0]  # nothing sticks out
    empty = visit.page.evaluate(
        "[...document.querySelectorAll('[data-figure]')].filter((element) =>"
        " !element.data.some((trace) => trace.x && (trace.x.length || trace.x.bdata)) ||"
        " !element.querySelector('.trace path, .point path, .scatterlayer path, .bars path'))"
        ".map((element) => element.id)"
    )
    assert empty == []


def test_no_control_opens_a_window_or_sends_anything(pages, browser):
    """Plotly's own button uploads the figure by a new window, past the page's policy."""
    visit = open_page(browser, pages["one"])
    buttons = visit.page.locator(".modebar-btn")
    titles = [buttons.nth(index).get_attribute("data-title") for index in range(buttons.count())]
    assert "Download plot as a PNG" in titles
    assert not [title for title in titles if "hare" in title or "loud" in title]
    visit.page.evaluate("document.querySelectorAll('.modebar-btn').forEach((b) => b.click())")
    assert visit.page.evaluate("window.open('https://example.org/')") is None
    visit.page.wait_for_timeout(300)
    assert len(visit.page.context.pages) == 1
    assert not [url for url in visit.asked if not url.startswith(("file:", "data:", "blob:"))]
    assert "form-action 'none'" in pages["one"].read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["one", "two"])
def test_the_metrics_can_be_read_on_a_telephone(visits, name):
    """Name, meaning, unit and every value, without scrolling; the name stays where it must be."""
    visit = visits(name, "narrow")
    table = visit.page.locator("#metrics .scroll")
    assert table.evaluate("(element) => element.scrollWidth <= element.clientWidth")
    row = visit.page.locator("#metrics tr", has_text="Median time from odometry")
    assert "Median time from odometry to its command, as recorded [s]" in row.inner_text()
    assert "meaning" not in table.inner_text()
    name_cell = row.locator("th")
    assert name_cell.evaluate("(element) => getComputedStyle(element).position") == "sticky"
    assert name_cell.bounding_box()["width"] > 130
    wide = visits(name).page.locator("#metrics tr", has_text="latency_p50")
    assert wide.inner_text().split("\t")[-2:] == [
        *("s", "Median time from odometry to its command, as recorded")
    ]


def test_the_slider_moves_the_robot_and_every_line(pages, browser):
    visit = open_page(browser, pages["one"])
    before = visit.robot()
    visit.page.focus("#time")
    for _ in range(20):  # samples of the odometry, each 10 ms
        visit.page.keyboard.press("ArrowRight")
    visit.page.keyboard.press("ArrowLeft")
    samples = float(visit.page.input_value("#time"))
    visit.page.keyboard.press("PageUp")
    jump = float(visit.page.input_value("#time")) - samples
    assert jump == pytest.approx(12.0 / 20, abs=0.05)
    assert 19 * 0.009 < samples < 19 * 0.05
    assert visit.robot() != before
    visit.page.evaluate("document.getElementById('time').value = 6")
    visit.page.dispatch_event("#time", "input")
    assert visit.page.inner_text("#now") == "6.00 s"
    for figure in ("errors", "commands", "weights", "bellman_error", "excitation", "events"):
        visit.page.locator(f"#figure-{figure}").scroll_into_view_if_needed()
        # The page draws what comes into sight; its policy forbids the library's own waiting.
        for _ in range(100):
            if visit.cursor(figure) == pytest.approx(6.0):
                break
            visit.page.wait_for_timeout(20)
        assert visit.cursor(figure) == pytest.approx(6.0)


@pytest.mark.parametrize("name", ["one", "two", "foreign"])
def test_captions_speak_of_what_is_there(visits, name):
    text = visits(name).page.inner_text("main")
    learned = name != "foreign"
    assert ("its virtual target" in text) == learned
    assert ("dashed lines are the limits" in text) == learned
    assert ("colour is the distance" in text) == (name != "two")


def test_all_kinds_of_events_have_their_place(visits):
    axis = "document.getElementById('figure-events')._fullLayout.yaxis"
    visit = visits("two")
    assert visit.page.evaluate(f"{axis}.range") == [-0.5, 4.5]
    assert visit.page.evaluate(f"{axis}.categoryarray") == list(reversed(KINDS))


def test_only_a_target_that_was_recorded_is_drawn(visits):
    visit = visits("two")
    names = visit.page.evaluate(
        "document.getElementById('figure-track').layout.shapes.map((shape) => shape.name)"
    )
    assert sorted(names) == ["robot", "robot", "target"]


def test_numbers_of_different_paths_get_no_star(tmp_path):
    """How often commands came can still be compared, but not how far from the path they led."""
    write_bag(tmp_path / "near", drive_on_line(lambda time: 0.1, commands=twist, rate=20))
    write_bag(tmp_path / "far", drive_on_line(lambda time: 0.2, commands=twist, rate=10))
    near, far = (
        analyse_bag(tmp_path / name, {}, 2, tmp_path / f"{name}.tum") for name in ("near", "far")
    )

    def starred(*analyses: BagAnalysis) -> set[str]:
        write_report(analyses, [], tmp_path / "page.html")
        page = (tmp_path / "page.html").read_text(encoding="utf-8")
        rows = page[page.index('id="metrics"') :].split("<tr>")[2:]
        cells = [row[row.index("<code>") : row.index("</code>")] for row in rows if "★" in row]
        return {re.sub("<[^>]*>", "", cell) for cell in cells}

    same = starred(near, far)
    assert {"cross_track_rms", "command_rate"} <= same
    charts = far.charts
    turned = replace(charts.track, path=charts.track.path @ np.array([[0.8, 0.6], [-0.6, 0.8]]))
    other = starred(near, replace(far, charts=replace(charts, track=turned)))
    assert other == {name for name in same if name.startswith(("command_", "latency_"))}
    # A line that keeps other points of the same path is the same path.
    thinned = replace(charts.track, path=charts.track.path[::3])
    assert starred(near, replace(far, charts=replace(charts, track=thinned))) == same


def test_play_runs_and_stops(pages, browser):
    visit = open_page(browser, pages["one"])
    visit.page.select_option("#speed", "1")  # for 12 s: the machine may be busy
    assert visit.page.evaluate("document.querySelector('button, a, input, select').id") == "play"
    visit.page.locator("body").press(" ")
    assert visit.page.get_attribute("#play", "aria-pressed") == "true"
    visit.page.select_option("#speed", "20")
    visit.page.wait_for_selector("#play[aria-pressed=false]")
    assert float(visit.page.input_value("#time")) == pytest.approx(12.0, abs=0.01)


def test_zoom_in_one_figure_zooms_time_in_all_and_the_vertical_axes_follow(pages, browser):
    visit = open_page(browser, pages["one"])
    axes = "document.getElementById('figure-%s')._fullLayout"
    whole = visit.page.evaluate(f"{axes % 'errors'}.xaxis.range")
    zoom = "Plotly.relayout(document.getElementById('figure-errors'), %s)"
    visit.page.evaluate(zoom % "{'xaxis.range[0]': 8, 'xaxis.range[1]': 10}")
    wait_until(visit.page, f"{axes % 'events'}.xaxis.range[0] === 8")
    for figure in ("errors", "commands", "weights"):
        assert visit.page.evaluate(f"{axes % figure}.xaxis.range") == [8, 10]
    low, high = visit.page.evaluate(f"{axes % 'errors'}.yaxis.range")
    shown = visit.page.evaluate(
        "(() => { const { x, y } = document.getElementById('figure-errors')._fullData[0];"
        " return [...y].filter((_, place) => x[place] >= 8 && x[place] <= 10); })()"
    )
    assert low <= min(shown) <= max(shown) <= high
    assert high - low < 1.2 * (max(shown) - min(shown)) + 1e-9
    visit.page.evaluate(zoom % "{'xaxis.autorange': true}")
    wait_until(visit.page, f"{axes % 'events'}.xaxis.range[0] === {whole[0]}")


def test_the_first_screen_says_what_came_out(visits):
    """The verdict and the chief numbers."""
    visit = visits("one", "wide", "light")
    text = visit.page.inner_text("header")
    assert "value function of an optimal control problem" in text
    assert "m of the path of 61 m were driven" in text
    assert visit.page.locator(".cards li").count() == 6
    assert "mm" in visit.page.inner_text(".cards li:nth-child(2) .number")


def test_the_first_screen_shows_track_and_policy_before_and_after(browser, tmp_path):
    write_bag(tmp_path / "bag", learner_run())
    analysis = analyse_bag(tmp_path / "bag", {}, 1, tmp_path / "trajectory.tum")
    axis = np.linspace(-1.0, 1.0, 11)
    steering = SteeringMap(axis, axis, np.subtract.outer(-axis, axis))
    analysis = replace(analysis, charts=replace(analysis.charts, steering=(steering, steering)))
    write_report([analysis], [], tmp_path / "page.html")
    visit = open_page(browser, tmp_path / "page.html")
    for figure in ("track", "policy_before", "policy_after"):
        box = visit.page.locator(f"#figure-{figure}").bounding_box()
        assert box["y"] + box["height"] < WIDTHS["wide"][1]


def test_simulated_runs_start_together_and_their_table_sorts(browser, tmp_path):
    """The page of `adp compare` and of `adp simulate --report`."""
    settings = build(Settings, {"learning": False, "wide_region": "none"})
    path, starts = named_path("line"), np.array([[0.0, 0.4, 0.0], [-0.5, -0.2, 0.3]])
    result = simulate(settings, path, starts, duration=3.0, record=True)
    names = ("left", "behind")
    runs = [
        shown_run(name, path, settings, result.trajectories, run, 2)
        for run, name in enumerate(names)
    ]
    rows = tuple(
        ((name, math.nan), (f"{cost:.4f}", cost))
        for name, cost in zip(names, result.cost.tolist(), strict=True)
    )
    file = tmp_path / "runs.html"
    table = Table(("start", "J"), rows)
    cards = (("cost J", "1.5", "the least"),)
    write_runs_page(file, "Two runs", "About.", "adp", [settings], cards, runs, table)
    visit = open_page(browser, file, "narrow")
    named = 'Settings: the defaults but learning false, wide_region "none".'
    about = visit.page.inner_text(".about")
    assert about.startswith("adp_path_follower drives ")
    assert about.endswith(f"About. {named}")
    assert visit.page.locator(".cards li").all_inner_texts() == ["cost J\n1.5\nthe least"]
    assert (visit.said, visit.asked) == ([], [file.as_uri()])
    spent = visit.page.evaluate(
        "document.getElementById('figure-cost')._fullData.map((trace) => trace.y.at(-1))"
    )
    assert spent == pytest.approx(result.cost, rel=1e-5)
    cells = visit.page.locator("#table tbody td")
    for turn in (1, -1):
        visit.page.click("#table th >> text=J")
        assert cells.all_inner_texts() == [f"{cost:.4f}" for cost in sorted(result.cost)[::turn]]
    before = visit.robot()
    visit.page.focus("#time")
    visit.page.keyboard.press("ArrowRight")
    assert visit.robot() != before


def test_six_runs_have_their_names_and_their_settings_out_of_the_way(browser, tmp_path):
    """A legend of many lines takes no height from the curves; many settings are folded."""
    changes = {"actor_gain": 2.0, "target_gain": 0.3, "desired_speed": 0.4, "sample_seed": 1}
    settings = build(Settings, changes | {"learning": False, "wide_region": "none"})
    path, starts = named_path("line"), np.array([[0.0, 0.1 * row, 0.0] for row in range(6)])
    result = simulate(settings, path, starts, duration=1.0, record=True)
    runs = [
        shown_run(f"a name as long as this, {run}", path, settings, result.trajectories, run, 6)
        for run in range(6)
    ]
    file = tmp_path / "runs.html"
    write_runs_page(file, "Six", "About.", "adp", [settings], (), runs, Table(("start",), ()))
    visit = open_page(browser, file, "narrow")
    shown = "document.getElementById('figure-cost')._fullLayout"
    assert visit.page.evaluate(f"{shown}.yaxis._length") > 140
    assert visit.page.locator("#figure-cost .legend .scrollbar").get_attribute("height") == "0"
    assert visit.page.locator("#figure-cost .legendtext").count() == 6
    assert not visit.page.is_visible("details p:has-text('sample_seed 1')")
    visit.page.click("text=the defaults but 6")
    assert visit.page.is_visible("details p:has-text('sample_seed 1')")


def test_the_map_follows_the_robots(pages, browser):
    visit = open_page(browser, pages["two"])
    axes = "document.getElementById('figure-track')._fullLayout"
    ends = f"[...{axes}.xaxis.range, ...{axes}.yaxis.range]"
    whole = visit.page.evaluate(ends)
    visit.page.check("#follow")
    for time in (2, 6):
        visit.page.evaluate(f"document.getElementById('time').value = {time}")
        visit.page.dispatch_event("#time", "input")
        left, right, low, high = visit.page.evaluate(ends)
        assert right - left < 0.7 * (whole[1] - whole[0])
        assert left < 0.5 * time < right  # [m], at 0.5 m/s along the x axis
        assert low < 0.0 < high
    visit.page.uncheck("#follow")
    assert visit.page.evaluate(ends) == pytest.approx(whole)


def test_strings_of_a_bag_do_nothing(pages, browser):
    visit = open_page(browser, pages["hostile"])
    assert visit.said == []
    assert visit.asked == [pages["hostile"].as_uri()]
    assert visit.page.title().startswith("Run report: ")
    assert visit.page.locator("img[src=x]").count() == 0
    visit.page.locator("summary").last.click()
    assert ATTACK in visit.page.inner_text("main")


def test_it_can_be_used_without_seeing_it(visits):
    """Every control has a name, every image too, and texts stand out from the page."""
    visit = visits("two")
    nameless = visit.page.evaluate(
        "[...document.querySelectorAll('button, input, select, [role=img], [role=region]')]"
        ".filter((element) => !element.closest('.modebar') && !element.getAttribute('aria-label')"
        " && !element.getAttribute('aria-labelledby') && !element.labels?.length"
        " && !element.textContent.trim()).map((element) => element.outerHTML)"
    )
    assert nameless == []
    assert visit.page.get_attribute("html", "lang") == "en"
    # While playing, the time would be read out sixty times a second.
    assert visit.page.get_attribute("#now", "aria-live") == "off"
    assert visit.page.locator("h1").count() == 1
    for scheme in ("dark", "light"):
        visit.page.emulate_media(color_scheme=scheme)
        for name in ("--text", "--quiet", "--link", "--good", "--bad"):
            assert contrast(visit.page, name, "--page") >= 4.5


def test_the_track_stands_out_from_either_page(visits):
    """Whatever the distance from the path, also after the theme has changed, and back again."""
    visit = visits("one")
    before = None
    for scheme in ("light", "dark", "light"):
        visit.page.emulate_media(color_scheme=scheme)
        for _ in range(100):  # the page hears of it a little later
            scale = visit.page.evaluate(
                "document.getElementById('figure-track')._fullData"
                ".find((trace) => trace.marker && trace.marker.showscale).marker.colorscale"
            )
            if scale != before:
                break
            visit.page.wait_for_timeout(20)
        assert len(scale) == 5
        assert min(contrast(visit.page, color, "--page") for _, color in scale) >= 3.0
        before = scale


def test_curves_stand_out_from_either_page(visits):
    """Also after the theme has changed: each has the same colours again."""
    visit = visits("one")
    found = {}
    for scheme in ("light", "dark", "light"):
        visit.page.emulate_media(color_scheme=scheme)
        for _ in range(100):  # the page hears of it a little later
            colors = set(
                visit.page.evaluate(
                    "[...document.querySelectorAll('[data-figure]')].flatMap((figure) => figure"
                    "._fullData.filter((trace) => trace.meta !== 'behind').map((trace) =>"
                    " trace.line?.color)).filter((color) => color?.startsWith('#'))"
                )
            )
            if colors not in [known for other, known in found.items() if other != scheme]:
                break
            visit.page.wait_for_timeout(20)
        assert len(colors) > 3
        assert min(contrast(visit.page, color, "--page") for color in colors) >= 4.5
        assert found.setdefault(scheme, colors) == colors


def contrast(page: Any, first: str, second: str) -> float:
    """Return the contrast ratio of two colours, or names of the page's, as WCAG defines it."""

    def luminance(name: str) -> float:
        color = (
            name
            if name.startswith("#")
            else page.evaluate(
                f"getComputedStyle(document.documentElement).getPropertyValue('{name}').trim()"
            )
        )
        parts = [int(color[at : at + 2], 16) / 255.0 for at in (1, 3, 5)]
        linear = [
            part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
        ]
        return float(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])

    light, dark = sorted((luminance(first), luminance(second)), reverse=True)
    return (light + 0.05) / (dark + 0.05)
