"""The page in a real Chromium."""

from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from app.export.box import Box
from app.mapping.kept import Note
from app.server.keeping import EditNote, KeepMeasure, SetClip
from app.server.protocol import CompareWith, OpenRecording, Seek, SetParams, SetSpeed, StepFrame
from app.ui.clip_maths import FACES, handle
from tests.browser.conftest import ALPHA, SLIDERS, Bench, new_page


@pytest.fixture(autouse=True)
def _fresh(bench: Bench) -> None:
    """Each test starts paused and with nothing sent."""
    bench.engine.sent.clear()


def seed_pixels(bench: Bench) -> int:
    """How much of the scene is amber, as seeds and their wedge are."""
    r, g, b = np.moveaxis(bench.pixels(), 2, 0)
    return int(((r > 180) & (g > 110) & (g < 210) & (b < 90)).sum())


def test_the_first_screen_says_what_it_is_and_what_to_do(bench: Bench) -> None:
    expect(bench.page.get_by_text("hall_bpearl.mcap")).to_be_visible()
    expect(bench.page.get_by_text("for one frame")).to_be_visible()
    bench.page.get_by_text("1 needs attention").evaluate("(chip) => chip.prepend('18 more checks passed, ')")
    expect(bench.page.get_by_text("paused", exact=True)).to_be_in_viewport(ratio=1)


def test_the_arrow_key_steps_a_frame_and_leaves_the_camera_alone(bench: Bench) -> None:
    bench.engine.send(StepFrame())  # the first frame is framed
    bench.look((-4.0, -4.0, 9.0), (0.3, 0.2, -0.6))
    (client,) = bench.server.get_clients().values()
    before = bench.resting_camera(client)
    bench.engine.sent.clear()
    for _ in range(3):
        bench.page.keyboard.press("ArrowRight", delay=120)
    bench.eventually(lambda: bench.engine.snapshot.transport.frame == 3)
    assert bench.engine.sent == [StepFrame()] * 3
    expect(bench.page.get_by_text("frame 3 of 0–399")).to_be_visible()
    bench.page.wait_for_timeout(300)
    assert np.allclose(client.camera.position, before, atol=1e-3)


def test_every_press_of_an_arrow_key_counts_while_the_page_is_busy(bench: Bench) -> None:
    press = "document.documentElement.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}));"
    bench.page.evaluate(press * 3)
    assert bench.within(60.0, lambda: bench.engine.sent == [StepFrame()] * 3)


def test_the_left_arrow_goes_a_frame_back_and_leaves_the_camera_alone(bench: Bench) -> None:
    bench.next_frame()
    bench.engine.sent.clear()
    (client,) = bench.server.get_clients().values()
    before, frame = bench.resting_camera(client), bench.engine.snapshot.transport.frame
    bench.page.keyboard.press("ArrowRight", delay=120)
    bench.page.keyboard.press("ArrowRight", delay=120)
    bench.page.keyboard.press("ArrowLeft", delay=120)
    bench.eventually(lambda: bench.engine.sent == [StepFrame(), StepFrame(), StepFrame(-1)])
    bench.eventually(lambda: bench.engine.snapshot.transport.frame == frame + 1)
    expect(bench.page.get_by_text(f"frame {frame + 1} of 0–399")).to_be_visible()
    bench.page.get_by_role("button", name="Step back").click()
    expect(bench.page.get_by_text(f"frame {frame} of 0–399")).to_be_visible()
    bench.page.wait_for_timeout(300)
    assert np.allclose(client.camera.position, before, atol=1e-3)
    bench.page.evaluate("document.activeElement.blur()")


def test_a_focused_slider_takes_the_arrow_for_itself_and_the_scene_is_relabelled(bench: Bench) -> None:
    bench.engine.send(StepFrame(4))
    bench.look((-4.0, -4.0, 9.0), (0.3, 0.2, -0.6))
    bench.engine.send(SetParams({"ground.alpha": 60.0, "ground.scan_lines": 16}))
    bench.engine.sent.clear()
    slider = bench.page.locator(SLIDERS).nth(ALPHA)
    expect(slider).to_have_attribute("aria-valuenow", "60")
    bench.eventually(lambda: seed_pixels(bench) > 80)
    many = seed_pixels(bench)
    slider.focus()
    bench.press("ArrowLeft", lambda: 50.0 < bench.engine.snapshot.params.ground.alpha < 60.0)
    bench.press("Home", lambda: bench.engine.snapshot.params.ground.alpha == 1.0)
    bench.eventually(lambda: seed_pixels(bench) < many / 2)
    assert not [command for command in bench.engine.sent if isinstance(command, StepFrame)]
    bench.engine.send(SetParams({"ground.alpha": 40.0, "ground.scan_lines": 8}))
    expect(slider).to_have_attribute("aria-valuenow", "40")


