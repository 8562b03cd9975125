"""Keys of the page in a real Chromium: held keys, keys pressed while a dialog is open, and typing into fields.

Then the messages of the page's own script to the server, and numbers typed into boxes.

Tests app/ui/viser_adapter.py, app/ui/parameters.py, app/ui/widgets.py.
"""

import re

import pytest
from playwright.sync_api import Locator, expect

from app.server.keeping import AddNote, SetClip
from app.server.protocol import Pause, Play, Save, SetParams, SetSpeed, StepFrame
from tests.browser.conftest import ALPHA, SLIDERS, Bench


@pytest.fixture(autouse=True)
def _fresh(bench: Bench) -> None:
    """Words of the test before may still wait: they are sent once nothing has changed in the page for 60 ms."""
    bench.page.evaluate("new Promise((done) => setTimeout(done, 500))")
    bench.engine.sent.clear()


def test_space_plays_and_pauses(bench: Bench) -> None:
    bench.page.keyboard.press("Space")
    bench.eventually(lambda: bench.engine.snapshot.transport.playing)
    bench.page.keyboard.press("Space")
    bench.eventually(lambda: not bench.engine.snapshot.transport.playing)
    assert [type(command) for command in bench.engine.sent] == [Play, Pause]


def test_space_after_a_click_on_a_button_does_not_click_it_again(bench: Bench) -> None:
    bench.page.get_by_role("button", name="Step", exact=True).click()
    bench.eventually(lambda: bench.engine.sent == [StepFrame()])
    bench.page.wait_for_function("document.activeElement === document.body")  # no ring stays
    bench.page.keyboard.press("Space")
    bench.eventually(lambda: bench.engine.snapshot.transport.playing)
    bench.page.keyboard.press("Space")
    bench.eventually(lambda: not bench.engine.snapshot.transport.playing)
    assert bench.engine.sent.count(StepFrame()) == 1


def test_a_key_that_is_held_counts_once_but_an_arrow_goes_on(bench: Bench) -> None:
    keyboard = bench.page.keyboard
    for _ in range(4):
        keyboard.down("Space")  # the browser repeats it
    keyboard.up("Space")
    bench.page.wait_for_timeout(500)
    assert [type(command) for command in bench.engine.sent] == [Play]
    bench.press("Space", lambda: not bench.engine.snapshot.transport.playing)
    bench.engine.sent.clear()
    for _ in range(4):
        keyboard.down("ArrowRight")
        bench.page.wait_for_timeout(200)
    keyboard.up("ArrowRight")
    bench.eventually(lambda: bench.engine.sent.count(StepFrame()) > 1)


def test_a_folder_is_reached_by_tab_and_opened_by_enter(bench: Bench) -> None:
    page = bench.page
    page.get_by_role("tab", name="Parameters").click()
    head = page.get_by_role("button", name="Reading the recording")
    expect(head).to_have_attribute("aria-expanded", "false")
    page.get_by_role("button", name="nothing changed").first.focus()
    page.keyboard.press("Tab")
    expect(head).to_be_focused()
    expect(head).to_have_css("outline-style", "solid")
    page.keyboard.press("Enter")
    expect(head).to_have_attribute("aria-expanded", "true")
    page.keyboard.press("Enter")
    expect(head).to_have_attribute("aria-expanded", "false")


def test_behind_a_dialog_keys_do_nothing(bench: Bench) -> None:
    bench.page.get_by_role("tab", name="Parameters").click()
    bench.page.get_by_role("button", name="Load YAML").click()
    cancel = bench.page.get_by_role("button", name="Cancel")
    expect(cancel).to_be_visible()
    colours = bench.workbench._appearance.view.colour_by
    for key in ("Space", "ArrowRight", "c"):
        cancel.focus()
        bench.page.keyboard.press(key)
    bench.page.wait_for_timeout(500)
    assert not bench.engine.sent and bench.workbench._appearance.view.colour_by == colours
    bench.page.keyboard.press("Escape")
    expect(cancel).to_have_count(0)
    bench.press("ArrowRight", lambda: StepFrame() in bench.engine.sent)


