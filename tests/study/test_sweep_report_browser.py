from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import pytest
from fabricated_sweep import sweep_run
from headless_chromium import BrowserPage, chromium_path

pytest.importorskip("plotly")

from cable_rpc.study.metrics import Bootstrap
from cable_rpc.study.sweep_report import write_sweep_report

HOSTILE = '<img src="x" onerror="window.broken=1"></script><script>window.broken=1</script>'
PLOT = "document.getElementById('plot-rate')"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserPage]:
    path = chromium_path()
    if path is None:
        pytest.skip("Chromium is not installed")
    with BrowserPage(path, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    run = sweep_run(tmp_path_factory.mktemp("run"), sequences=(HOSTILE, "drive-b", "drive-c"))
    run = replace(run, qualities=("retention", "f1"))
    return write_sweep_report(run, bootstrap=Bootstrap(draws=20), export=False).as_uri()


@pytest.mark.parametrize("width", [390, 1280])
def test_page_fits_and_complains_of_nothing(browser: BrowserPage, url: str, width: int) -> None:
    browser.open(url, width, 844)
    drawn = "[...document.querySelectorAll('.plot')].map(p => p.querySelectorAll('svg.main-svg').length > 0)"
    assert browser.evaluate(drawn) == [True] * 4
    assert browser.evaluate("document.documentElement.scrollWidth") == width
    outside = (
        "[...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll, pre') && "
        f"e.getBoundingClientRect().right > {width} + 0.5).map(e => e.outerHTML.slice(0, 80))"
    )
    assert browser.evaluate(outside) == []
    small = (
        "[...document.querySelectorAll('main button, main select, main summary')]"
        ".filter(e => e.offsetHeight && e.offsetHeight < 36).map(e => e.outerHTML.slice(0, 80))"
    )
    assert browser.evaluate(small) == []
    assert browser.evaluate("window.broken") is None
    assert browser.problems == []
    assert all(request.startswith(("file:", "data:")) for request in browser.requests)


@pytest.fixture(scope="module")
def page(browser: BrowserPage, url: str) -> BrowserPage:
    """The report, open in a wide window."""
    browser.open(url, 1280, 900)
    return browser


def test_clicks_change_the_plot(page: BrowserPage) -> None:
    title = f"{PLOT}.querySelector('.ytitle').textContent"
    assert page.evaluate(title) == "detections kept, %"
    first = page.evaluate(f"{PLOT}.querySelector('.js-line').getAttribute('d')")
    page.click("button[data-quality=f1]")
    assert page.evaluate(title) == "F1, %"
    assert page.evaluate(f"{PLOT}.querySelector('.js-line').getAttribute('d')") != first
    lines = f"{PLOT}.querySelectorAll('.js-line').length"
    assert page.evaluate(lines) == 3
    page.click("button[data-method^=motion]")
    assert page.evaluate(lines) == 2
    page.click("button[data-method^=motion]")
    assert page.evaluate(lines) == 3
    page.evaluate("(() => { const s = document.getElementById('sequence'); s.value = 'drive-c';"
                     " s.dispatchEvent(new Event('change')); })()")  # fmt: skip
    rates = page.evaluate(f"{PLOT}.data[1].x")
    assert rates[-1] == pytest.approx(0.6 * 2 * 40_000 * 80 / 1000, rel=1e-5)
    assert page.problems == []


def test_headings_sort_by_number_and_the_filter_hides_rows(page: BrowserPage) -> None:
    page.click("button[data-quality=retention]")
    table = "[data-for-quality=retention] table[data-group=methods]"
    order = f"[...document.querySelectorAll('{table} tbody tr')].map(r => r.cells[0].textContent.split(' ')[0])"
    assert page.evaluate(order) == ["full-frame", "cable", "motion-only"]
    head = f"{table} th:nth-child(2) button"
    assert page.evaluate(f"document.querySelector({json.dumps(head)}).textContent") == "BD-rate, %"
    page.click(head)
    assert page.evaluate(order) == ["cable", "motion-only", "full-frame"]
    page.click(head)
    assert page.evaluate(order) == ["motion-only", "cable", "full-frame"]
    page.click("[data-for-quality=retention] .filter")
    page.call("Input.insertText", text="BLUR")
    shown = f"[...document.querySelectorAll('{table} tbody tr')].filter(r => r.offsetHeight).length"
    assert page.evaluate(shown) == 1
    assert page.problems == []


def test_a_picture_is_enlarged_by_a_click(page: BrowserPage) -> None:
    page.resize(390, 844)
    assert page.evaluate("document.getElementById('large').open") is False
    page.click(".enlarge")
    assert page.evaluate("document.getElementById('large').open") is True
    assert page.evaluate("document.querySelector('#large img').naturalWidth") == 107
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.click("#large button")
    assert page.evaluate("document.getElementById('large').open") is False