def test_a_double_click_on_delete_deletes_one_note(bench: Bench) -> None:
    """The list is drawn again between its two clicks, with the next note where the first one was."""
    notes = tuple(Note(1, f"remark {number}") for number in range(4))
    bench.engine.publish(notes=notes)
    bench.page.get_by_role("tab", name="Recording").click()
    button = bench.page.get_by_role("button", name="Delete note").first
    button.click()
    bench.eventually(lambda: bench.engine.sent == [EditNote(notes[3], "")], 8)
    bench.engine.publish(notes=notes[:3])
    expect(bench.page.get_by_role("button", name="Delete note")).to_have_count(3)
    button.evaluate("(next) => next.dispatchEvent(new MouseEvent('click', {bubbles: true, detail: 2}))")
    bench.page.wait_for_timeout(500)
    assert len(bench.engine.sent) == 1
    button.click()
    bench.eventually(lambda: bench.engine.sent[1:] == [EditNote(notes[2], "")])
    bench.engine.publish(notes=())
    bench.page.get_by_role("tab", name="Parameters").click()


def test_two_drags_of_a_slider_are_two_steps_of_undo(bench: Bench) -> None:
    """Each is over when the page has said that the slider was let go."""
    page, slider = bench.page, bench.page.locator(SLIDERS).nth(ALPHA)
    values, history = [bench.engine.snapshot.params.ground.alpha], bench.workbench._parameters._history
    for _ in range(2):
        box = slider.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 15, y, steps=3)
        page.mouse.up()
        bench.eventually(lambda: bench.engine.snapshot.params.ground.alpha > values[-1] + 1)
        bench.eventually(lambda: history._states[-1] == bench.engine.snapshot.params and history._changed_at < 0)
        values.append(bench.engine.snapshot.params.ground.alpha)
        bench.eventually(lambda: slider.get_attribute("aria-valuenow") == f"{values[-1]:g}")  # its thumb is there
    for value in (values[1], values[0]):
        page.get_by_role("button", name="Undo α seed angle").click()
        bench.eventually(lambda value=value: bench.engine.snapshot.params.ground.alpha == value)


def test_the_speed_is_chosen_from_a_list_by_mouse(bench: Bench) -> None:
    page = bench.page
    page.locator(".hs-speed summary").click()
    page.get_by_role("button", name="5×", exact=True).click()
    bench.eventually(lambda: bench.engine.sent[-1:] == [SetSpeed(5.0)])
    expect(page.locator(".hs-speed summary")).to_have_text("5×")
    expect(page.get_by_role("button", name="5×", exact=True)).to_be_hidden()


def test_dragging_the_time_slider_seeks(bench: Bench) -> None:
    def here() -> int:
        return int(bench.engine.snapshot.transport.frame)

    bench.engine.send(Seek(5))
    expect(bench.page.get_by_text("frame 5 of 0–399")).to_be_visible()
    slider = bench.page.get_by_role("slider", name="Frame")
    slider.focus()
    begin = here()
    bench.press("ArrowRight", lambda: here() > begin)
    there = here()
    bench.press("ArrowLeft", lambda: here() < there)
    bench.eventually(lambda: slider.get_attribute("aria-valuenow") == str(here()))
    assert all(isinstance(command, Seek) for command in bench.engine.sent)
    bench.page.evaluate("document.activeElement.blur()")


def test_the_bar_stays_and_works_while_the_panel_is_closed(bench: Bench) -> None:
    page, scene = bench.page, bench.page.locator("canvas[data-engine]")
    before = scene.bounding_box()
    page.get_by_role("button", name="Collapse panel area").click()
    expect(page.get_by_role("tab", name="Loops")).to_be_hidden()
    frame = bench.engine.snapshot.transport.frame
    page.get_by_role("button", name="Step", exact=True).click()
    expect(page.get_by_text(f"frame {frame + 1} of 0–399")).to_be_visible()
    expect(page.locator(".hs-legend").get_by_text("not ground")).to_be_visible()
    bench.eventually(lambda: (now := scene.bounding_box()) is not None and now["width"] == 1000)
    page.get_by_role("button", name="Panel").click()
    expect(page.get_by_role("tab", name="Loops")).to_be_visible()
    bench.eventually(lambda: scene.bounding_box() == before)


