"""Every PointCloud2 is decoded to the measured scan.

Tests app/sensors/azimuth.py, app/sensors/rings.py, app/sensors/timing.py.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.sensors.cloud_types import CloudError, Probe, read_point_cloud_2
from app.sensors.layout import settle_cloud
from app.sensors.pointcloud import CloudLayout, decode
from app.slam.sections import RecordingParams
from tests.sensors import rig

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def settle(layout: rig.Layout, lost: tuple[int, ...] = ()) -> tuple[list[Probe], CloudLayout]:
    """A few revolutions logged right after their end, and how they are to be read."""
    probes = []
    for number in range(3):
        made = rig.turn(number, columns=20)
        cloud = read_point_cloud_2(rig.message(made, layout, lost=lost))
        probes.append(Probe(made.begin_ns + rig.PERIOD_NS + 3_000_000, cloud))
    return probes, settle_cloud(probes, RecordingParams(), "/points")[0]


@st.composite
def layouts(draw: st.DrawFn) -> rig.Layout:
    """Any order, types, padding and byte order of the fields, and any encoding of time."""
    time_name = draw(st.sampled_from(["timestamp", "time", "t", "offset_time", "time_stamp", "Timestamp"]))
    absolute = draw(st.booleans())
    # A float32 cannot hold absolute time, nor a 4-byte integer absolute nanoseconds.
    kind = "f8" if absolute else draw(st.sampled_from(["f8", "f4", "i4"]))
    unit = draw(st.sampled_from(["s", "ms", "us", "ns"] if kind[0] == "f" else ["us", "ns"]))
    coordinates = draw(st.sampled_from(["f4", "f8"]))
    fields = [
        ("x", coordinates, "x"),
        ("y", coordinates, "y"),
        ("z", coordinates, "z"),
        ("intensity", draw(st.sampled_from(["f4", "u1", "u2", "f8"])), "intensity"),
        ("ring", draw(st.sampled_from(["u1", "u2", "i4", "f4"])), "ring"),
        (time_name, kind, "time"),
    ]
    if draw(st.booleans()):
        fields.append(("ground", "u1", "ground"))
    return rig.Layout(
        fields=draw(st.permutations(fields)),
        unit_ns=UNITS[unit],
        absolute=absolute,
        time_from=draw(st.sampled_from(["first", "last"])),
        header=draw(st.sampled_from(["first", "last"])) if absolute else "last",
        gaps=draw(st.lists(st.integers(0, 5), max_size=8)),
        row_padding=draw(st.integers(0, 9)),
        rows=draw(st.sampled_from([1, 2, 8])),
        big_endian=draw(st.booleans()),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(layout=layouts(), lost=st.sets(st.integers(1, 158), max_size=40))
def test_any_packing_of_the_same_revolution_gives_the_same_scan(layout: rig.Layout, lost: set[int]) -> None:
    probes, settled = settle(layout, lost=tuple(lost))
    scan = decode(probes[1].cloud, settled)
    made = rig.turn(1, columns=20)
    truth = made.only(np.array([slot not in lost for slot in range(len(made))]))
    np.testing.assert_array_equal(scan.points, truth.points)
    np.testing.assert_array_equal(scan.ring, truth.ring)
    np.testing.assert_array_equal(scan.intensity, truth.intensity)
    if any(name == "ground" for name, _, _ in layout.fields):
        np.testing.assert_array_equal(scan.truth_ground, truth.ground)
    else:
        assert scan.truth_ground is None
    # Absolute seconds in a double are 0.24 us apart, relative ones in a float32 at most 6 ns;
    # whole microseconds are cut off. With the header at the last point and times from the first, the
    # end is known to one firing only.
    times = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
    whole = next(kind for _, kind, source in layout.fields if source == "time") == "i4"
    quantum = max(layout.unit_ns if whole else 0, 500)
    firing = rig.PERIOD_NS // len(made) if not layout.absolute and layout.time_from == "first" else 0
    assert np.abs(times - (truth.begin_ns + truth.offsets_ns)).max() <= quantum + firing
    assert scan.offsets_ns.min() == 0


def test_nan_infinite_and_zero_points_are_no_returns() -> None:
    made = rig.turn(0, columns=20)
    made.points[3] = 0.0
    made.points[7] = (np.inf, 1.0, 1.0)
    made.points[9] = (1.0, np.nan, 1.0)
    made.points[11] = (0.0, 0.0, 2.0)  # straight up is a return
    _, settled = settle(rig.Layout())
    scan = decode(read_point_cloud_2(rig.message(made)), settled)
    keep = ~np.isin(np.arange(len(made)), [3, 7, 9])
    np.testing.assert_array_equal(scan.points, made.points[keep])
    np.testing.assert_array_equal(scan.ring, made.ring[keep])


def test_a_decoded_scan_cannot_be_written_to() -> None:
    probes, settled = settle(rig.Layout())
    scan = decode(probes[0].cloud, settled)
    for array in (scan.points, scan.offsets_ns, scan.intensity, scan.ring):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_nanoseconds_as_unsigned_64_bit_integers_lose_no_digit() -> None:
    layout = rig.Layout()
    made = rig.turn(2, columns=20)
    cloud = read_point_cloud_2(rig.message(made, layout))
    stamps = (made.begin_ns + made.offsets_ns).astype(np.uint64)
    offset = cloud.fields["timestamp"][0]
    data = cloud.data.reshape(-1, cloud.point_step).copy()
    data[:, offset : offset + 8] = stamps.view(np.uint8).reshape(-1, 8)
    fields = cloud.fields | {"timestamp": (offset, np.dtype("<u8"))}
    cloud = replace(cloud, fields=fields, data=data.reshape(-1))
    settled, _ = settle_cloud([Probe(cloud.stamp_ns + 1_000_000, cloud)], RecordingParams(), "/points")
    scan = decode(cloud, settled)
    np.testing.assert_array_equal(scan.stamp_ns + scan.offsets_ns.astype(np.int64), stamps.astype(np.int64))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda m: setattr(m, "data", m.data[:-1]), "but holds"),
        (lambda m: setattr(m, "point_step", 20), "point_step"),
        (lambda m: setattr(m, "width", 10**6), "but holds"),
        (lambda m: setattr(m, "row_step", 100), "row_step"),
    ],
)
def test_a_cloud_whose_sizes_contradict_each_other_is_refused(spoil: object, said: str) -> None:
    message = rig.message(rig.turn(0, columns=5), rig.Layout(rows=2))
    spoil(message)  # type: ignore[operator]
    with pytest.raises(CloudError, match=said):
        read_point_cloud_2(message)


def test_empty_and_all_nan_clouds_say_so() -> None:
    _, settled = settle(rig.Layout())
    made = rig.turn(0, columns=5)
    with pytest.raises(CloudError, match="no points"):
        decode(read_point_cloud_2(rig.message(made.only(np.zeros(len(made), bool)))), settled)
    with pytest.raises(CloudError, match="NaN"):
        decode(read_point_cloud_2(rig.message(made, lost=range(len(made)))), settled)