def test_a_click_right_after_typing_takes_all_that_was_typed(bench: Bench) -> None:
    page = bench.page
    page.get_by_role("tab", name="Recording").click()
    button = page.get_by_role("button", name="Add note")
    button.scroll_into_view_if_needed()
    button.locator("xpath=preceding::input[1]").click()
    box = button.bounding_box()
    assert box is not None
    page.keyboard.type("cracked wall")
    page.mouse.click(box["x"] + 20, box["y"] + 10)
    assert bench.within(20.0, lambda: bench.engine.sent == [AddNote("cracked wall")])
    page.get_by_role("tab", name="Parameters").click()


def test_a_click_on_a_busy_page_takes_all_that_was_typed(bench: Bench) -> None:
    page = bench.page
    page.get_by_role("tab", name="Recording").click()
    button = page.get_by_role("button", name="Add note")
    bench.engine.sent.clear()
    button.evaluate(
        """async (button) => {
          const boxes = [...document.querySelectorAll('input')];
          const box = boxes.findLast((one) => one.compareDocumentPosition(button) & Node.DOCUMENT_POSITION_FOLLOWING);
          const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
          const busy = (ms) => { for (const end = performance.now() + ms; performance.now() < end;); };
          for (const text of ['d', 'damp', 'damp wall']) {
            set.call(box, text);
            box.dispatchEvent(new Event('input', {bubbles: true}));
            await null;
          }
          busy(100); // viser's timer is late
          button.click();
        }"""
    )
    assert bench.within(20.0, lambda: bench.engine.sent == [AddNote("damp wall")])
    page.get_by_role("tab", name="Parameters").click()


def test_enter_in_a_dialog_does_what_its_button_says_with_all_that_was_typed(bench: Bench) -> None:
    page = bench.page
    bench.next_frame()
    page.get_by_role("tab", name="Recording").click()
    page.get_by_role("button", name="Save results").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("textbox").first.click(click_count=3)
    page.keyboard.type("north wing")
    page.keyboard.press("Enter")
    expect(dialog).to_have_count(0, timeout=20_000)
    (save,) = (command for command in bench.engine.sent if isinstance(command, Save))
    assert save.folder.name == "north wing"
    page.get_by_role("tab", name="Parameters").click()


def test_what_is_asked_for_in_the_same_moment_all_arrives(bench: Bench) -> None:
    bench.engine.sent.clear()
    bench.page.evaluate(
        """[['camera', 'cover 66'], ['transport', 'speed 2×'], ['transport', 'step 1'], ['camera', 'cover 70']].forEach(
          ([name, word]) => hemislamTell(name, word))"""
    )
    bench.eventually(lambda: StepFrame(1) in bench.engine.sent)
    assert SetSpeed(2.0) in bench.engine.sent


def test_a_word_of_the_page_does_not_take_the_place_of_what_a_slider_was_set_to(bench: Bench) -> None:
    """viser sends only the last of what changes within 50 ms, of all controls of a tab together."""
    said, alpha = bench.workbench._parameters._bridge._field, bench.engine.snapshot.params.ground.alpha
    before = said.value
    bench.page.get_by_role("tab", name="Parameters").click()
    slider = bench.page.locator(SLIDERS).nth(ALPHA)
    slider.evaluate(
        """async (thumb) => {
          const busy = (ms) => { for (const end = performance.now() + ms; performance.now() < end;); };
          for (let n = 0; n < 3; n++) {
            thumb.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}));
            await null; // the slider is drawn, but no timer fires
          }
          busy(100); // viser's timer and ours are both late
          hemislamTell('sliders', 'released');
          busy(200);
        }"""
    )
    bench.eventually(lambda: said.value != before)

    def agree() -> bool:
        """The slider may be set back for a moment, by what the engine says of the first step."""
        shown = float(slider.get_attribute("aria-valuenow") or "nan")
        return bench.engine.snapshot.params.ground.alpha == shown

    bench.eventually(agree, seconds=20.0)
    assert bench.engine.snapshot.params.ground.alpha > alpha


def boxes(bench: Bench, label: str) -> Locator:
    """The number boxes beside a label that begins so."""
    row = bench.page.locator(".mantine-Flex-root", has=bench.page.locator("label", has_text=re.compile(f"^{label}")))
    return row.locator("input.mantine-NumberInput-input")