def test_the_bar_fits_its_window_and_the_map_the_room_above(bench: Bench) -> None:
    dock, framing = bench.page.locator("body > * > .hs-dock"), bench.workbench._scene.framing
    scene = bench.page.locator("canvas[data-engine]")
    for width in (1024, 780, 1000):
        before = scene.bounding_box()
        bench.page.set_viewport_size({"width": width, "height": 620})
        bench.eventually(lambda before=before: scene.bounding_box() != before)
        bench.page.wait_for_timeout(500)  # the bar follows the scene every 300 ms
        assert dock.evaluate("(dock) => dock.scrollWidth <= dock.clientWidth"), f"{width} px"
    folded = framing.pictures
    bench.page.get_by_role("button", name="Diagnostics").click()
    bench.eventually(lambda: framing.pictures != folded)
    (((_, before),), ((_, after),)) = folded, framing.pictures
    assert after.covered > before.covered
    bench.page.get_by_role("button", name="Diagnostics").click()
    bench.eventually(lambda: framing.pictures == folded)


def test_the_recording_s_findings_are_in_their_panel(bench: Bench) -> None:
    bench.page.get_by_role("button", name="1 needs attention").click()
    expect(bench.page.get_by_text("--set imu.max_gap=0.4")).to_be_visible()
    expect(bench.page.locator(".hs-findings details .hs-item").first).to_be_visible()
    bench.page.get_by_role("button", name="Settle it").click()
    bench.eventually(lambda: SetParams({"imu.max_gap": 0.4}) in bench.engine.sent)
    bench.page.get_by_role("tab", name="Parameters").click()


def test_parameters_can_be_had_as_yaml_and_given(bench: Bench) -> None:
    bench.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    bench.page.get_by_role("button", name="Copy as YAML").click()
    expect(bench.page.get_by_role("dialog").locator("textarea")).to_have_value(bench.engine.snapshot.params.to_yaml())
    expect(bench.page.get_by_text("Copied.")).to_be_visible()
    assert bench.page.evaluate("navigator.clipboard.readText()") == bench.engine.snapshot.params.to_yaml()
    bench.page.get_by_role("button", name="Close").click()
    expect(bench.page.get_by_role("dialog")).to_have_count(0)
    bench.page.get_by_role("button", name="Load YAML").click()
    bench.page.get_by_role("dialog").locator("textarea").fill("ground:\n  alpha: 33\n")
    bench.page.get_by_role("button", name="Apply").click()
    bench.eventually(lambda: bench.engine.snapshot.params.ground.alpha == 33.0)


def test_yaml_that_cannot_be_used_is_reported_in_the_dialog_which_keeps_it(bench: Bench) -> None:
    before = bench.engine.snapshot.params
    bench.page.get_by_role("button", name="Load YAML").click()
    bench.page.get_by_role("dialog").locator("textarea").fill("ground:\n  alhpa: 33\n")
    bench.page.get_by_role("button", name="Apply").click()
    dialog = bench.page.get_by_role("dialog")
    expect(dialog.get_by_text("alhpa").last).to_be_visible()
    expect(dialog.locator("textarea")).to_have_value("ground:\n  alhpa: 33\n")
    assert bench.engine.sent == [] and bench.engine.snapshot.params == before
    bench.page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)


def test_a_tooltip_covers_no_control(bench: Bench) -> None:
    page = bench.page
    page.locator(SLIDERS).nth(ALPHA).hover()
    tip = page.locator(".mantine-Tooltip-tooltip")
    expect(tip).to_be_visible()
    page.wait_for_timeout(500)
    box, scene = tip.bounding_box(), page.locator("canvas[data-engine]").bounding_box()
    assert box is not None and scene is not None
    assert scene["x"] <= box["x"] and box["x"] + box["width"] <= scene["x"] + scene["width"]
    page.mouse.move(scene["x"] + 50, scene["y"] + 50)
    expect(tip).to_have_count(0)


def test_a_button_says_on_hover_what_it_does(bench: Bench) -> None:
    """viser itself shows no hint for a button."""
    bench.page.get_by_role("tab", name="A/B").click()
    fork = bench.page.get_by_role("button", name="Fork here")
    expect(fork).to_have_attribute("title", "Continue from this frame with other parameters, side by side.")
    bench.workbench._compare._fork.hint = "It is another one now."
    expect(fork).to_have_attribute("title", "It is another one now.")
    bench.page.get_by_role("tab", name="Parameters").click()


