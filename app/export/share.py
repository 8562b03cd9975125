"""One HTML file that shows the map in any browser, without a server: viser's own page with the scene inside."""

import contextlib
import html
import io
import math
from pathlib import Path

import numpy as np
import viser

from app.export.ceilings import below_ceiling
from app.export.paths import name_of, utc_text
from app.export.point_sizes import with_point_sizes
from app.export.results import Results
from app.slam import lie
from app.slam.types import F32, F64, U8

MOST_POINTS = 1_000_000
TILE = 16.0
"""m: in a tile, float16 resolves x and y to 4 mm; z is coarser far from the tile's median."""
STOPS = np.array([[40, 60, 150], [30, 150, 160], [120, 195, 110], [240, 200, 70], [225, 90, 50]], np.float64)
"""Colours from low to high."""
PATH, LOOP, MARK, ARROW = (255, 255, 255), (255, 120, 40), (120, 255, 160), (255, 60, 60)


def write(path: Path, results: Results) -> None:
    """Write some of the points, trajectory, loops, notes, measures, a scale, a north arrow, title and credits."""
    points, keyframes = _sample(results)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints when it starts and stops
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        _draw(server, points, keyframes, results)
        page = server.get_scene_serializer().as_html(dark_mode=True)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    name = html.escape(name_of(results.info.recording))
    page = with_point_sizes(page).replace("<title>Viser</title>", f"<title>{name}</title>", 1)
    before, end, after = page.rpartition("</body>")
    path.write_text(before + _overlay(name, len(points), results) + end + after, encoding="utf-8")


def _sample(results: Results) -> tuple[F32, F64]:
    """(n, 3) m, a random sample of the chosen points below ceilings, and (k, 3) m, the keyframes' positions."""
    total, rng = sum(len(block) for block in results.still_blocks()), np.random.default_rng(0)
    taken, keyframes = [np.empty((0, 3), np.float32)], []
    for block in results.still_blocks():
        which = rng.random(len(block)) * total < MOST_POINTS
        up, above = block.T_map_lidar[2, :3], block.points - block.T_map_lidar[:3, 3]
        which &= below_ceiling((above @ block.T_map_lidar[:3, :3]).astype(np.float32), block.labels, up)
        taken.append(block.points[which].astype(np.float32))
        keyframes.append(block.T_map_lidar[:3, 3])
    return np.concatenate(taken), np.reshape(keyframes, (-1, 3))


def _draw(server: viser.ViserServer, points: F32, keyframes: F64, results: Results) -> None:
    scene, trajectory = server.scene, results.trajectory.positions
    scene.set_up_direction("+z")
    colours = _colours(points[:, 2])
    tiles, which = np.unique(np.floor(points[:, :2] / TILE).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(which.ravel())))  # with an empty part after the last tile
    for number, (tile, part) in enumerate(zip(tiles, parts, strict=False)):
        center = np.append((tile + 0.5) * TILE, np.median(points[part, 2]))
        own = (points[part] - center).astype(np.float32)
        scene.add_point_cloud(
            f"/map/{number}", own, colours[part], point_size=0.03, point_shape="circle", position=center
        )
    if len(trajectory) > 1:
        _lines(server, "/trajectory", np.stack([trajectory[:-1], trajectory[1:]], axis=1), PATH)
    if len(pairs := _loops(results.loops.g2o if results.loops else "", len(keyframes))):
        _lines(server, "/loops", keyframes[pairs], LOOP)
    for number, (text, at) in enumerate(marked(results)):
        server.scene.add_label(f"/marks/{number}", text, position=tuple(at.mean(axis=0)))
        if len(at) > 1:
            _lines(server, f"/marks/{number}/line", np.stack([at[:-1], at[1:]], axis=1), MARK)
    for number, (frame, text) in enumerate(results.notes):
        if 0 <= frame < len(trajectory):
            scene.add_label(f"/notes/{number}", text, position=tuple(trajectory[frame]))
    seen = points if len(points) else np.zeros((1, 3), np.float32)
    low, high = np.percentile(seen, [1, 99], axis=0)  # a few far points would shrink the rest
    _add_scale_and_arrow(server, low, high, results)
    center, size = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) + 1.0
    server.initial_camera.position = tuple(center + size * np.array([-0.26, -0.42, 0.45]))
    server.initial_camera.look_at = tuple(center)