def type_over(bench: Bench, box: Locator, text: str) -> None:
    box.click()
    bench.page.keyboard.press("Control+a")
    bench.page.keyboard.type(text, delay=40)


def set_params(bench: Bench) -> list[dict[str, object]]:
    return [command.values for command in bench.engine.sent if isinstance(command, SetParams)]


def test_a_number_is_taken_whole_on_enter_whatever_the_engine_sends_meanwhile(bench: Bench) -> None:
    alpha = boxes(bench, "α")
    type_over(bench, alpha, "25")
    bench.next_frame()
    bench.page.keyboard.type(".7")
    bench.next_frame()
    assert set_params(bench) == []
    bench.page.keyboard.press("Enter")
    bench.eventually(lambda: set_params(bench) == [{"ground.alpha": 25.7}])
    expect(alpha).to_have_value("25.7")


def test_a_number_is_taken_when_its_box_is_left_with_all_its_digits(bench: Bench) -> None:
    sigma = boxes(bench, "σ")
    type_over(bench, sigma, "0.0255")
    bench.page.keyboard.press("Tab")
    bench.eventually(lambda: set_params(bench) == [{"ground.sigma": 0.0255}])
    bench.page.get_by_text("Sensor", exact=True).click()
    for names, values in (
        (("translation x", "translation y", "translation z"), (0.0175, 0.0276, -0.1083)),
        (("roll", "pitch", "yaw"), (1.2345, -0.5, 90.0)),
    ):
        for name, value in zip(names, values, strict=True):
            type_over(bench, boxes(bench, name), str(value))
            bench.page.keyboard.press("Tab")
        bench.eventually(lambda values=values: values in set_params(bench)[-1].values())
        bench.next_frame()  # what the page shows of it comes after its answer to the numbers
        assert [float(boxes(bench, name).input_value()) for name in names] == list(values)
    bench.page.get_by_text("Sensor", exact=True).click()


def test_escape_restores_the_number_and_one_out_of_range_is_not_taken(bench: Bench) -> None:
    bench.engine.send(SetParams({"ground.alpha": 40.0}))
    bench.engine.sent.clear()
    alpha = boxes(bench, "α")
    expect(alpha).to_have_value("40")
    type_over(bench, alpha, "12")
    bench.page.keyboard.press("Escape")
    expect(alpha).to_have_value("40")
    type_over(bench, alpha, "257")
    bench.page.keyboard.press("Enter")
    assert alpha.evaluate("(box) => box.validationMessage") == "1 to 90"
    bench.page.keyboard.press("Tab")
    expect(alpha).to_have_value("40")
    bench.next_frame()
    assert set_params(bench) == []


def test_a_slider_over_decades_shows_its_number_in_the_box_above_alone(bench: Bench) -> None:
    bench.page.get_by_text("IMU", exact=True).click()
    unnamed = bench.page.locator(".mantine-Flex-root", has=bench.page.locator("> div > * > label:empty"))
    row = unnamed.filter(visible=True).first
    slider, own_box = row.locator("[role=slider]"), row.locator("input.mantine-NumberInput-input")
    expect(slider).to_be_visible()
    expect(own_box).to_be_hidden()
    slider.focus()
    bench.page.keyboard.press("End")
    expect(boxes(bench, "gyro noise")).to_have_value("1")
    bench.eventually(lambda: set_params(bench)[-1:] == [{"imu.gyro_noise": 1.0}])
    bench.page.get_by_text("IMU", exact=True).click()


def test_a_box_without_a_slider_takes_no_number_beyond_its_limits(bench: Bench) -> None:
    bench.page.get_by_role("tab", name="View").click()
    bench.page.get_by_text("Clip and section", exact=True).click()
    slab = boxes(bench, "slab")
    for typed, taken in (("-1", "0.05"), ("-2", "0.05"), ("250", "100"), ("0.5", "0.5")):
        type_over(bench, slab, typed)
        bench.page.keyboard.press("Enter")
        expect(slab).to_have_value(taken)
        bench.eventually(lambda taken=taken: bench.engine.snapshot.clip.slab == float(taken))
    assert {c.changes["slab"] for c in bench.engine.sent if isinstance(c, SetClip)} == {0.05, 100.0, 0.5}