def test_a_recording_is_chosen_from_the_allowed_folder(bench: Bench) -> None:
    bench.page.get_by_role("tab", name="Recording").click()
    bench.page.get_by_role("button", name="Open a recording").click()
    dialog = bench.page.get_by_role("dialog")
    expect(dialog.get_by_role("button", name="older")).to_be_visible()
    dialog.get_by_role("button", name="garage.mcap").click()
    bench.eventually(lambda: any(isinstance(command, OpenRecording) for command in bench.engine.sent))
    expect(bench.page.get_by_text("garage.mcap").first).to_be_visible()
    bench.page.get_by_role("tab", name="Parameters").click()


def test_a_trajectory_to_compare_with_is_chosen_from_the_allowed_folders(bench: Bench) -> None:
    bench.page.get_by_role("tab", name="Recording").click()
    bench.page.get_by_role("button", name="Compare with a trajectory").click()
    dialog = bench.page.get_by_role("dialog")
    expect(dialog.get_by_role("button", name="older")).to_be_visible()
    expect(dialog.get_by_role("button", name="garage.mcap")).to_have_count(0)
    dialog.get_by_role("button", name="other_slam.tum").click()
    bench.eventually(lambda: any(isinstance(command, CompareWith) for command in bench.engine.sent))
    (command,) = (command for command in bench.engine.sent if isinstance(command, CompareWith))
    assert command.path is not None and command.path.name == "other_slam.tum"
    expect(dialog).to_have_count(0)
    bench.page.get_by_role("tab", name="Parameters").click()


def test_a_reload_finds_everything_again(bench: Bench) -> None:
    bench.engine.send(StepFrame(9))
    bench.engine.send(SetParams({"ground.alpha": 37.0}))
    bench.page.reload()
    expect(bench.page.get_by_text("frame 8 of 0–399")).to_be_visible()
    expect(bench.page.locator(SLIDERS).nth(ALPHA)).to_have_attribute("aria-valuenow", "37")
    bench.eventually(lambda: bench.pixels().std() > 8)


def test_two_browsers_see_one_session_and_reach_out_to_nobody_else(bench: Bench, chromium: Browser) -> None:
    bench.engine.send(Seek(8))
    bench.engine.send(SetParams({"ground.alpha": 37.0}))
    other = new_page(chromium, 1000, 620)
    try:
        hosts: set[str] = set()
        other.on("request", lambda request: hosts.add(request.url.split("/")[2]) if "://" in request.url else None)
        other.goto(bench.url)
        theirs = other.locator(SLIDERS).nth(ALPHA)
        expect(theirs).to_have_attribute("aria-valuenow", "37")
        mine = bench.page.locator(SLIDERS).nth(ALPHA)
        theirs.focus()
        bench.press("ArrowRight", lambda: bench.engine.snapshot.params.ground.alpha > 37.0, other)
        alpha = f"{bench.engine.snapshot.params.ground.alpha:.0f}"
        expect(mine).to_have_attribute("aria-valuenow", alpha)
        bench.press("ArrowRight", lambda: bench.engine.snapshot.transport.frame > 8)
        frame = bench.engine.snapshot.transport.frame
        expect(other.get_by_text(f"frame {frame} of 0–399")).to_be_visible()
        bench.engine.send(Seek(12))
        expect(other.get_by_text("frame 12 of 0–399")).to_be_visible()
        other.wait_for_timeout(500)
        assert hosts <= {Path(bench.url).name, bench.url.split("/")[2]}
    finally:
        other.close()


def test_a_click_on_the_map_measures_the_point_under_it(bench: Bench) -> None:
    for _ in range(14):
        bench.engine.send(StepFrame())
    bench.page.get_by_role("tab", name="View").click()
    bench.look((0.0, -1e-3, 14.0), (0.0, 0.0, -1.0))
    bench.page.get_by_role("button", name="point", exact=True).click()
    expect(bench.page.get_by_text("Click 1 point of the map")).to_be_visible()
    scene = bench.page.locator("canvas[data-engine]").bounding_box()
    assert scene is not None
    bench.engine.sent.clear()

    def kept() -> list[KeepMeasure]:
        return [command for command in bench.engine.sent if isinstance(command, KeepMeasure)]

    for share in (0.5, 0.55, 0.45, 0.6, 0.4):  # the map has gaps
        if not kept():
            bench.page.mouse.click(scene["x"] + share * scene["width"], scene["y"] + share * scene["height"])
            bench.within(1.5, lambda: bool(kept()))
    (spot,) = kept()[0].measure.spots
    assert np.linalg.norm(spot.at[:2]) < 12.0 and -3.0 < spot.at[2] < 5.0
    bench.page.get_by_role("button", name="stop", exact=True).click()
    bench.page.get_by_role("tab", name="Parameters").click()


