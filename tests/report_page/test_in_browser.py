"""The page in headless Chromium: it loads from a file, and does what a reader does."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

SIZES = ((1600, 1000), (1024, 768), (400, 800))


@pytest.fixture
def shown(browser: Any, report: Path) -> Iterator[Any]:
    """The page, just opened; at the end it must not have complained or connected."""
    browser.open(report)
    yield browser
    assert browser.faults() == []
    assert browser.requests() == []


def place_of(browser: Any, expression: str) -> tuple[float, float]:
    """Where a place of the map is in the window; ``expression`` gives its pixel of the canvas."""
    x, y = browser.run(
        "(() => { const map = byId('map'); const box = map.getBoundingClientRect();"
        f" const [x, y] = {expression};"
        " return [box.left + map.clientLeft + x, box.top + map.clientTop + y]; })()"
    )
    return float(x), float(y)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_it_fits_the_window(
    browser: Any, report: Path, width: int, height: int, dark: bool
) -> None:
    browser.open(report, width=width, height=height, dark=dark)
    assert browser.run("document.documentElement.scrollWidth") == width
    assert browser.run("isDark()") is dark
    assert browser.faults() == []
    assert browser.requests() == []
    # something is drawn: the pixels are not all the same
    colours = browser.run(
        "(() => { const c = byId('map'); const d = c.getContext('2d').getImageData(0, 0, c.width,"
        " c.height).data; const s = new Set(); for (let k = 0; k < d.length; k += 4)"
        " s.add(d[k] << 16 | d[k + 1] << 8 | d[k + 2]); return s.size; })()"
    )
    assert colours > 10


def test_hostile_names_are_texts(shown: Any) -> None:
    names = shown.run("data.sessions.map((s) => s.name)")
    assert "<img src=x onerror=alert(1)>&\"' {{data}}" in names
    assert shown.run("document.querySelectorAll('img[src=x], b > i').length") == 0
    assert shown.run("byId('session-table').textContent.includes('onerror=alert(1)')")
    assert shown.run("byId('session-table').textContent.includes('<i>no fix</i>')")


def test_a_closure_is_clicked_on_the_map(shown: Any) -> None:
    shown.run("select('closure', 7)")  # brings it into view
    shown.run("select(null)")
    find = "(() => { const [x, y] = VIEW.ends(data.closures, 7); return VIEW.pixel(x, y); })()"
    x, y = place_of(shown, find)
    shown.move(x, y)
    assert "probability" in shown.run("byId('tip').textContent")
    shown.click(x, y)
    assert shown.run("state.selected.kind") == "closure"
    text = shown.run("byId('details').textContent")
    for part in ("Closure 8", "aligned voxels", "structure", "support / conflict", "before"):
        assert part in text
    assert shown.run("byId('announce').textContent").startswith("Closure 8")
    assert shown.run("document.querySelectorAll('#closure-table tr.selected').length") == 1
    assert shown.run("byId('details').querySelector('svg').getAttribute('aria-label')")


def test_a_place_without_closure_gives_its_reason(shown: Any) -> None:
    shown.run("select('rejected', 0)")
    shown.run("select(null); change({layers: {...state.layers, closures: false}})")
    find = "(() => { const [x, y] = VIEW.ends(data.rejected, 0); return VIEW.pixel(x, y); })()"
    shown.click(*place_of(shown, find))
    assert shown.run("state.selected.kind") == "rejected"
    assert "below 0.99" in shown.run("byId('details').textContent")


def test_wheel_and_drag_move_the_map(shown: Any) -> None:
    x, y = place_of(shown, "[300, 200]")
    before = shown.run("[VIEW.scale, ...VIEW.place(300, 200)]")
    shown.wheel(x, y, -300)
    shown.wait_for(f"VIEW.scale > {before[0]} * 1.2")
    after = shown.run("[VIEW.scale, ...VIEW.place(300, 200)]")
    assert after[1:] == pytest.approx(before[1:], abs=1e-6)  # the place below the pointer stays
    shown.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    shown.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left")
    shown.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + 50, y=y, button="left")
    shown.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + 50, y=y, button="left")
    assert shown.run("VIEW.place(350, 200)[0]") == pytest.approx(after[1], abs=1e-6)
    assert shown.run("state.selected") is None


def test_two_fingers_zoom(shown: Any) -> None:
    x, y = place_of(shown, "[400, 300]")
    before = shown.run("VIEW.scale")

    def touch(kind: str, *points: tuple[float, float]) -> None:
        touched = [{"x": px, "y": py, "id": k} for k, (px, py) in enumerate(points)]
        shown.call("Input.dispatchTouchEvent", type=kind, touchPoints=touched)

    touch("touchStart", (x - 50, y), (x + 50, y))
    touch("touchMove", (x - 100, y), (x + 100, y))
    touch("touchEnd")
    shown.wait_for(f"VIEW.scale > {before} * 1.8")
    assert shown.run("VIEW.scale") == pytest.approx(2 * before, rel=0.05)


def test_keys_work_on_the_map(shown: Any) -> None:
    shown.run("byId('map').focus()")
    scale, x = shown.run("[VIEW.scale, VIEW.x]")
    shown.press("+")
    assert shown.run("VIEW.scale") > scale
    shown.press("ArrowRight")
    assert shown.run("VIEW.x") > x
    shown.press("n")
    shown.press("n")
    shown.press("p")
    assert shown.run("state.selected.index") == shown.run("state.shown[0]")
    shown.press("Enter")
    assert shown.run("document.activeElement.id") == "details"
    shown.run("byId('map').focus()")
    shown.press("Escape")
    assert shown.run("state.selected") is None
    shown.press("0")
    assert shown.run("VIEW.scale") == pytest.approx(scale)


def test_everything_can_be_reached_by_tab(shown: Any) -> None:
    reached = set()
    for _ in range(60):
        shown.press("Tab")
        tag, name = shown.run("[document.activeElement.tagName, document.activeElement.id]")
        reached.add(name or tag)
    assert {"map", "theme", "SELECT", "INPUT", "BUTTON", "A"} <= reached
    unnamed = shown.run(
        "[...document.querySelectorAll('button, select, input')].filter((n) =>"
        " !n.textContent.trim() && !n.getAttribute('aria-label') && !n.labels.length).length"
    )
    assert unnamed == 0


def test_filters_leave_what_they_name(shown: Any) -> None:
    names = shown.run("data.sessions.map((s) => s.name)")
    number = names.index("wednesday")
    shown.run(
        f"(() => {{ const s = document.querySelector('[data-key=query]'); s.value = {number};"
        " s.dispatchEvent(new Event('change')); })()"
    )
    assert shown.run(f"state.shown.every((k) => data.closures.sessions[2 * k] === {number})")
    assert 0 < shown.run("state.shown.length") < 30
    assert shown.run("byId('count').textContent").endswith("of 30 closures")
    shown.run(
        "(() => { const s = document.querySelector('[data-key=low]'); s.value = 60;"
        " s.dispatchEvent(new Event('input')); })()"
    )
    assert shown.run("state.shown.every((k) => data.closures.probability[k] >= state.low)")
    shown.run("resetFilters()")
    assert shown.run("state.shown.length") == 30
    day = shown.run("dayText(data.sessions[3])")
    shown.run(f"change({{from: '{day}'}})")
    assert shown.run("new Set(state.shown.map((k) => data.closures.sessions[2 * k])).size") == 1


def test_a_cell_of_the_matrix_shows_its_closures(shown: Any) -> None:
    shown.run("document.querySelector('#matrix-table td:not(.none)').click()")
    assert shown.run("state.selected.kind") == "closure"
    pairs = shown.run("new Set(state.shown.map((k) => data.closures.sessions[2 * k + 1])).size")
    assert pairs == 1
    shown.run("document.querySelector('#matrix-table td').focus()")
    shown.press("ArrowDown")
    assert shown.run("document.activeElement.dataset.cell") == "4"
    rejected = shown.run("document.querySelectorAll('#matrix-table td.none:not(.empty)').length")
    assert rejected > 0


def test_a_pair_that_was_not_searched_has_a_cross_and_its_reason(shown: Any) -> None:
    shown.run("data.excluded = {'0 3': 'the poses of tuesday do not fit'}")
    shown.run("buildMatrix()")
    cell = "document.querySelector('[data-cell=\"3\"]')"  # the other way has a hypothesis
    assert shown.run(f"{cell}.textContent") == "×"
    title = shown.run(f"{cell}.title")
    assert title.endswith("not searched; the poses of tuesday do not fit")


def test_the_list_is_sorted_and_turned(shown: Any) -> None:
    column = "[...document.querySelectorAll('#closure-table tbody tr')].map((r) => r.cells[9]"
    shown.run("document.querySelector('[aria-label=\"Sort by overlap\"]').click()")
    values = shown.run(f"{column}.textContent)")
    assert len(values) == 25
    assert values == sorted(values)
    shown.run("document.querySelectorAll('.pages button')[1].click()")
    assert len(shown.run(f"{column}.textContent)")) == 5


def test_the_button_changes_the_theme(shown: Any) -> None:
    before = shown.run("getComputedStyle(document.body).backgroundColor")
    shown.run("byId('theme').click()")
    assert shown.run("getComputedStyle(document.body).backgroundColor") != before
    assert shown.run("isDark()")


CONTRAST = """
(() => {
  const light = (name) => {
    const probe = document.body.appendChild(document.createElement("i"));
    probe.style.color = `var(${name})`;
    const rgb = getComputedStyle(probe).color.match(/[\\d.]+/g).slice(0, 3).map((x) => x / 255);
    probe.remove();
    const linear = rgb.map((x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const ratio = (a, b) => {
    const [x, y] = [light(a), light(b)].sort((m, n) => n - m);
    return (x + 0.05) / (y + 0.05);
  };
  const texts = ["--ink", "--soft", "--accent", "--warn", "--mark"];
  return Math.min(...texts.flatMap((t) => ["--page", "--panel"].map((g) => ratio(t, g))));
})()
"""


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_letters_stand_out(browser: Any, report: Path, dark: bool) -> None:
    """WCAG 2.2, level AA: at least 4.5 to 1."""
    browser.open(report, dark=dark)
    assert browser.run(CONTRAST) >= 4.5
