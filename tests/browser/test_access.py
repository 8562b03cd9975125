"""Accessibility: everything can be reached by keyboard and is readable. Also the cost of drawing the map.

Tests app/ui/appearance.py, in both themes.
"""

import pytest
from playwright.sync_api import Page, expect

from app.server.chunks import MOST_SHOWN
from app.server.protocol import StepFrame
from tests.browser.conftest import ALPHA, SLIDERS, Bench

TABS = ("Parameters", "Readouts", "Loops", "Study", "A/B", "Auto-tune", "View", "Recording", "Help")

CONTROLS = """() => [...document.querySelectorAll(
  'button,input,select,textarea,[role=slider],[role=tab],[data-hs][tabindex],summary,a[href]')].filter((one) => {
  const box = one.getBoundingClientRect(), style = getComputedStyle(one);
  return box.width > 0 && box.height > 0 && one.checkVisibility() && style.visibility !== 'hidden'
    && style.pointerEvents !== 'none'
    && !one.disabled && one.type !== 'hidden' && !one.closest('.mantine-Notification-root,[aria-hidden=true]')
    && !(one.tabIndex < 0 && one.closest('[role=tablist],.mantine-NumberInput-controls,[role=radiogroup]'))
    && !(one.tabIndex < 0 && one.parentElement.closest('button,label,[role=slider]'));
}).map((one, number) => { one.dataset.control = number; return one.outerHTML.slice(0, 160); })"""
"""What a mouse could click, numbered. Of a list of tabs one is reached, the others by arrows."""

HERE = """() => { const one = document.activeElement.closest('[data-control]');
  return one ? Number(one.dataset.control) : -1; }"""

CONTRASTS = """() => {
  const parse = (text) => { const n = text.match(/[\\d.]+/g).map(Number); return [n[0], n[1], n[2], n[3] ?? 1]; };
  const over = (top, below) => top.slice(0, 3).map((v, k) => v * top[3] + below[k] * (1 - top[3]));
  const light = (rgb) => rgb.map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const dark = document.documentElement.dataset.mantineColorScheme === 'dark';
  const behind = (one) => {
    const layers = [];
    for (let at = one; at; at = at.parentElement) {
      const colour = parse(getComputedStyle(at).backgroundColor);
      layers.push(colour);
      if (colour[3] === 1) break;
    }
    return layers.reverse().reduce((below, top) => over(top, below), dark ? [20, 20, 20] : [255, 255, 255]);
  };
  const found = [];
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const one = texts.currentNode.parentElement, text = texts.currentNode.textContent.trim();
    const left = 'script,style,[hidden],:disabled,[data-disabled],.mantine-Notification-root';
    if (!text || !one || one.closest(left)) continue;
    const box = one.getBoundingClientRect(), style = getComputedStyle(one);
    if (!box.width || !box.height || style.visibility === 'hidden') continue;
    let opacity = 1;
    for (let at = one; at; at = at.parentElement) opacity *= Number(getComputedStyle(at).opacity);
    if (opacity < 0.02) continue;
    const back = behind(one), colour = parse(style.color);
    const [a, b] = [light(over([...colour.slice(0, 3), colour[3] * opacity], back)), light(back)];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    if (ratio < (large ? 3 : 4.5)) found.push(`${ratio.toFixed(2)} ${text.slice(0, 40)} (${one.className})`);
  }
  return [...new Set(found)];
}"""
"""Texts whose contrast to what is behind them is less than WCAG 2 AA asks for."""

STILL = """() => document.getAnimations().every((one) => one.playState !== 'running'
  || one.effect.getComputedTiming().endTime === Infinity)"""
"""Whether all that fades or glides has come to its end."""

COUNTED = """() => {
  const canvas = document.querySelector('canvas[data-engine]');
  const gl = canvas.getContext('webgl2');
  const frame = () => { window.drawn = {calls: 0, points: 0}; requestAnimationFrame(frame); };
  for (const name of ['drawArrays', 'drawElements', 'drawArraysInstanced', 'drawElementsInstanced']) {
    const plain = gl[name].bind(gl);
    gl[name] = (mode, ...rest) => {
      window.drawn.calls += 1;
      if (mode === gl.POINTS) window.drawn.points += rest[1];
      if (!window.most || window.drawn.points >= window.most.points) window.most = {...window.drawn};
      return plain(mode, ...rest);
    };
  }
  frame();
}"""
"""Counts what each frame draws; `window.most` is the frame with the most points."""