def test_on_a_phone_the_scene_has_most_of_the_page_until_a_tab_is_tapped(bench: Bench, chromium: Browser) -> None:
    page = new_page(chromium, 390, 844)
    page.goto(bench.url)
    tab = page.get_by_role("tab", name="Parameters").first
    expect(tab).to_be_visible()

    def scene_share() -> float:
        return float(
            page.evaluate("document.querySelector('canvas[data-engine]').getBoundingClientRect().height / 844")
        )

    bench.eventually(lambda: scene_share() > 0.6)
    tab.click()
    bench.eventually(lambda: scene_share() < 0.45)
    expect(page.get_by_text("M scan lines", exact=True)).to_be_in_viewport()
    page.get_by_role("button", name="Diagnostics").click()
    sheet = page.locator("[style*='max-height: 60%']").element_handle()
    above = "(dock, sheet) => sheet.getBoundingClientRect().bottom < dock.getBoundingClientRect().top + 1"
    bench.eventually(lambda: page.locator("body > * > .hs-dock").evaluate(above, sheet))
    page.get_by_role("button", name="Diagnostics").click()
    other = page.get_by_role("tab", name="Help").first
    other.dispatch_event("click")  # wherever the sheet has come down to by now
    expect(other).to_have_attribute("aria-selected", "true")
    page.wait_for_timeout(500)
    assert scene_share() < 0.45, "another tab keeps it up"
    other.click()
    bench.eventually(lambda: scene_share() > 0.6)
    page.close()


def test_a_side_of_the_clip_box_is_pulled_by_its_handle(bench: Bench) -> None:
    for _ in range(3):
        bench.engine.send(StepFrame())
    bench.page.get_by_role("tab", name="View").click()
    bench.look((6.0, -1e-3, 45.0), (6.0, 0.0, -1.0))
    bench.page.get_by_text("Clip and section").click()
    bench.page.get_by_label("clip box").check()
    bench.eventually(lambda: bench.engine.snapshot.clip.hiding is not None)
    before = Box.around((6.0, 0.0, 0.0), (10.0, 6.0, 4.0), 20.0)
    bench.engine.send(SetClip({"box": before, "on": True}))
    panel = bench.workbench._clip
    bench.eventually(lambda: len(panel._handles) == 7)
    bench.eventually(lambda: np.allclose(panel._handles[1].position, handle(before, *FACES[1])[1]))
    bench.next_frame()
    (client,) = bench.server.get_clients().values()
    scene = bench.page.locator("canvas[data-engine]").bounding_box()
    assert scene is not None
    R, place = handle(before, *FACES[1])
    picture = panel._page.in_picture(client, np.stack([place, place + R[:, 0]]))
    at = np.array([scene["x"], scene["y"]]) + picture * [scene["width"], scene["height"]]
    along = (at[1] - at[0]) / np.linalg.norm(at[1] - at[0])
    bench.page.mouse.move(*(at[0] + 40 * along))
    bench.page.wait_for_timeout(500)
    bench.page.mouse.down()
    for pixels in (45, 55, 75, 100):
        bench.page.mouse.move(*(at[0] + pixels * along))
        bench.page.wait_for_timeout(300)
    bench.page.mouse.up()
    bench.eventually(lambda: bench.engine.snapshot.clip.box != before)
    after = bench.engine.snapshot.clip.hiding
    assert after is not None and after.size[0] > before.size[0] + 0.5
    np.testing.assert_allclose([after.size[1], after.size[2], after.turn], [6.0, 4.0, 20.0], atol=1e-6)
    np.testing.assert_allclose(handle(after, *FACES[0])[1], handle(before, *FACES[0])[1], atol=1e-6)
    bench.engine.send(SetClip({"box": None, "on": False}))
    bench.page.get_by_role("tab", name="Parameters").click()
