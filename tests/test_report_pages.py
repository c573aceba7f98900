"""The built report in a real browser, from file://: `make test-report`."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from reproduce.report.site import REPLAYS
from reproduce.storage.paths import RESULTS

pytestmark = [pytest.mark.browser, pytest.mark.timeout(1200)]

REPORT = RESULTS / "report"
WIDTHS = (400, 1400)  # px, a telephone and a desk
LARGEST = 5_000_000  # bytes of a replay
OWN = [page for page in sorted(REPORT.rglob("*.html")) if page.parent.name != REPLAYS]
TALLEST = 6_000  # px at the desk's width, of the first page, the tour, and replays; documents may be longer
PICTURES = RESULTS / "scratch" / "screenshots"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("needs a Chromium (Debian: apt-get install chromium)")
    arguments = ["--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update"]
    arguments += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # WebGL without a GPU
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=path, args=arguments)
        yield browser
        browser.close()


def open_page(browser: Browser, page: Path, width: int) -> tuple[Page, list[str]]:
    """A page, and everything that went wrong while it loaded."""
    faults: list[str] = []
    tab = browser.new_page(viewport={"width": width, "height": 900})
    tab.on("console", lambda m: faults.append(f"console: {m.text}") if m.type == "error" else None)
    tab.on("pageerror", lambda error: faults.append(f"error: {error}"))
    tab.on("requestfailed", lambda r: faults.append(f"failed: {r.url[:200]}"))
    tab.on("request", lambda r: None if urlparse(r.url).scheme in LOCAL else faults.append(f"network: {r.url[:200]}"))
    tab.goto(page.as_uri())
    tab.wait_for_load_state("load")
    return tab, faults


LOCAL = ("file", "data", "blob")


def test_there_is_a_report() -> None:
    assert (REPORT / "index.html").is_file() and len(OWN) > 6, "run `reproduce notebooks` or `make reproduce` first"


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("page", OWN, ids=lambda page: str(page.relative_to(REPORT)))
def test_a_page_opens_without_a_fault_and_can_be_read(browser: Browser, page: Path, width: int) -> None:
    tab, faults = open_page(browser, page, width)
    tab.evaluate("document.querySelectorAll('img[loading=lazy]').forEach(i => i.loading = 'eager')")
    tab.wait_for_timeout(200)
    PICTURES.mkdir(parents=True, exist_ok=True)
    tab.screenshot(path=str(PICTURES / f"{page.stem}_{width}.png"))
    assert faults == []
    broken = tab.evaluate("[...document.images].filter(i => !i.complete || !i.naturalWidth).map(i => i.alt || i.src)")
    assert broken == []
    assert tab.evaluate("[...document.images].filter(i => !i.alt.trim()).length") == 0
    assert tab.evaluate("document.documentElement.scrollWidth") <= width + 1, "must not scroll sideways"
    assert tab.evaluate("document.querySelectorAll('details.code[open]').length") == 0, "code is folded away"
    text = tab.evaluate("document.querySelector('article').innerText")
    assert "@@" not in text and not re.search(r"\$\$|\\frac|\\sum", text)
    formulas = tab.evaluate("[...document.querySelectorAll('article math')].map(m => m.getBoundingClientRect().height)")
    assert all(height > 5 for height in formulas)
    tab.close()


@pytest.mark.parametrize("page", OWN, ids=lambda page: str(page.relative_to(REPORT)))
def test_links_lead_somewhere(browser: Browser, page: Path) -> None:
    tab, _ = open_page(browser, page, WIDTHS[1])
    for link in tab.evaluate("[...document.querySelectorAll('a[href]')].map(a => a.href)"):
        parts = urlparse(link)
        if parts.scheme != "file":
            assert parts.scheme in ("http", "https", "mailto", "javascript"), link
            continue
        target = Path(unquote(parts.path))
        assert target.is_file(), f"{page.name}: {link}"
        if parts.fragment and target.suffix == ".html":
            ids = re.findall(r'\bid="([^"]+)"', target.read_text(encoding="utf-8"))
            assert unquote(parts.fragment) in {*ids, "__top"}, f"{page.name}: {link}"
    tab.close()


@pytest.mark.parametrize("page", [page for page in OWN if page.parent == REPORT], ids=lambda page: str(page.name))
def test_a_page_is_not_too_tall(browser: Browser, page: Path) -> None:
    tab, _ = open_page(browser, page, WIDTHS[1])
    tab.evaluate("document.querySelectorAll('img[loading=lazy]').forEach(i => i.loading = 'eager')")
    tab.wait_for_timeout(200)
    assert tab.evaluate("document.documentElement.scrollHeight") <= TALLEST
    tab.close()


def test_the_answer_is_seen_without_scrolling(browser: Browser) -> None:
    tab, _ = open_page(browser, REPORT / "index.html", WIDTHS[1])
    below = tab.evaluate("document.querySelector('article figure img').getBoundingClientRect().bottom")
    assert below <= 2 * 900, "answer and figure stand on the first two screens"
    tab.close()


def test_mathematics_is_drawn(browser: Browser) -> None:
    page = next(page for page in OWN if page.name.startswith("02_"))
    tab, _ = open_page(browser, page, WIDTHS[1])
    assert tab.evaluate("document.querySelectorAll('math').length") >= 5
    assert tab.evaluate("document.querySelectorAll('math mfrac').length") >= 1
    tab.close()


def test_light_and_dark(browser: Browser) -> None:
    tab, _ = open_page(browser, REPORT / "index.html", WIDTHS[1])
    seen = {}
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        tab.reload()
        colour = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        seen[scheme] = sum(int(number) for number in re.findall(r"\d+", colour)[:3])
        tab.screenshot(path=str(PICTURES / f"first_page_{scheme}.png"))
    assert seen["light"] > 600 > 300 > seen["dark"], seen
    tab.close()


def test_replays_are_small_and_one_moves(browser: Browser) -> None:
    replays = sorted((REPORT / REPLAYS).glob("*.html"))
    assert len(replays) >= 20, "a replay of each posture"
    assert max(page.stat().st_size for page in replays) < LARGEST
    tab, faults = open_page(browser, replays[0], 800)
    tab.wait_for_timeout(4000)
    shots = []
    for number in range(2):
        shots.append(tab.screenshot(path=str(PICTURES / f"replay{number}.png"), timeout=120_000))
        tab.wait_for_timeout(1500)
    assert faults == []
    assert shots[0] != shots[1], "nothing moved"
    tab.close()


def test_search_works_on_pages_opened_from_files(browser: Browser) -> None:
    tab, faults = open_page(browser, REPORT / "index.html", WIDTHS[1])
    tab.fill("input[name=query]", "potential field")
    tab.wait_for_selector(".md-search-result__link", timeout=30_000)
    hits = tab.evaluate("[...document.querySelectorAll('.md-search-result__link')].map(a => a.href)")
    assert faults == [] and any("02_reward_design" in hit for hit in hits)
    tab.close()
