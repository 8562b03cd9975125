"""The trajectory as KITTI, CSV and GPX: poses of the IMU at the scans' ends."""

from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from app.export.results import Results
from app.slam.trajectory import tum_lines


def write_kitti(path: Path, results: Results) -> None:
    """The upper three rows of each T_map_imu in one line, without stamps."""
    rows = results.trajectory.poses[:, :3].reshape(-1, 12) + 0.0
    path.write_text("".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows), encoding="ascii")


def write_csv(path: Path, results: Results) -> None:
    """Stamp and pose in the map; if georeferenced, also easting, northing, height, latitude, longitude."""
    columns, places = "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw", [""] * len(results.trajectory)
    if (where := results.where) is not None:
        columns += ",easting_m,northing_m,height_m,latitude_deg,longitude_deg"
        positions = results.trajectory.positions
        rows = zip(where.to_crs(positions), where.to_geographic(positions), strict=True)
        places = [
            f",{e:.4f},{n:.4f},{h:.4f},{latitude:.10f},{longitude:.10f}" for (e, n, h), (latitude, longitude, _) in rows
        ]
    lines = [line.replace(" ", ",") + place for line, place in zip(tum_lines(results.trajectory), places, strict=True)]
    path.write_text("\n".join([columns, *lines, ""]), encoding="ascii")


def write_gpx(path: Path, results: Results) -> None:
    """GPX 1.1: one track."""
    assert results.where is not None
    root = ElementTree.Element("gpx", version="1.1", creator="hemislam", xmlns="http://www.topografix.com/GPX/1/1")
    track = ElementTree.SubElement(root, "trk")
    ElementTree.SubElement(track, "name").text = name_of(results.info.recording)
    segment = ElementTree.SubElement(track, "trkseg")
    places = results.where.to_geographic(results.trajectory.positions)
    for stamp_ns, (latitude, longitude, height) in zip(results.trajectory.stamps_ns.tolist(), places, strict=True):
        point = ElementTree.SubElement(segment, "trkpt", lat=f"{latitude:.9f}", lon=f"{longitude:.9f}")
        ElementTree.SubElement(point, "ele").text = f"{height:.3f}"
        ElementTree.SubElement(point, "time").text = utc_text(stamp_ns)
    write_xml(path, root)


def name_of(recording: Path) -> str:
    """The file's name without its suffix, as UTF-8 whatever its bytes are."""
    return recording.stem.encode("utf-8", "backslashreplace").decode("utf-8")


def utc_text(stamp_ns: int) -> str:
    """ISO 8601 with milliseconds, as XML files have it."""
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest // 1_000_000:03d}Z"


def write_xml(path: Path, root: ElementTree.Element) -> None:
    """Write indented XML with a declaration."""
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
