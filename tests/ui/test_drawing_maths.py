"""The pure parts of the page: colours, thinning, ceilings and the shapes that explain a scan.

Tests app/export/ceilings.py, app/ui/colours.py, app/ui/geometry.py, app/ui/nodes.py, app/ui/sensor.py.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from app.export.ceilings import below_ceiling
from app.slam.types import GROUND, NON_GROUND
from app.ui.colours import HEIGHT, MODES, NOTHING, TABLES, Limits, grown, label_colours, value_colours
from app.ui.geometry import field_of_view, foot, ring_elevations, rotation_to, seed_wedge, wxyz
from app.ui.nodes import BLOCK, segments
from app.ui.sensor import MOST_SCAN_POINTS, shown_of

clouds = hnp.arrays(np.float32, st.tuples(st.integers(1, 200), st.just(3)), elements=st.floats(-50, 50, width=32))
units = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
units = units.map(lambda v: v / np.linalg.norm(v))


def lightness(rgb: np.ndarray) -> np.ndarray:
    """CIE L* of sRGB, written from the standard."""
    c = rgb / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > 0.008856, 116 * np.cbrt(y) - 16, 903.3 * y)


@pytest.mark.parametrize("name", sorted(TABLES.keys() - {"sides", "wheel"}))
def test_colour_maps_grow_evenly_lighter(name: str) -> None:
    steps = np.diff(lightness(TABLES[name][::8].astype(float)))
    assert (steps > 0).all()
    assert steps.max() < 4 * steps.mean()


def test_behind_and_in_front_differ_in_hue_and_grow_alike_from_grey() -> None:
    table = TABLES["sides"].astype(float)
    strength = np.ptp(table, axis=1)
    assert strength[127] < 15 and (np.diff(strength[:120:8]) < 0).all() and (np.diff(strength[136::8]) > 0).all()
    assert abs(strength[0] - strength[-1]) < 15
    assert (table[:110, 2] > table[:110, 0]).all() and (table[146:, 0] > table[146:, 2]).all()


@pytest.mark.parametrize("name", TABLES)
def test_the_darkest_colour_stands_out_from_the_dark_page(name: str) -> None:
    page = lightness(np.array([[20.0, 20.0, 20.0]]))[0]
    assert lightness(TABLES[name][:1].astype(float))[0] > page + 10


def test_labels_are_distinguished_in_black_and_white_too() -> None:
    colours = label_colours(np.array([0, 1, 2], np.uint8))
    grey = np.sort(lightness(colours.astype(float)))
    assert np.diff(grey).min() > 5
    assert np.abs(colours[:, None].astype(int) - colours[None].astype(int)).sum(-1)[~np.eye(3, dtype=bool)].min() > 90


def test_a_label_from_a_newer_version_is_drawn_as_not_ground() -> None:
    assert (label_colours(np.array([77], np.uint8)) == label_colours(np.array([NON_GROUND], np.uint8))).all()


@given(st.floats(-100, 100), st.floats(0.1, 100))
def test_values_beyond_the_limits_take_the_end_colours(low: float, span: float) -> None:
    table = TABLES["viridis"]
    colours = value_colours([low - 1000, low + span + 1000, np.nan], Limits(low, low + span), table)
    assert (colours[0] == table[0]).all() and (colours[1] == table[-1]).all()
    assert tuple(colours[2]) == NOTHING, "what has no number is grey"


@given(st.lists(hnp.arrays(np.float64, st.integers(1, 50), elements=st.floats(-300, 300)), min_size=1, max_size=6))
def test_limits_never_shrink_and_hold_nearly_everything(parts: list[np.ndarray]) -> None:
    limits = None
    for values in parts:
        wider = grown(limits, MODES[HEIGHT], values)
        assert wider is not None and wider.low < wider.high
        if limits is not None:
            assert wider.low <= limits.low and wider.high >= limits.high
        assert wider.low <= np.median(values) <= wider.high
        limits = wider


def test_limits_of_nothing_are_unknown() -> None:
    assert grown(None, MODES[HEIGHT], [np.nan]) is None


@given(st.integers(0, 300_000))
def test_of_a_scan_at_most_the_limit_is_sent_and_at_least_half_of_it(count: int) -> None:
    left = len(range(count)[shown_of(count)])
    assert min(count, MOST_SCAN_POINTS // 2) <= left <= MOST_SCAN_POINTS


def room(height: float, rng: np.random.Generator) -> np.ndarray:
    """Floor, ceiling and walls of a room around the sensor, 1.3 m above its floor; z up."""
    xy = rng.uniform(-4, 4, (4000, 2))
    floor = np.column_stack((xy, np.full(4000, -1.3)))
    ceiling = np.column_stack((xy, np.full(4000, height - 1.3)))
    wall = np.column_stack((np.full(2000, 4.0), rng.uniform(-4, 4, 2000), rng.uniform(-1.3, height - 1.3, 2000)))
    return np.concatenate((floor, ceiling, wall)).astype(np.float32)


@given(st.floats(2.2, 5.0), units)
def test_a_ceiling_is_taken_off_and_the_floor_stays(height: float, up: np.ndarray) -> None:
    points = room(height, np.random.default_rng(0))
    labels = np.full(len(points), NON_GROUND, np.uint8)
    R = rotation_to(up)  # the same room seen by a sensor that is held otherwise
    stays = below_ceiling((points @ R.T).astype(np.float32), labels, up)
    assert stays[:4000].all()
    assert not stays[4000:8000].any()


def test_a_ceiling_that_was_labelled_ground_stays_to_be_seen() -> None:
    points = room(3.0, np.random.default_rng(1))
    labels = np.full(len(points), GROUND, np.uint8)
    stays = below_ceiling(points, labels, np.array([0.0, 0, 1]))
    assert stays.all()


def test_treetops_and_the_open_sky_are_no_ceiling() -> None:
    rng = np.random.default_rng(2)
    points = room(3.0, rng)
    up = np.array([0.0, 0.0, 1.0])
    labels = np.zeros(len(points), np.uint8)
    assert below_ceiling(points[:4000], labels[:4000], up).all()
    leaves = points.copy()
    leaves[4000:8000, 2] += rng.uniform(0, 3, 4000)
    assert below_ceiling(leaves, labels, up).all()


@given(units, st.floats(0.1, 1.4), st.integers(1, 32))
def test_the_wedge_lies_within_alpha_of_down_on_the_given_lines(down: np.ndarray, alpha: float, lines: int) -> None:
    elevations = np.radians(np.linspace(2.3, 89.5, 32))[:lines]
    wedge = seed_wedge(elevations, down, alpha, reach=2.0)
    azimuth = np.linspace(0, 2 * np.pi, 721)
    e, a = np.meshgrid(elevations, azimuth)
    rays = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), -1).reshape(-1, 3)
    inside = rays[rays @ down > np.cos(alpha)]
    if wedge is None:
        assert len(inside) == 0
        return
    tips = wedge.vertices[1:] / 2.0
    assert np.allclose(np.linalg.norm(tips, axis=1), 1, atol=1e-5)
    assert (tips @ down > np.cos(alpha) - 1e-5).all()
    of_lines = np.abs(np.arcsin(np.clip(tips[:, 2:], -1, 1)) - elevations)
    assert of_lines.min(axis=1).max() < 1e-2  # float32 near the pole
    assert wedge.faces.max() < len(wedge.vertices)
    if len(inside):  # every ray that may be a seed is near one of the wedge's own
        assert (inside @ tips.T).max(axis=1).min() > np.cos(0.25)


def test_no_wedge_where_the_lines_never_look_down() -> None:
    assert seed_wedge(np.radians([2.0, 5.0]), np.array([0.0, 0.0, -1.0]), np.radians(30), 1.0) is None


def test_elevations_are_found_per_line_and_missing_lines_are_nan() -> None:
    e = np.radians([10.0, 10.0, 40.0])
    points = (5 * np.column_stack((np.cos(e), 0 * e, np.sin(e)))).astype(np.float32)
    found = ring_elevations(points, np.array([0, 0, 2], np.uint16))
    assert np.allclose(np.degrees(found[[0, 2]]), [10, 40], atol=1e-4) and np.isnan(found[1])


@given(units, units, st.floats(0.3, 5))
def test_the_foot_lies_on_the_plane(normal: np.ndarray, down: np.ndarray, distance: float) -> None:
    centroid = -distance * normal
    below = foot(centroid, normal, down)
    assert abs((below - centroid) @ normal) < 1e-6
    assert below @ normal < 0


@given(units)
def test_a_disc_is_turned_onto_the_plane(normal: np.ndarray) -> None:
    R = rotation_to(normal)
    assert np.allclose(R @ [0, 0, 1], normal) and np.isclose(np.linalg.det(R), 1) and np.allclose(R @ R.T, np.eye(3))


@given(units, st.floats(0.01, 3))
def test_scene_quaternions_are_those_of_viser(axis: np.ndarray, angle: float) -> None:
    from viser.transforms import SO3

    R = SO3.exp(axis * angle)
    theirs = R.wxyz * np.sign(R.wxyz[0] or 1)
    assert np.allclose(wxyz(R.as_matrix()), theirs, atol=1e-9)


def test_the_field_of_view_spans_the_elevations() -> None:
    lines = field_of_view(np.radians(2.0), np.radians(88.0), radius=0.3).reshape(-1, 3)
    assert np.allclose(np.linalg.norm(lines, axis=1), 0.3, atol=1e-6)
    elevation = np.degrees(np.arcsin(lines[:, 2] / 0.3))
    assert elevation.min() == pytest.approx(2, abs=0.1) and elevation.max() == pytest.approx(88, abs=0.1)


def test_blocks_of_a_path_join_without_a_gap() -> None:
    path = np.cumsum(np.ones((BLOCK + 10, 3)), axis=0)
    parts = [segments(path[first : first + BLOCK + 1]) for first in range(0, len(path) - 1, BLOCK)]
    joined = np.concatenate(parts)
    assert np.array_equal(joined[1:, 0], joined[:-1, 1]) and len(joined) == len(path) - 1