@pytest.fixture(autouse=True, scope="module")
def _some_map(bench: Bench) -> None:
    bench.engine.send(StepFrame(60))
    bench.eventually(lambda: bench.page.locator(".hs-when").get_by_text("frame 59 of 0–399").count() == 1)


def open_tab(page: Page, name: str) -> None:
    """Until nothing moves or fades any more; what turns for ever may turn."""
    tab = page.get_by_role("tab", name=name, exact=True)
    tab.click()
    expect(tab).to_have_attribute("aria-selected", "true")
    page.wait_for_timeout(200)  # two frames
    page.wait_for_function(STILL)


@pytest.mark.parametrize("name", TABS)
def test_every_control_is_reached_by_the_tab_key(bench: Bench, name: str) -> None:
    page = bench.page
    open_tab(page, name)
    controls = page.evaluate(CONTROLS)
    page.evaluate("document.activeElement.blur()")
    reached: set[int] = set()
    for _ in range(3 * len(controls) + 20):
        page.keyboard.press("Tab")
        reached.add(page.evaluate(HERE))
        if reached >= set(range(len(controls))):
            break
    missed = [html for number, html in enumerate(controls) if number not in reached]
    assert len(controls) > 10 and missed == []


@pytest.mark.parametrize("light", [False, True], ids=["dark", "light"])
def test_every_text_has_the_contrast_that_readers_need(bench: Bench, light: bool) -> None:
    page = bench.page
    open_tab(page, "View")
    page.get_by_text("light theme").click()
    page.get_by_role("button", name="Diagnostics").click()
    scheme = "light" if page.get_by_role("checkbox", name="light theme").is_checked() else "dark"
    if (scheme == "light") is not light:
        page.get_by_text("light theme").click()
    expect(page.locator("html")).to_have_attribute("data-mantine-color-scheme", "light" if light else "dark")
    pale = {}
    for name in TABS:
        open_tab(page, name)
        pale[name] = page.evaluate(CONTRASTS)
    assert {name: texts for name, texts in pale.items() if texts} == {}


def test_a_frame_draws_each_keyframe_once_and_no_more_points_than_the_page_holds(bench: Bench) -> None:
    page = bench.page
    open_tab(page, "View")
    page.evaluate(COUNTED)
    bench.engine.send(StepFrame(1))
    bench.eventually(lambda: bool(page.evaluate("window.most && window.most.points > 0")))
    drawn = bench.workbench._scene.chunks
    bench.eventually(lambda: page.evaluate("window.most.points") >= drawn.points)
    page.wait_for_timeout(300)  # three frames
    most = page.evaluate("window.most")
    result = bench.engine.snapshot.result
    keyframes = len(bench.engine.snapshot.chunks)
    assert drawn.points <= most["points"] <= drawn.points + len(result.cloud) + 10
    assert keyframes <= most["calls"] <= keyframes + 60, "the rest: scan, path, wedge, plane, grid, labels"
    assert keyframes <= MOST_SHOWN


def test_a_tooltip_in_a_narrow_window_stands_above_the_sheet(bench: Bench) -> None:
    page = bench.page
    page.set_viewport_size({"width": 560, "height": 800})
    tab, tip = page.get_by_role("tab", name="Parameters").first, page.locator(".mantine-Tooltip-tooltip")
    sheet = page.locator("[style*='max-height: 60%']").element_handle()

    def stands_above() -> bool:
        page.locator(SLIDERS).nth(ALPHA).hover()
        expect(tip).to_be_visible()
        bottom, top = "(tip) => tip.getBoundingClientRect().bottom", "(sheet) => sheet.getBoundingClientRect().top"
        return float(tip.evaluate(bottom)) < sheet.evaluate(top) < before

    before = 800.0
    tab.click()
    bench.eventually(stands_above)
    before = sheet.evaluate("(sheet) => sheet.getBoundingClientRect().top")
    page.get_by_role("button", name="Diagnostics").click()
    bench.eventually(stands_above)
    page.get_by_role("button", name="Diagnostics").click()
    expect(tip).to_have_count(0)
    page.set_viewport_size({"width": 1000, "height": 620})
