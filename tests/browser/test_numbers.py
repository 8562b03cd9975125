"""Numbers typed into boxes, in a real Chromium.

Tests app/ui/parameters.py, app/ui/widgets.py.
"""

import re

import pytest
from playwright.sync_api import Locator, expect

from app.server.keeping import SetClip
from app.server.protocol import SetParams
from tests.browser.conftest import Bench


@pytest.fixture(autouse=True)
def _fresh(bench: Bench) -> None:
    bench.engine.sent.clear()


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