def marked(results: Results) -> list[tuple[str, F64]]:
    """The measures: name, with the distance if there are two points, and (k, 3) m, their places in the map."""
    found = []
    for name, spots in results.marks:
        if all(0 <= index < len(results.keyframes) for index, _ in spots):
            poses = [results.frame.at(index) @ results.keyframes[index].T_odom_imu for index, _ in spots]
            at = np.array([lie.moved(T, place) for T, (_, place) in zip(poses, spots, strict=True)])
            length = f" {np.linalg.norm(at[1] - at[0]):.3f} m" if len(at) == 2 else ""
            found.append((name + length, at))
    return found


def _lines(server: viser.ViserServer, name: str, ends: F64, colour: tuple[int, int, int]) -> None:
    server.scene.add_line_segments(name, ends.astype(np.float32), colour, thickness=2.0, thickness_units="screen")


def _colours(heights: F32) -> U8:
    """(n, 3) by height, between its 2nd and 98th percentile."""
    if not len(heights):
        return np.empty((0, 3), np.uint8)
    low, high = np.percentile(heights, [2, 98])
    share = np.round(np.clip((heights - low) / max(high - low, 1e-6), 0, 1) * 63) / 63  # few colours make small files
    return np.stack([np.interp(share, np.linspace(0, 1, len(STOPS)), stop) for stop in STOPS.T], axis=1).astype(
        np.uint8
    )


def _loops(g2o: str, keyframes: int) -> np.ndarray:
    """(m, 2) pairs of keyframes tied by a loop: edges of the graph between keyframes that are not consecutive."""
    edges = [line.split()[1:3] for line in g2o.splitlines() if line.startswith("EDGE_SE3")]
    pairs = [(int(a), int(b)) for a, b in edges if abs(int(a) - int(b)) > 1]
    return np.array([pair for pair in pairs if max(pair) < keyframes], np.int64).reshape(-1, 2)


def _add_scale_and_arrow(server: viser.ViserServer, low: F64, high: F64, results: Results) -> None:
    """Add them at the left of the initial view, beside nearly all of the map."""
    width = float(max((high - low)[:2].max(), 1.0))
    decade = 10.0 ** math.floor(math.log10(width / 4))
    length = next(step * decade for step in (5, 2, 1) if step * decade <= width / 4 * 1.0001)
    begin = np.array([low[0] - 0.05 * width, (low[1] + high[1]) / 2, low[2]])
    end, foot = begin + np.array([0, length, 0]), begin + np.array([0, 1.5 * length + 0.03 * width, 0])
    _lines(server, "/scale", np.array([[begin, end]]), PATH)
    server.scene.add_label("/scale/text", f"{length:g} m", position=tuple((begin + end) / 2))
    toward = np.array([1.0, 0, 0]) if results.where is None else np.array(results.where.rotation)[1]
    tip = foot + toward * length / 2
    _lines(server, "/arrow", np.array([[foot, tip]]), ARROW)
    server.scene.add_label("/arrow/text", "x" if results.where is None else "N", position=tuple(tip))


def _overlay(name: str, points: int, results: Results) -> str:
    """Title and credits above the map."""
    stamps_ns = results.trajectory.stamps_ns
    facts = [f"{points:,} points", f"{results.trajectory.distance:,.0f} m walked"]
    facts += [utc_text(int(stamps_ns[0]))[:10]] if len(stamps_ns) else []
    facts += [html.escape(results.where.crs)] if results.where is not None and len(results.where.crs) < 20 else []
    return (
        '<div style="position:fixed;left:50%;top:12px;transform:translateX(-50%);z-index:9999;pointer-events:none;'
        'padding:8px 12px;border-radius:8px;background:#10151ccc;color:#fff;font:14px/1.4 system-ui,sans-serif">'
        f"<b>{name}</b><br>{' · '.join(facts)}<br>"
        '<span style="opacity:.7">Made with hemislam; shown by viser. Drag to turn, scroll to zoom</span></div>'
    )
